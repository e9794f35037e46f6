"""Training a field in JAX."""
