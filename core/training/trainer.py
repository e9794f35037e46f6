"""Training a field in JAX: the loop that optimises it, and what it needs to stop at any moment and go on later."""

from __future__ import annotations

import ctypes
import ctypes.util
import math
import sys
import time
from ast import literal_eval
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np
from numpy.typing import NDArray

from ..data.dataset import HELD_OUT, Dataset
from ..data.load import read_split
from ..errors import Cancelled, SnergError
from ..geometry.ndc import Ndc
from ..io.files import SAVING
from ..io.guard import reading
from ..io.images import over, to_uint8
from ..nerf.checkpoint import read_field_and_state, write_field
from ..nerf.field import Field
from ..nerf.model import ViewNetwork, init_field, init_params, with_frequencies
from ..nerf.sampling import Domain, hull
from ..progress import Note, Progress, silent
from . import decisions, view_dependence_test
from .config import TrainSettings
from .decisions import Decision
from .hierarchical_sampler import HierarchicalSampler
from .log import Log
from .losses import plain_colour
from .non_finite import cause, not_finite
from .occupancy_sampler import Batch, OccupancySampler
from .optimizer import learning_rate, zero_moments
from .parallel import Devices
from .ray_dataset import RayDataset
from .silhouette import border_share, silhouette
from .validation import HELD_OUT_RAYS, Rays, some_views
from .weight_average import EVERY, Average

Masks = list[NDArray[Any] | None]
PATIENCE = 5  # steps in a row that are not finite end the training
SCORE_EVERY, SCORE_SHARE = 20.0, 0.01  # seconds between two looks at held-out rays, and the share of the time that they may take
SAVE_SHARE = 0.02  # of the time may go into saving
TELL_EVERY = 0.2  # seconds; how long Ctrl-C may wait while steps go on


