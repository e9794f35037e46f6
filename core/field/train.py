"""Training a deferred NeRF (section 4) in JAX: the one place that optimises the field."""

from __future__ import annotations

import ctypes
import ctypes.util
import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..capture.dataset import Dataset
from ..errors import Cancelled, SnergError
from .checkpoint import read_field_and_state, write_field
from .field import Field
from .losses import cauchy
from .networks import Family, HashFamily, MlpFamily, ViewNetwork, field_inputs, field_outputs, init_field, view_residual
from .pixels import PixelPool
from .sampling import Occupancy, hull, pack_samples
from .volume import composite, optical_depth

Progress = Callable[[float, str], None]
MOST_RAYS = 8192  # in a step
UPDATE_CELLS = 2**18  # of the occupancy grid, looked at in one update
UPDATE_EVERY = 64  # steps
WARM_UP = 256  # steps before an occupancy cell may be given up
SPACINGS = ((0.1, 8), (0.25, 4), (0.6, 2), (2.0, 1))  # (until this fraction, times the final spacing)
NOTHING = 1e-9  # a gradient this small is none; those that teach are 1e-7 and more
NETWORK_OPAQUE = 1 / 255  # the view-dependence network counts where alpha is at least this (hard case 43)


@dataclass(frozen=True)
class TrainSettings:
    """How to train.

    family: the network. view_dependence: without, the field is diffuse. samples: packed into one step.
    spacing: final distance between samples on [-1, 1]; training starts with 4 times that, then twice.
    rate, final_rate: of Adam, falling log-linearly (section 6); network_rate: factor on the networks beside the table.
    sparsity: weight of the Cauchy loss (eq. 8), averaged over samples. alpha: weight of the alpha loss, for images with alpha.
    seconds, steps: how long to train; the schedule spans it. seed: of everything random.
    """

    family: Family = HashFamily()
    view_dependence: bool = True
    samples: int = 32768
    spacing: float = 2 / 256
    rate: float = 4e-2
    final_rate: float = 8e-4
    network_rate: float = 1.0
    beta_2: float = 0.99
    warm_up: int = 64
    sparsity: float = 1e-5
    alpha: float = 0.1
    seconds: float | None = 300.0
    steps: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not (0 < self.final_rate <= self.rate and math.isfinite(self.rate)):
            raise SnergError(f"The learning rate falls from {self.rate} to {self.final_rate}; both must be above 0, and it must not rise.")
        if self.steps is not None and self.steps < 1:
            raise SnergError(f"Training for {self.steps} steps is no training; give 1 or more.")
        if self.steps is None and not (self.seconds is not None and self.seconds > 0):
            raise SnergError(f"Training for {self.seconds} seconds is no training; give a time above 0, or steps.")


PRESETS = {
    "fast": TrainSettings(),
    # Section 6: 8 layers of 512, learning rate 2e-3 to 2e-5, warm-up over 2500 steps; without clipping, which Adam makes idle.
    "paper": TrainSettings(family=MlpFamily(), rate=2e-3, final_rate=2e-5, network_rate=1.0, beta_2=0.999, warm_up=2500, samples=16384),
}


@dataclass(frozen=True)
class TrainProgress:
    """fraction of the whole, step, loss and psnr (dB, of the training rays, running mean), seconds, rays and samples of the last step."""

    fraction: float
    step: int
    loss: float
    psnr: float
    seconds: float
    rays: int
    samples: int


