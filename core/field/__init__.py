"""The deferred NeRF: encodings, networks, sampling, volume rendering, training."""