class Sampler(Protocol):
    """A way to sample rays: what a step's batch and loss are."""

    settings: TrainSettings
    """With what they leave open decided."""
    occupied: NDArray[Any]

    def batch(self, params: Any, fraction: float) -> Batch:
        """A step's rays and samples; `fraction` of the training is done."""

    def loss(self, params: Any, batch: dict[str, Any]) -> tuple[Any, dict[str, Any]]:
        """(loss, what else is told: "error", the squared error of colour, and what `learn` wants), sums over what is in the
        batch divided by numbers that the batch holds; traced."""

    def learn(self, params: Any, step: int, told: dict[str, Any]) -> None:
        """After each step: what the sampling takes from the parameters, and from what the loss told beside itself."""

    def colours(self, params: Any, rays: Rays, fraction: float) -> NDArray[Any]:
        """Colours [R, 3] of rays over their background, as the field is sampled now."""

    def state(self) -> dict[str, NDArray[Any]]:
        """All that `restore` needs beside the parameters."""

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Undo `state`."""


@dataclass(frozen=True)
class TrainProgress:
    """fraction of the whole, step, loss and psnr (dB, of the training rays, running mean), seconds, rays and samples of the last
    step, its learning rate; held_out: dB of rays of views that are not trained on, None where there are none or none were scored
    yet."""

    fraction: float
    step: int
    loss: float
    psnr: float
    seconds: float
    rays: int
    samples: int
    rate: float
    held_out: float | None = None

    def text(self) -> str:
        """For people."""
        held = "" if self.held_out is None else f", {self.held_out:.2f} dB on held-out views"
        return f"Step {self.step}: {self.psnr:.2f} dB on training rays{held}"


class Trainer:
    """A field on its way: parameters, optimiser, samples, random state.

    settings.steps makes training exact: the same steps give the same bytes, stopped and resumed or not (on one CPU device).
    Settings in seconds follow the clock, and where the clock stands at a step is never the same twice.
    """

    def __init__(self, dataset: Dataset, settings: TrainSettings, progress: Progress = silent, held_out: Dataset | None = None) -> None:
        """held_out: views to score now and then and never to learn from."""
        keep_memory()
        self.settings, self.dataset, self.devices = settings, dataset, Devices()
        self.decisions: list[Decision] = []
        masks = masks_of(dataset)
        self.pool = self._read(masks, progress)
        self.domain, self.ndc, alive = self._space(masks, progress)
        self.pool.domain, self.pool.ndc = self.domain, self.ndc
        self.rng = np.random.default_rng(settings.seed)
        self.scheme = self._sample(alive)
        self.undecided = settings.view_dependence == "auto"
        self.view = "deferred" if self.undecided else settings.view_dependence
        self.aside = view_dependence_test.set_aside(len(dataset.views)) if self.undecided else np.zeros(len(dataset.views), bool)
        self.pool.withheld = self.aside.copy()
        params = init_params(settings.family, settings.view_dependence, self.scheme.settings.hierarchy == "on", self.rng)
        self.params = self.devices.place(with_frequencies(params, settings.view_degrees))
        self.moments = self.devices.place(zero_moments(self.devices.local(self.params)))
        self.average = Average()
        self.held_out = None if held_out is None else self._held_out(held_out)
        self.step, self.elapsed, self.bad = 0, 0.0, 0
        self.stopping = False  # told to, where there are other processes to stop with
        self.loss = self.error = self.rate = 0.0
        self.samples = self.rays = 0
        self.score: float | None = None
        progress(0.0, "Compiling the training step")
        self._step = self.devices.step(settings, self.scheme.loss)

    def _read(self, masks: Masks, progress: Progress) -> RayDataset:
        """All pixels, and whether their alpha counts."""
        data, count = self.dataset, len(self.dataset.views)

        def images(flat: bool) -> Iterator[NDArray[Any]]:
            for i in range(count):
                progress(0.0, f"Reading image {i + 1} of {count}")
                yield to_uint8(over(data.read(i))) if flat else data.read(i)

        flat = self.settings.transparency == "off"
        domain = decisions.suggested(data.suggested_box())
        pool = RayDataset(images(flat), data.cameras, domain, masks)
        self.decide(decisions.transparency(self.settings.transparency, pool.pixels, pool.alpha))
        return RayDataset(images(True), data.cameras, domain, masks) if pool.alpha and not self.decisions[-1].chosen else pool

    def _space(self, masks: Masks, progress: Progress) -> tuple[Domain, Ndc | None, NDArray[Any]]:
        """Where the scene is: the field's domain, its device coordinates if it has any, and the cells that may hold something."""
        data = self.dataset
        decision, ndc = decisions.forward_facing(self.settings.ndc, data.cameras, data.points, data.bounds, self.pool.alpha)
        self.decide(decision)
        if ndc is not None:
            domain, alive = decisions.seen_in_ndc(ndc, data.cameras)
            return domain, ndc, alive
        progress(0.0, "Carving the visual hull")
        domain, alive = hull(data.suggested_box(), data.cameras, self._silhouettes(masks))
        return domain, None, alive

    def _silhouettes(self, masks: Masks) -> Sequence[NDArray[Any] | None]:
        """Where each image shows the scene, bool [H, W], None where it does not say: by its alpha, or before a plain backdrop."""
        cameras, background = self.dataset.cameras, plain_colour(self.settings.background)
        ends = zip(self.pool.starts, self.pool.ends, cameras, strict=True)
        images = [self.pool.pixels[start:end].reshape(c.height, c.width, 4) for start, end, c in ends]
        known = [] if background is None or self.pool.alpha else [border_share(i[..., :3], background) for i in images]
        decision = decisions.backdrop(self.settings.backdrop, known, self.pool.alpha, self.settings.background)
        self.decide(decision)
        if self.pool.alpha:
            found = [i[..., 3] > 0 for i in images]
        elif decision.chosen and background is not None:
            found = [silhouette(i[..., :3], background) for i in images]
        else:
            return [None] * len(images)
        # Nobody knows what is behind a mask: it carves nothing.
        found = [f if mask is None else f | ~mask for f, mask in zip(found, masks, strict=True)]
        self.pool.keep_near(found, masks)
        return found

    def _sample(self, alive: NDArray[Any]) -> Sampler:
        """The scheme that the settings name, with what it leaves open decided."""
        origins, directions, near, *_ = self.pool.rays(self.pool.draw(1024, np.random.default_rng(self.settings.seed)))
        rays = origins, directions, near
        self.decide(decisions.sampling(self.settings, self.domain, alive, *rays))
        if self.settings.sampler == "packed":
            return OccupancySampler(self.settings, self.pool, self.domain, alive, self.rng)
        hierarchy = "on" if self.decisions[-1].chosen else "off"
        self.decide(decisions.disparity(self.settings.distances, self.domain, *rays, self.ndc is not None))
        disparity = "disparity" if self.decisions[-1].chosen else "linear"
        return HierarchicalSampler(
            replace(self.settings, distances=disparity, hierarchy=hierarchy), self.pool, self.domain, alive, self.rng
        )

    def _held_out(self, data: Dataset) -> Rays:
        images = (data.read(i) for i in range(len(data.views)))
        pool = RayDataset(images, data.cameras, self.domain, masks_of(data), self.ndc)
        return Rays(pool, None, HELD_OUT_RAYS, self.settings)

    def decide(self, decision: Decision) -> None:
        """Note a decision; with that on view dependence, the views set aside come back."""
        self.decisions.append(decision)
        if decision.effect == view_dependence_test.EFFECT:
            self.undecided, self.view = False, str(decision.chosen)
            self.pool.withheld[:] = False

    def fraction(self) -> float:
        """How much of the training is done, 0..1."""
        if self.settings.steps is not None:
            return min(self.step / self.settings.steps, 1.0)
        return min(self.elapsed / float(self.settings.seconds or 1), 1.0)

    def run(self) -> Iterator[TrainProgress]:
        """Train to the end, telling how it goes every TELL_EVERY seconds. Close the generator to stop; the trainer stays whole.

        Raises SnergError when several steps in a row are not finite; the parameters are those before them.
        """
        began, told, scored = time.perf_counter() - self.elapsed, 0.0, self.elapsed
        compiled = False
        while self.fraction() < 1:
            if self.undecided and self.fraction() >= view_dependence_test.AT:
                view_dependence_test.run(self)
            self.advance()
            if not compiled:  # the first step is mostly compiling, which is set-up as reading the images is
                compiled, began = True, time.perf_counter() - self.elapsed
            self.elapsed = self._agreed(time.perf_counter() - began)
            ended = self.fraction() >= 1
            if self.held_out is not None and (ended or self.elapsed - scored > SCORE_EVERY):
                self.score = decibels(float(self.errors(self.held_out).mean()))
                took = time.perf_counter() - began - self.elapsed
                scored = self.elapsed + max(took / SCORE_SHARE - SCORE_EVERY, 0)
            if ended or self.elapsed - told > TELL_EVERY:
                told = self.elapsed
                yield self.told()

    def _agreed(self, elapsed: float) -> float:
        """The seconds that count in all processes. Raises Cancelled in all of them when one is `stopping`."""
        elapsed, stop = self.devices.agreed(elapsed, self.stopping)
        if stop:
            self.devices.leave()
            raise Cancelled("Stopped together with the other processes of this training; start them all again to go on.")
        return elapsed

    def told(self) -> TrainProgress:
        """How it goes."""
        return TrainProgress(self.fraction(), self.step, self.loss, self.psnr, self.elapsed, self.rays, self.samples, self.rate, self.score)

    def advance(self) -> None:
        """One step. Raises SnergError as `run` does."""
        fraction = self.fraction()
        batch = self.scheme.batch(self.devices.local(self.params), fraction)
        self.rate = learning_rate(self.settings, self.step, fraction)
        arrays = self.devices.feed(self.settings, batch.arrays)
        self.params, self.moments, report = self._step(self.params, self.moments, arrays, self.rate, self.step + 1)
        self.step += 1
        loss, told, finite = self.devices.local(report)
        self.scheme.learn(self.devices.local(self.params), self.step, told)
        loss, error, finite = float(loss), float(told["error"]), bool(finite)
        self.samples, self.rays = batch.samples, batch.rays
        self.bad = 0 if finite else self.bad + 1
        if self.bad >= PATIENCE:
            why = cause(self.scheme.loss, self.devices.local(self.params), batch.arrays)
            raise SnergError(f"Training went wrong at step {self.step - self.bad + 1}, and {PATIENCE} times in a row: {why}.")
        if finite:
            if fraction >= 1 - self.settings.average and self.step % EVERY == 0:
                self.average.add(self.devices.local(self.params))
            keep = 0.98 if self.loss else 0.0
            self.loss = keep * self.loss + (1 - keep) * loss
            self.error = keep * self.error + (1 - keep) * error

    def errors(self, rays: Rays) -> NDArray[Any]:
        """Squared errors [R] of rays, as the field is now."""
        return rays.errors(self.scheme.colours(self.best(), rays, self.fraction()))

    def best(self) -> Any:
        """The parameters that a field has: their mean over the last steps, once there is one."""
        return self.devices.local(self.params) if self.average.mean is None else self.average.mean

    @property
    def psnr(self) -> float:
        """Of the training rays, dB, running mean."""
        return decibels(self.error)

    def field(self) -> Field:
        """The field as trained so far; without features where it is diffuse."""
        params = jax.tree.map(np.asarray, self.best())
        network = ViewNetwork(*params["view"]) if "view" in params and self.view != "diffuse" else None
        if self.settings.view_dependence == "auto" and self.view == "diffuse":
            shapes = init_field(self.settings.family, "diffuse", np.random.default_rng(0))["field"]
            params["field"] = jax.tree.map(lambda a, like: a[..., : like.shape[-1]], params["field"], shapes)
        return Field(
            family=self.settings.family,
            params=params["field"],
            network=network,
            domain=self.domain,
            occupancy=self.scheme.occupied,
            spacing=self.settings.spacing,
            cameras=self.dataset.cameras,
            dataset=str(self.dataset.root.resolve()),
            about={
                "settings": asdict(self.settings),
                "dataset_options": asdict(self.dataset.options),
                "decisions": [d.to_json() for d in self.decisions],
                "steps": self.step,
                "seconds": round(self.elapsed, 2),
                "psnr_training_rays": round(self.psnr, 3) if self.step else None,
                "psnr_held_out_rays": None if self.score is None else round(self.score, 3),
            },
            ndc=self.ndc,
            view=self.view,
        )

    def state(self) -> dict[str, NDArray[Any]]:
        """All that `restore` needs to go on where this trainer stands, as arrays of its own.

        Raises SnergError when the optimiser holds something that is not finite (hard case 27).
        """
        kept = self.devices.local((self.params, self.moments))
        if broken := not_finite(kept):
            raise SnergError(
                f"Training went wrong by step {self.step}: {broken} is not finite; go on with a lower learning rate (setting rate)."
            )
        arrays = {f"leaf_{i:03d}": np.array(leaf) for i, leaf in enumerate(jax.tree.leaves(kept))}
        arrays["clock"] = np.array([self.step, self.elapsed, self.loss, self.error, self.bad], np.float64)
        arrays["random"] = np.frombuffer(repr(self.rng.bit_generator.state).encode(), np.uint8)
        arrays["decided"] = np.frombuffer(b"" if self.undecided else self.view.encode(), np.uint8)
        return arrays | self.average.state() | {name: np.array(value) for name, value in self.scheme.state().items()}

    def restore(self, state: dict[str, NDArray[Any]], decisions: list[dict[str, Any]] | None = None) -> None:
        """Go on from a `state`, and the decisions as `field().about` has them. Raises SnergError when it is another network's."""
        leaves, tree = jax.tree.flatten((self.params, self.moments))
        kept = [state.get(f"leaf_{i:03d}") for i in range(len(leaves))]
        if any(k is None or k.shape != leaf.shape for k, leaf in zip(kept, leaves, strict=True)) or len(state.get("clock", ())) != 5:
            raise SnergError("The field to go on with has another network than these settings; train into a new folder.")
        self.params, self.moments = self.devices.place(jax.tree.unflatten(tree, kept))
        self.average.restore(state, self.devices.local(self.params))
        self.scheme.restore(state)
        self.step, self.bad = int(state["clock"][0]), int(state["clock"][4])
        self.elapsed, self.loss, self.error = (float(x) for x in state["clock"][1:4])
        self.rng.bit_generator.state = literal_eval(state["random"].tobytes().decode())
        self.decisions = [d for d in self.decisions if d.effect != view_dependence_test.EFFECT]
        if self.settings.view_dependence == "auto":
            self.undecided = not len(state["decided"])
            self.view = "deferred" if self.undecided else state["decided"].tobytes().decode()
        self.pool.withheld = self.aside.copy() if self.undecided else np.zeros_like(self.aside)
        for known in decisions or []:
            if known["effect"] == view_dependence_test.EFFECT:
                self.decide(Decision(**known))


