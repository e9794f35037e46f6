"""The neural radiance field: networks, encodings and volume rendering, on NumPy or JAX arrays."""
