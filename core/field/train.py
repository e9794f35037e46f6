"""Training a deferred NeRF (section 4) in JAX: the one place that optimises the field."""

from __future__ import annotations

import ctypes
import ctypes.util
import math
import sys
import time
from ast import literal_eval
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from ..capture.dataset import Dataset
from ..errors import Cancelled, SnergError
from .checkpoint import read_field_and_state, write_field
from .field import Field
from .networks import ViewNetwork, init_params
from .optimise import learning_rate, train_step, zero_moments
from .packed import PackedScheme
from .pixels import PixelPool
from .sampling import hull
from .settings import TrainSettings

Progress = Callable[[float, str], None]


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
        self.rng = np.random.default_rng(settings.seed)
        self.scheme = PackedScheme(settings, self.pool, self.domain, alive, self.rng)
        self.params = jax.tree.map(jnp.asarray, init_params(settings.family, settings.view_dependence, False, self.rng))
        self.moments = zero_moments(self.params)
        self.step = 0
        self.elapsed = 0.0
        self.history: list[dict[str, float]] = []
        self.loss = self.error = 0.0
        self.bad = 0
        progress(0.0, "Compiling the training step")
        self._step = jax.jit(partial(train_step, settings, self.scheme.loss), donate_argnums=(0, 1))

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
        batch = self.scheme.batch(self.fraction())
        rate = learning_rate(self.settings, self.step, self.fraction())
        self.params, self.moments, report = self._step(self.params, self.moments, batch.arrays, rate, self.step + 1)
        self.step += 1
        self.scheme.learn(self.params, self.step)
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
        return batch.samples, batch.rays

    @property
    def psnr(self) -> float:
        """Of the training rays, dB, running mean."""
        return -10 * math.log10(max(self.error, 1e-10))

    def field(self) -> Field:
        """The field as trained so far."""
        view = self.params.get("view")
        return Field(
            family=self.settings.family,
            params=jax.tree.map(np.asarray, self.params["field"]),
            network=None if view is None else ViewNetwork(*(np.asarray(a) for a in view)),
            domain=self.domain,
            occupancy=self.scheme.occupied,
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
        arrays["clock"] = np.array([self.step, self.elapsed], np.float64)
        arrays["random"] = np.frombuffer(repr(self.rng.bit_generator.state).encode(), np.uint8)
        return arrays | self.scheme.state()

    def restore(self, state: dict[str, np.ndarray], history: list[dict[str, float]]) -> None:
        """Go on from a `state`. Raises SnergError when it is another network's."""
        leaves, tree = jax.tree.flatten((self.params, self.moments))
        kept = [state.get(f"leaf_{i:03d}") for i in range(len(leaves))]
        if any(k is None or k.shape != leaf.shape for k, leaf in zip(kept, leaves, strict=True)):
            raise SnergError("The field to go on with has another network than these settings; train into a new folder.")
        self.params, self.moments = jax.tree.unflatten(tree, [jnp.asarray(k) for k in kept])
        self.scheme.restore(state)
        self.step, self.elapsed = int(state["clock"][0]), float(state["clock"][1])
        self.rng.bit_generator.state = literal_eval(state["random"].tobytes().decode())
        self.history = list(history)


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
