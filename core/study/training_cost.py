"""What a training takes, before it begins: its steps are timed on an untrained field of the same kind (JAX)."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..data.dataset import Dataset
from ..nerf.model import HashModelConfig, field_inputs, field_outputs, init_field
from ..training.config import TrainSettings
from ..training.optimizer import train_step, zero_moments
from .coefficients import DEFAULT_COEFFICIENTS, Coefficients

MLP_POINTS = 2**12  # samples of an MLP's timed step, which takes a second or more with all of them
TIMED_STEPS = 5  # of which the median counts


def training(dataset: Dataset, settings: TrainSettings, coefficients: Coefficients = DEFAULT_COEFFICIENTS) -> dict[str, Any]:
    """The cost of a training: {"seconds", "set_up_seconds", "steps", "step_seconds", "peak_megabytes"} (JAX).

    A step is timed by `update_seconds`; reading images, by the first image.
    """
    params = init_field(settings.family, "deferred", np.random.default_rng(0))
    step = coefficients.step_updates * update_seconds(settings, params)
    began = time.perf_counter()
    dataset.read(0)
    reading = (time.perf_counter() - began) * len(dataset.views)
    seconds = settings.steps * step if settings.steps is not None else float(settings.seconds or 0)
    pixels = sum(camera.width * camera.height for camera in dataset.cameras)
    parameters = sum(array.size for array in jax.tree.leaves(params))
    memory = coefficients.training_bytes + coefficients.pixel_bytes * pixels + coefficients.parameter_copies * 4 * parameters
    return {
        "seconds": round(seconds, 1),
        "set_up_seconds": round(coefficients.set_up_seconds + reading, 1),
        "steps": settings.steps if settings.steps is not None else int(seconds / step),
        "step_seconds": round(step, 5),
        "peak_megabytes": round(memory / 1e6),
    }


def update_seconds(settings: TrainSettings, params: Any) -> float:
    """Seconds of an update of the parameters by as many random samples as a step has, compiling left out (JAX).

    params: the result of `init_field`, NumPy arrays, which stay as they are.

    The gradient of a hash table and its optimizer take as long as the queries: a table of twice the size takes half as long again.
    """
    samples = settings.samples if settings.sampler == "packed" else settings.rays * (settings.coarse + settings.coarse + settings.fine)
    points = samples if isinstance(settings.family, HashModelConfig) else min(samples, MLP_POINTS)
    random = np.random.default_rng(0).uniform(-1, 1, (points, 3))
    inputs = field_inputs(jnp, settings.family, random.astype(np.float32))

    def loss(params: Any, batch: Any) -> tuple[Any, dict[str, Any]]:
        density, values = field_outputs(jnp, settings.family, params["field"], batch)
        return jnp.mean(density) + jnp.mean(values), {}

    step = jax.jit(partial(train_step, settings, loss), donate_argnums=(0, 1))
    moments, seconds = zero_moments(params), []
    for _ in range(1 + TIMED_STEPS):
        began = time.perf_counter()
        params, moments, _ = jax.block_until_ready(step(params, moments, inputs, 1e-3, 1))
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds[1:])) * samples / points
