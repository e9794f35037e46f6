"""The field, its rays and their losses once more, in float64 and one number at a time: what training's formulas are compared with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from snerg.core.nerf.model import MlpModelConfig


def encoded(point: np.ndarray, degrees: int) -> np.ndarray:
    """The positional encoding of one point [D]: [D (1 + 2 degrees)] (NeRF, eq. 4; the point itself first)."""
    waves = [turn(2.0**k * x) for turn in (math.sin, math.cos) for k in range(degrees) for x in point]
    return np.array([*point, *waves])


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + e^-x)."""
    return 1 / (1 + np.exp(-np.asarray(x, np.float64)))


def raw_mlp(family: MlpModelConfig, layers: Any, point: np.ndarray) -> tuple[float, np.ndarray]:
    """(raw density, values after the sigmoid [C]) of one point [3]."""
    inputs = encoded(np.asarray(point, np.float64), family.degrees)
    x = inputs
    for i, (kernel, bias) in enumerate(layers[: family.depth]):
        x = np.maximum(x @ np.float64(kernel) + np.float64(bias), 0)
        if i > 0 and i % family.skip == 0:
            x = np.concatenate([x, inputs])
    (density, density_bias), (outputs, outputs_bias) = layers[family.depth : family.depth + 2]
    return float((x @ np.float64(density) + np.float64(density_bias))[0]), sigmoid(x @ np.float64(outputs) + np.float64(outputs_bias))


def density_of(family: MlpModelConfig, raw: float) -> float:
    """ReLU, or 8 log(1 + e^(raw + 1))."""
    return max(raw, 0.0) if family.density == "relu" else 8 * math.log1p(math.exp(raw + 1))


def residual(view: Any, colour: np.ndarray, features: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Eq. 7's network for one ray: colour over white [3], features [4], direction [3]."""
    w0, b0, w1, b1, w2, b2 = (np.float64(array) for array in view)
    x = np.concatenate([encoded(np.asarray(direction, np.float64), 4), colour, features])
    return sigmoid(np.maximum(np.maximum(x @ w0 + b0, 0) @ w1 + b1, 0) @ w2 + b2)


def march(depths: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """One ray of optical depths [K], values [K, C], front to back: (composited [C], transmittance, weights [K])."""
    through, total, weights = 1.0, np.zeros(values.shape[-1]), []
    for depth, value in zip(np.clip(np.asarray(depths, np.float64), 0, 80), values, strict=True):
        weights.append(through * -math.expm1(-depth))
        total += weights[-1] * value
        through *= math.exp(-depth)
    return total, through, np.array(weights)


def shown(view: Any, gathered: np.ndarray, through: float, direction: np.ndarray, background: np.ndarray) -> np.ndarray:
    """A deferred ray's colour [3] over a background, with the residual where alpha is at least 1 / 255; diffuse where `view` is None."""
    colour = gathered[:3] + through * background
    if view is not None and through <= 254 / 255:
        colour = colour + residual(view, gathered[:3] + through, gathered[3:], direction)
    return colour