class Trainer:
    """A field on its way: parameters, optimiser, occupancy, random state."""

    def __init__(self, dataset: Dataset, settings: TrainSettings, progress: Progress = lambda f, w: None) -> None:
        keep_memory()
        self.settings, self.dataset = settings, dataset
        images = []
        for i in range(len(dataset.views)):
            images.append(dataset.read(i))
            progress(0.0, f"Reading image {i + 1} of {len(dataset.views)}")
        progress(0.0, "Carving the visual hull")
        masks = [i[..., 3] > 0 if i.shape[-1] == 4 else None for i in images]
        self.domain, alive = hull(dataset.suggested_box(), dataset.cameras, masks)
        self.pool = PixelPool(images, dataset.cameras, self.domain)
        self.occupancy = Occupancy.of_hull(alive)
        self.rng = np.random.default_rng(settings.seed)
        self.params = jax.tree.map(jnp.asarray, init_field(settings.family, settings.view_dependence, self.rng))
        self.moments = jax.tree.map(jnp.zeros_like, self.params), jax.tree.map(jnp.zeros_like, self.params)
        self.step = 0
        self.elapsed = 0.0
        self.occupied = self.occupancy.occupied
        self.samples_per_ray = 32.0
        self.history: list[dict[str, float]] = []
        self.loss = self.error = 0.0
        self.bad = 0
        self._inputs = jax.jit(partial(field_inputs, jnp, settings.family))
        self._density = jax.jit(lambda params, inputs: field_outputs(jnp, settings.family, params, inputs)[0])
        progress(0.0, "Compiling the training step")
        self._step = jax.jit(partial(train_step, settings, self.pool.alpha), donate_argnums=(0, 1))

    def fraction(self) -> float:
        """How much of the training is done, 0..1."""
        if self.settings.steps is not None:
            return min(self.step / self.settings.steps, 1.0)
        return min(self.elapsed / float(self.settings.seconds or 1), 1.0)

    def run(self) -> Iterator[TrainProgress]:
        """Train to the end, telling how it goes about twice a second. Close the generator to stop; the trainer stays whole.

        Raises SnergError when several steps in a row are not finite; the parameters are those before them.
        """
        began = time.perf_counter() - self.elapsed
        told = kept = 0.0
        while self.fraction() < 1:
            samples, rays = self.advance()
            self.elapsed = time.perf_counter() - began
            if self.elapsed - told > 0.5 or self.fraction() >= 1:
                told = self.elapsed
                if told - kept > 5 or self.fraction() >= 1:
                    kept = told
                    self.history.append({"step": self.step, "seconds": round(told, 2), "loss": self.loss, "psnr": round(self.psnr, 3)})
                yield TrainProgress(self.fraction(), self.step, self.loss, self.psnr, told, rays, samples)

    def advance(self) -> tuple[int, int]:
        """One step. Returns how many samples and rays it had. Raises SnergError as `run` does."""
        batch, samples, rays = self.batch()
        self.params, self.moments, report = self._step(self.params, self.moments, batch, self.rate(), self.step + 1)
        self.step += 1
        if self.step % UPDATE_EVERY == 0 or self.step in (16, 32):
            self.update_occupancy()
        loss, error, finite = (float(x) for x in report)
        self.bad = 0 if finite else self.bad + 1
        if self.bad >= 5:
            raise SnergError(
                f"Training went wrong at step {self.step - self.bad}: the loss is not finite five times in a row; "
                "lower the learning rate, or check the dataset for broken images or poses."
            )
        if finite:
            keep = 0.98 if self.loss else 0.0
            self.loss = keep * self.loss + (1 - keep) * loss
            self.error = keep * self.error + (1 - keep) * error
        return samples, rays

    @property
    def psnr(self) -> float:
        """Of the training rays, dB, running mean."""
        return -10 * math.log10(max(self.error, 1e-10))

    def rate(self) -> float:
        """Learning rate now: log-linear decay after a linear warm-up from a tenth (section 6)."""
        s = self.settings
        warm = 0.1 + 0.9 * min(self.step / max(s.warm_up, 1), 1.0)
        return warm * math.exp(math.log(s.rate) + self.fraction() * (math.log(s.final_rate) - math.log(s.rate)))

    def spacing(self) -> float:
        """Distance between samples now: coarse first, so that a step sees many rays while the shape is still rough."""
        fraction = self.fraction()
        return self.settings.spacing * next(factor for until, factor in SPACINGS if fraction < until)

    def update_occupancy(self) -> None:
        """Ask the field where something is, and give up cells with an opacity under 0.01 over one final interval."""
        self.occupancy.update(self.density, UPDATE_CELLS, self.rng)
        if self.step >= WARM_UP:
            self.occupancy.prune(0.01 / self.settings.spacing)
        self.occupied = self.occupancy.occupied

    def density(self, x: np.ndarray) -> np.ndarray:
        """Density [N] at field coordinates [N, 3], in chunks of one shape."""
        size = self.settings.samples
        found = np.empty(len(x), np.float32)
        for start in range(0, len(x), size):
            part = x[start : start + size]
            padded = np.zeros((size, 3), np.float32)
            padded[: len(part)] = part
            found[start : start + len(part)] = np.asarray(self._density(self.params["field"], self._inputs(padded)))[: len(part)]
        return found

    def batch(self) -> tuple[dict[str, Any], int, int]:
        """A step's rays and packed samples, always of the same shapes; and how many of each are real."""
        size = self.settings.samples
        draw = int(min(size / self.samples_per_ray, MOST_RAYS - 1))
        index = self.pool.draw(draw, self.rng)
        origin, direction, near = self.pool.rays(index)
        got = pack_samples(self.domain, self.occupied, origin, direction, self.spacing(), self.rng.random(draw), near)
        self.samples_per_ray = 0.7 * self.samples_per_ray + 0.3 * max(len(got.ray), 1) / draw
        # Whole rays only. None is cut short where the occupancy grid takes it to be opaque: such guesses end a few rays in
        # front of surfaces, what shines through is made up for by more density there, and that feeds on itself.
        count = len(got.ray) if len(got.ray) <= size else int(np.searchsorted(got.ray, got.ray[size]))
        points = np.zeros((size, 3), np.float32)
        points[:count] = got.points[:count]
        ray = np.full(size, MOST_RAYS - 1, np.int32)
        ray[:count] = got.ray[:count]
        directions = np.zeros((MOST_RAYS, 3), np.float32)
        directions[:, 2] = 1
        directions[:draw] = direction
        target = np.zeros((MOST_RAYS, 4), np.uint8)
        target[:draw] = self.pool.pixels[index]
        used = np.zeros(MOST_RAYS, bool)
        used[ray[:count]] = True
        if not count and not self.occupied.any():
            raise SnergError("The field has become empty everywhere; check that the images show something inside the box.")
        inputs = {
            "inputs": self._inputs(points),
            "ray": ray,
            "valid": np.arange(size) < count,
            "directions": directions,
            "target": target,
            "used": used,
            "length": np.float32(got.length),
        }
        return inputs, count, int(used.sum())

    def field(self) -> Field:
        """The field as trained so far."""
        view = self.params.get("view")
        return Field(
            family=self.settings.family,
            params=jax.tree.map(np.asarray, self.params["field"]),
            network=None if view is None else ViewNetwork(*(np.asarray(a) for a in view)),
            domain=self.domain,
            occupancy=self.occupied,
            spacing=self.settings.spacing,
            cameras=self.dataset.cameras,
            dataset=str(self.dataset.root.resolve()),
            about={
                "settings": asdict(self.settings),
                "family": type(self.settings.family).__name__,
                "steps": self.step,
                "seconds": round(self.elapsed, 2),
                "psnr_training_rays": self.history[-1]["psnr"] if self.history else None,
                "history": self.history,
            },
        )

    def state(self) -> dict[str, np.ndarray]:
        """All that `restore` needs to go on where this trainer stands, as arrays."""
        leaves = jax.tree.leaves((self.params, self.moments))
        arrays = {f"leaf_{i:03d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
        arrays["most"] = self.occupancy.most
        arrays["clock"] = np.array([self.step, self.elapsed, self.samples_per_ray], np.float64)
        arrays["random"] = np.frombuffer(repr(self.rng.bit_generator.state).encode(), np.uint8)
        return arrays

    def restore(self, state: dict[str, np.ndarray], history: list[dict[str, float]]) -> None:
        """Go on from a `state`. Raises SnergError when it is another network's."""
        leaves, tree = jax.tree.flatten((self.params, self.moments))
        kept = [state.get(f"leaf_{i:03d}") for i in range(len(leaves))]
        if any(k is None or k.shape != leaf.shape for k, leaf in zip(kept, leaves, strict=True)):
            raise SnergError("The field to go on with has another network than these settings; train into a new folder.")
        self.params, self.moments = jax.tree.unflatten(tree, [jnp.asarray(k) for k in kept])
        self.occupancy = Occupancy(state["most"].copy())
        self.occupied = self.occupancy.occupied
        self.step, self.elapsed, self.samples_per_ray = int(state["clock"][0]), float(state["clock"][1]), float(state["clock"][2])
        from ast import literal_eval

        self.rng.bit_generator.state = literal_eval(state["random"].tobytes().decode())
        self.history = list(history)


def train_step(
    settings: TrainSettings, has_alpha: bool, params: Any, moments: Any, batch: dict[str, Any], rate: Any, step: Any
) -> tuple[Any, Any, Any]:
    """One step of Adam (Kingma and Ba 2015). Returns (params, moments, (loss, squared error of colour, whether finite)).

    A step whose loss or gradient is not finite changes nothing (hard case 26): a NaN anywhere in the table's gradient
    comes through the small arrays, so only those are looked at.
    """
    (loss, error), gradient = jax.value_and_grad(partial(batch_loss, settings, has_alpha), has_aux=True)(params, batch)
    small = [g for g in jax.tree.leaves(gradient) if g.size < 2**16]
    finite = jnp.isfinite(loss) & jnp.array([jnp.isfinite(g).all() for g in small]).all()
    b1, b2 = 0.9, settings.beta_2
    unbias = jnp.sqrt(1 - b2 ** jnp.float32(step)) / (1 - b1 ** jnp.float32(step))

    def update(path: Any, p: Any, g: Any, m: Any, v: Any) -> tuple[Any, Any, Any]:
        table = "table" in jax.tree_util.keystr(path)
        # A vertex that no sample of this step touched rests: were its moments to decay, one sample in ten steps would
        # move it ten times as far as a sample in each does. What hardly any light reaches counts as untouched, because
        # Adam makes full steps even of gradients of 1e-14.
        changes = finite & (jnp.abs(g) > NOTHING) if table else finite
        m2, v2 = b1 * m + (1 - b1) * g, b2 * v + (1 - b2) * g * g
        p2 = p - rate * (1.0 if table else settings.network_rate) * unbias * m2 / (jnp.sqrt(v2) + NOTHING)
        return jnp.where(changes, p2, p), jnp.where(changes, m2, m), jnp.where(changes, v2, v)

    changed = jax.tree_util.tree_map_with_path(update, params, gradient, *moments)
    p, m, v = jax.tree.transpose(jax.tree.structure(params), jax.tree.structure((0, 0, 0)), changed)
    return p, (m, v), (loss, error, finite)


def batch_loss(settings: TrainSettings, has_alpha: bool, params: Any, batch: dict[str, Any]) -> tuple[Any, Any]:
    """Squared error over white (eq. 3), sparsity (eq. 8) and alpha; and the squared error alone."""
    density, values = field_outputs(jnp, settings.family, params["field"], batch["inputs"])
    depth = optical_depth(jnp, jnp.where(batch["valid"], density, 0), batch["length"])
    gathered, through, _ = composite(jnp, depth, values, batch["ray"], MOST_RAYS)
    colour = gathered[:, :3] + through[:, None]
    if settings.view_dependence:
        residual = view_residual(jnp, ViewNetwork(*params["view"]), colour, gathered[:, 3:], batch["directions"])
        colour = colour + jnp.where(through[:, None] <= 1 - NETWORK_OPAQUE, residual, 0)
    target = batch["target"].astype(jnp.float32) / 255
    alpha = target[:, 3:]
    wanted = target[:, :3] * alpha + (1 - alpha)
    used = batch["used"].astype(jnp.float32)
    rays = jnp.maximum(used.sum(), 1)
    error = (((colour - wanted) ** 2).mean(axis=-1) * used).sum() / rays
    loss = error + settings.sparsity * (cauchy(jnp, density) * batch["valid"]).sum() / jnp.maximum(batch["valid"].sum(), 1)
    if has_alpha:
        loss = loss + settings.alpha * ((1 - through - alpha[:, 0]) ** 2 * used).sum() / rays
    return loss, error


def keep_memory() -> None:
    """Ask glibc to keep freed memory: XLA allocates the same temporaries every step, and above 32 MB glibc would
    map and fault them in afresh each time, which takes longer than the step. Elsewhere this does nothing."""
    if sys.platform != "linux":
        return
    try:
        libc = ctypes.CDLL(ctypes.util.find_library("c") or "libc.so.6")
        for option, value in ((-1, 2**31 - 1), (-3, 2**30), (-8, 1)):  # trim threshold, mmap threshold, one arena
            libc.mallopt(option, value)
    except (OSError, AttributeError):
        pass


def train(
    dataset: Dataset,
    settings: TrainSettings,
    folder: Path,
    progress: Progress = lambda fraction, what: None,
    resume: bool = False,
    save_every: float = 60.0,
) -> Field:
    """Train and keep the field in `folder`, saved each minute and when cancelled; `resume` goes on with what is there.

    Raises SnergError on bad input or when training goes wrong (then the last good state is on disk), Cancelled when
    `progress` does.
    """
    trainer = Trainer(dataset, settings, progress)
    if resume:
        old, state = read_field_and_state(folder)
        if state:
            trainer.restore(state, old.about.get("history", []))
    saved = time.perf_counter()
    try:
        for told in trainer.run():
            progress(told.fraction, f"Step {told.step}: {told.psnr:.2f} dB on training rays")
            if time.perf_counter() - saved > save_every:
                write_field(trainer.field(), folder, trainer.state())
                saved = time.perf_counter()
    except (Cancelled, KeyboardInterrupt, SnergError):
        if trainer.step:
            write_field(trainer.field(), folder, trainer.state())
        raise
    field = trainer.field()
    write_field(field, folder)  # without the optimiser: there is nothing to go on with, and it is five sixths of the file
    return field