def decibels(error: float) -> float:
    """PSNR of a mean squared error, 100 where there is next to none (hard case 30)."""
    return -10 * math.log10(max(error, 1e-10))


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


def masks_of(dataset: Dataset) -> Masks:
    """What is to be used of each view, bool [H, W], None for all of it."""
    return [dataset.mask(i) for i in range(len(dataset.views))]


def held_out_of(dataset: Dataset) -> Dataset | None:
    """Views of the same scene that `dataset` does not have: some of its 'val' or 'test' split, None where there is none."""
    for split in HELD_OUT:
        if split in dataset.splits() and split != dataset.split:
            try:
                return some_views(read_split(dataset, split))
            except SnergError:
                continue  # images that training does not need
    return None


def writes() -> bool:
    """Whether this process is the one of its training that writes."""
    return bool(jax.process_index() == 0)


def train(
    dataset: Dataset,
    settings: TrainSettings,
    folder: Path,
    progress: Progress = silent,
    resume: bool = False,
    save_every: float = 60.0,
) -> Field:
    """Train and keep the field and its log in `folder`, saved each minute and when cancelled; `resume` goes on with what is there.

    A kill at any moment costs what was trained since the last save. Of several processes only the first writes. Raises SnergError
    on bad input or when training goes wrong (then the last good state is on disk), Cancelled when `progress` does.
    """
    trainer = Trainer(dataset, settings, progress, held_out_of(dataset))
    if resume:
        old, state = read_field_and_state(folder)
        if state:
            with reading(folder, "train into a new folder", f"The training state in {folder}"):
                trainer.restore(state, old.about.get("decisions"))
    for decision in trainer.decisions:
        progress(trainer.fraction(), Note(decision.text()))
    keeper = Keeper(trainer, folder, save_every) if trainer.devices.writes else None
    known = len(trainer.decisions)
    tell = progress if trainer.devices.processes == 1 else _together(trainer, progress)
    try:
        with closing(trainer.run()) as run:  # type: ignore[type-var]
            for told in run:
                tell(told.fraction, told.text())
                for decision in trainer.decisions[known:]:
                    tell(told.fraction, Note(decision.text()))
                known = len(trainer.decisions)
                if keeper:
                    keeper(told)
    except (Cancelled, KeyboardInterrupt):
        if keeper and trainer.step:
            keeper.save()
        raise
    except RuntimeError as error:  # JAX's: the connection to another process broke
        if trainer.devices.processes == 1:
            raise
        why = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise SnergError(f"Another process of this training is gone ({why}); start them all again to go on from the last save.") from error
    except SnergError:
        with suppress(SnergError):  # whatever hinders saving, what went wrong first is what to tell
            if keeper and trainer.step:
                keeper.save()
        raise
    field = trainer.field()
    if keeper:
        with SAVING:
            write_field(field, folder)  # without the optimiser: there is nothing to go on with, and it is five sixths of the file
    return field


