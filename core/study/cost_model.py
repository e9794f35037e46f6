"""What a bake, its export and a preview, or a training, will take: before they begin.

`estimate` counts what each stage has to go through, from a survey of the field (survey.py), in a few milliseconds: it can be asked
while a box is dragged. Every number says in `estimate` or `training` what it supposes.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..baking.bake import AUTO_SUPERSAMPLING, BakeSettings, check_voxel_size
from ..baking.memory import count_blocks
from ..baking.occupied_voxels import candidate_blocks
from ..baking.supersampling import MAX_SUPERSAMPLING, REFERENCE_SAMPLES_PER_VOXEL, TEST_RAY_VOXELS, TEST_RAYS
from ..data.dataset import Dataset
from ..geometry.box import Box
from ..nerf.field import Field
from ..nerf.model import init_field
from ..nerf.sampling import Domain
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.voxel_grid import VoxelGrid
from ..training.config import TrainSettings
from .field_probe import FieldProbe, rays_of

USUAL = BakeSettings()
BARE = 6.0  # samples that take as long as all else that a ray takes
COLD = 0.1  # power of the resolution with which a sample's own time grows: what it reads is further apart
BEGUN = 0.08  # seconds of a bake's first stage, however little there is
# Of memory, measured: bytes that a bake takes whatever its size, and times its cells: themselves, the file where they were kept, and as
# pictures. The system can take some of it back; memory.py, which refuses what would not fit, counts only what it cannot.
PROCESS, HELD = 330e6, 3.0
BESIDE = 1.12  # of the time of filling voxels one after another, with moving them, and what the caches do not hold any more
CLOSER = 0.85  # of the time of a ray where it is timed: in a large picture rays are closer together
ALIKE = 0.06  # bytes of a voxel fall with the resolution to this power: its neighbours are more like it
FEW = 8  # points in a box that weigh as much as all others do
REFINED, FIT = 1_000_000, 2.0  # pixels that refining marches, twice what RefineSettings says: they lie apart; and seconds of its fit
STEP = 4.0  # queries that a training step costs a sample: forth, back, and the optimiser
SET_UP = 8.0  # seconds before the first step beside reading images: carving the hull, compiling
TRAINING, PIXEL = 750e6, 8  # bytes of any training, and of one of its pixels


@dataclass(frozen=True)
class Estimate:
    """seconds: of each stage of a bake. peak_megabytes: of memory. megabytes: of the scene as PNG. preview: seconds of a picture;
    tables: seconds before the first one. looked, held, kept: voxels; blocks, samples: as in a bake's own report."""

    seconds: dict[str, float]
    peak_megabytes: float
    megabytes: float
    preview: float
    tables: float
    looked: int
    held: int
    kept: int
    blocks: int
    samples: int

    @property
    def bake(self) -> float:
        """Seconds of the whole bake, without refining."""
        return sum(value for name, value in self.seconds.items() if name != "refine")

    def to_json(self) -> dict[str, Any]:
        """JSON values, seconds and megabytes to what can be told."""
        rounded = {name: round(value, 3) for name, value in self.seconds.items()}
        sizes = {"peak_megabytes": round(self.peak_megabytes), "megabytes": round(self.megabytes, 1)}
        times = {"preview": round(self.preview, 4), "tables": round(self.tables, 3)}
        return {"bake_seconds": round(self.bake, 2), **asdict(self), "seconds": rounded, **sizes, **times}


def estimate(
    survey: FieldProbe, box: Box, settings: BakeSettings = USUAL, refine: bool = True, size: tuple[int, int] = (800, 800)
) -> Estimate:
    """What a bake with `bake_field` will take, and a preview of `size` pixels, on this machine as busy as it was when surveyed.

    What is counted, in the box: looked, held and kept voxels, as many as points of the survey say (what a box cuts off is gone, that
    it opens the view into what it cuts through is left out); blocks, those that meet what the small bake found full.
    peak_megabytes: HELD times the cells, and PROCESS. megabytes: a kept voxel takes as many bytes as in the small bake,
    times the resolution's ratio to the power -ALIKE; float cells are whole. preview: as many pixels see something as in the small
    bake's pictures, and each takes as long, times CLOSER and what more samples take (`slower`). Seconds: see `_seconds`.
    Raises SnergError for voxels so small that there would be too many, and for their size in device coordinates.
    """
    rates, field = survey.rates, survey.field
    check_voxel_size(settings, field)
    voxel_grid = VoxelGrid.inside(box, settings.voxel_size or float(box.size.max()) / settings.resolution)
    inside = box.contains(survey.points)
    volume = survey.share / voxel_grid.voxel_size**3
    held, kept = (volume * _points(survey, table, inside, voxel_grid.voxel_size) for table in (survey.held, survey.kept))
    if not (settings.visibility and field.cameras):
        kept = held
    cubes = survey.filled[0][box.contains(survey.filled[0])]
    blocks = count_blocks((cubes, survey.filled[1]), voxel_grid) if len(cubes) else 0
    channels = 8 if settings.network and field.network is not None else 4
    cells = blocks * CELL_VOXELS**3 * channels * (1 if settings.quantise else 4)
    finer = survey.pilot / voxel_grid.voxel_size
    ray = rates.ray * slower(rates.met, rates.growth, finer)
    coded = kept * rates.bytes * finer**-ALIKE * channels / (8 if field.network is not None else 4)
    looked = volume * int((survey.inside & inside).sum())
    samples = settings.samples or survey.samples[int(np.abs(np.log(survey.voxels / voxel_grid.voxel_size)).argmin())]
    seconds = _seconds(survey, voxel_grid, settings, looked, kept, samples)
    if refine and channels == 8 and field.dataset:
        seconds["refine"] = FIT + rates.view * len(field.cameras) + ray * REFINED
    return Estimate(
        seconds,
        (PROCESS + HELD * cells) / 1e6,
        (coded if settings.quantise else cells) / 1e6,
        rates.view + CLOSER * size[0] * size[1] * ray,
        blocks * rates.table,
        int(looked),
        int(held),
        int(kept),
        blocks,
        int(samples),
    )