def _together(trainer: Trainer, progress: Progress) -> Progress:
    """Progress of one of several processes: told to stop, it stops with the others after a step, or they would wait for it."""

    def tell(fraction: float, what: str, /) -> None:
        try:
            progress(fraction, what)
        except Cancelled:
            trainer.stopping = True

    return tell


class Keeper:
    """Logs about every two seconds, and saves each `save_every` seconds or less often, so that it takes little of the time."""

    def __init__(self, trainer: Trainer, folder: Path, save_every: float) -> None:
        self.trainer, self.folder, self.save_every = trainer, folder, save_every
        self.log = Log(folder, trainer.step)
        self.saved, self.cost = time.perf_counter(), 0.0
        self.logged = -math.inf
        self.scored = trainer.score

    def __call__(self, told: TrainProgress) -> None:
        """After some steps."""
        at = {"step": told.step, "seconds": round(told.seconds, 2)}
        if told.seconds - self.logged > 2 or told.fraction >= 1:
            self.logged = told.seconds
            line = {"fraction": round(told.fraction, 5), "loss": told.loss, "psnr": round(told.psnr, 3), "rate": told.rate}
            self.log.add(**at, **line, samples=told.samples, rays=told.rays)
        if told.held_out is not None and told.held_out != self.scored:
            self.scored = told.held_out
            self.log.add(**at, held_out_psnr=round(told.held_out, 3))
        if time.perf_counter() - self.saved > max(self.save_every, self.cost / SAVE_SHARE):
            self.save()

    def save(self) -> None:
        """Put the trainer's field and state on disk in place of the last, whole."""
        began = time.perf_counter()
        with SAVING:
            write_field(self.trainer.field(), self.folder, self.trainer.state())
        self.saved = time.perf_counter()
        self.cost = self.saved - began