def slower(met: float, growth: float, finer: float) -> float:
    """How much longer a ray takes in voxels so much finer, where it takes `met` samples, which grow with the resolution to a power."""
    return (BARE + met * finer ** (growth + COLD)) / (BARE + met)


def _seconds(
    survey: FieldProbe, voxel_grid: VoxelGrid, settings: BakeSettings, looked: float, kept: float, samples: int
) -> dict[str, float]:
    """Of the stages of a bake.

    start: compiling takes as long as it did. occupancy: BEGUN; a voxel of a block that meets an occupied cell is tested, one in an
    occupied cell is asked for. visibility: see `_looking`. samples: where they are chosen, all rays are tried with each number up to
    twice the chosen one. prefilter: kept voxels, and samples of them, times BESIDE.
    """
    rates = survey.rates
    tried = (
        TEST_RAYS * TEST_RAY_VOXELS * (REFERENCE_SAMPLES_PER_VOXEL + 8 * (min(4 * samples, 2 * MAX_SUPERSAMPLING) - 1))
        if settings.samples == AUTO_SUPERSAMPLING
        else 0
    )
    return {
        "start": rates.start,
        "occupancy": BEGUN + rates.test * int(candidate_blocks(survey.coarse, voxel_grid).sum()) * DATA_VOXELS**3 + rates.query * looked,
        "visibility": _looking(survey, voxel_grid) if settings.visibility else 0.0,
        "samples": rates.fill * tried,
        "prefilter": BESIDE * kept * (rates.keep + samples * rates.fill),
    }


def _looking(survey: FieldProbe, voxel_grid: VoxelGrid) -> float:
    """Of finding out, on half of the resolution, what the cameras see: each of them, and its rays but for their samples, takes as long
    as in the small bake."""
    rates, finer = survey.rates, survey.pilot / voxel_grid.halved().voxel_size
    look = rates.look * slower(rates.seen_met, rates.seen_growth, finer)
    return rates.eye * len(survey.field.cameras) + look * rays_of(survey.field, voxel_grid)


def _points(survey: FieldProbe, table: NDArray[Any], inside: NDArray[Any], voxel: float) -> float:
    """How many of the points inside a box a table [S, M] says yes to, between its voxel sizes; by all points where few are inside."""
    count = int(inside.sum())
    here, all_ = table[:, inside].sum(axis=1), table.mean(axis=1)
    share = (here + FEW * all_) / (count + FEW)
    order = np.argsort(survey.voxels)
    return count * float(np.interp(np.log(voxel), np.log(survey.voxels[order]), share[order]))


def training(dataset: Dataset, settings: TrainSettings) -> dict[str, Any]:
    """What a training will take: {"seconds", "set_up_seconds", "steps", "step_seconds", "peak_megabytes"} (JAX).

    A step costs a sample as much as STEP queries of a field of the same kind, which are timed. Set-up: all images are read as
    quickly as the first, and SET_UP seconds beside. Memory: TRAINING bytes, and PIXEL bytes a pixel.
    """
    samples = settings.samples if settings.sampler == "packed" else settings.rays * (settings.coarse + settings.coarse + settings.fine)
    step = STEP * samples * query_seconds(settings)
    began = time.perf_counter()
    dataset.read(0)
    reading = (time.perf_counter() - began) * len(dataset.views)
    seconds = settings.steps * step if settings.steps is not None else float(settings.seconds or 0)
    pixels = sum(camera.width * camera.height for camera in dataset.cameras)
    return {
        "seconds": round(seconds, 1),
        "set_up_seconds": round(SET_UP + reading, 1),
        "steps": settings.steps if settings.steps is not None else int(seconds / step),
        "step_seconds": round(step, 5),
        "peak_megabytes": round((TRAINING + PIXEL * pixels) / 1e6),
    }


def query_seconds(settings: TrainSettings, points: int = 2**17) -> float:
    """Seconds that a point takes of a field that is about to be trained so."""
    rng = np.random.default_rng(0)
    params = init_field(settings.family, "deferred", rng)["field"]
    domain = Domain.around(np.full(3, -1.0), np.full(3, 1.0))
    field = Field(settings.family, params, None, domain, None, settings.spacing)
    x = rng.uniform(-1, 1, (points, 3)).astype(np.float32)
    field.evaluate(x[:1])
    began = time.perf_counter()
    field.evaluate(x)
    return (time.perf_counter() - began) / points
