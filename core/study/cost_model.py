"""The cost model: the time, memory and bytes of a bake, its files and a preview, before they begin.

`estimate` counts the voxels, blocks and samples that each stage processes, from a field probe (field_probe.py), and multiplies them with
the times that the probe measured and with coefficients (coefficients.py). It takes milliseconds, so that it follows a box that is dragged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..baking.bake import AUTO_SUPERSAMPLING, BakeSettings, check_voxel_size
from ..baking.finish import DEFAULT_FINISHING, FINISHING_STAGES, Finishing
from ..baking.memory import count_blocks
from ..baking.occupied_voxels import candidate_blocks
from ..baking.prune import PRUNING_PIXELS
from ..baking.ray_samples import FIT_PASSES, FIT_PIXELS, FIT_RAYS
from ..baking.supersampling import MAX_SUPERSAMPLING, REFERENCE_SAMPLES_PER_VOXEL, TEST_RAY_VOXELS, TEST_RAYS
from ..export.codecs import PNG, CodecSettings
from ..geometry.box import Box
from ..scene.blocks import CELL_VOXELS, DATA_VOXELS
from ..scene.voxel_grid import VoxelGrid
from .coefficients import DEFAULT_COEFFICIENTS, Coefficients
from .field_probe import FieldProbe, visibility_rays

DEFAULT_BAKE = BakeSettings()
HIT_SHARE = 0.4  # of a training view's pixels, about, that hit the scene
PRIOR_POINTS = 8  # weight of the whole field's share, in points, against that of the points inside a box: matters for small boxes
# Bytes of lossless codecs over those of PNG, of colours with alpha and of features: two scenes of 300 and 500 voxels.
BYTES_OVER_PNG = {"png": (1.0, 1.0), "webp": (0.8, 0.94), "jxl": (0.72, 0.84)}
HALF_OVER_WHOLE = 0.17  # bytes of features at half the resolution over those of PNG at the whole one, with any of these codecs
DEFERRED_CHANNELS, DIFFUSE_CHANNELS = 8, 4  # bytes of a voxel: RGB, alpha, and 4 features where the field is view-dependent


@dataclass(frozen=True)
class Estimate:
    """What a bake, its files and a preview take. The names are keys of what `snerg estimate --json` prints."""

    seconds: dict[str, float]  # of each stage of the bake
    peak_megabytes: float  # of memory during the bake and its finishing
    megabytes: float  # of the scene stored with a lossless codec
    preview: float  # seconds of a rendered picture
    tables: float  # seconds of building the acceleration structure, before the first picture
    looked: int  # voxels at which the bake evaluates the field
    held: int  # voxels that hold something or border on one that does
    kept: int  # voxels of those that a camera sees
    blocks: int  # blocks of the atlas
    samples: int  # samples a voxel

    @property
    def bake(self) -> float:
        """Seconds of the whole bake, without its finishing."""
        return sum(value for name, value in self.seconds.items() if name not in FINISHING_STAGES)

    @property
    def finishing(self) -> float:
        """Seconds of pruning, fitting and fine-tuning."""
        return sum(value for name, value in self.seconds.items() if name in FINISHING_STAGES)

    def to_json(self) -> dict[str, Any]:
        """JSON values, with seconds and megabytes rounded to significant digits."""
        rounded = {name: round(value, 3) for name, value in self.seconds.items()}
        sizes = {"peak_megabytes": round(self.peak_megabytes), "megabytes": round(self.megabytes, 1)}
        times = {"preview": round(self.preview, 4), "tables": round(self.tables, 3)}
        whole = {"bake_seconds": round(self.bake, 2), "finishing_seconds": round(self.finishing, 2)}
        return {**whole, **asdict(self), "seconds": rounded, **sizes, **times}


@dataclass(frozen=True)
class _Counts:
    """What a bake processes."""

    grid: VoxelGrid
    queried: float  # voxels inside occupied cells
    held: float
    kept: float
    blocks: int
    samples: int
    channels: int
    finer: float  # voxel size of the probe's small bake over that of this bake


def estimate(
    probe: FieldProbe,
    box: Box,
    settings: BakeSettings = DEFAULT_BAKE,
    finishing: Finishing = DEFAULT_FINISHING,
    size: tuple[int, int] = (800, 800),
    coefficients: Coefficients = DEFAULT_COEFFICIENTS,
    codec: CodecSettings = PNG,
) -> Estimate:
    """The cost of a bake with `bake_field` and of a preview of `size` pixels, on this machine under the same load as during the probe.

    finishing: what is done after the bake; pruning takes time, but how many bytes it saves is not modelled. Files: a kept voxel takes as
    many bytes as the probe measured at the nearest voxel sizes, times `over_png`; a scene of floats is not compressed. Preview: the same
    share of pixels meets the scene as in the small bake. Not modelled: that a box which cuts through the field uncovers voxels. Raises
    SnergError for voxels so small that there would be too many, and for a voxel size in normalised device coordinates.
    """
    counts, rates, field = _count(probe, box, settings), probe.rates, probe.field
    atlas_bytes = counts.blocks * CELL_VOXELS**3 * counts.channels * (1 if settings.quantise else 4)
    ray = rates.preview_ray * ray_slowdown(rates.preview_samples, rates.preview_growth, counts.finer, coefficients)
    channels = DIFFUSE_CHANNELS if field.network is None else DEFERRED_CHANNELS  # of what the probe measured
    png_bytes = counts.kept * _at(probe, probe.kept_bytes, counts.grid.voxel_size) * counts.channels / channels
    seconds = _stage_seconds(probe, counts, settings, coefficients)
    seconds |= _finishing_seconds(probe, finishing, counts.channels == DEFERRED_CHANNELS, ray, coefficients)
    return Estimate(
        seconds=seconds,
        peak_megabytes=_peak_bytes(probe, counts, atlas_bytes, seconds, coefficients) / 1e6,
        megabytes=(png_bytes * over_png(codec, counts.channels) if settings.quantise else atlas_bytes) / 1e6,
        preview=rates.preview_view + coefficients.preview_factor * size[0] * size[1] * ray,
        tables=counts.blocks * rates.acceleration_block,
        looked=int(counts.queried),
        held=int(counts.held),
        kept=int(counts.kept),
        blocks=counts.blocks,
        samples=counts.samples,
    )


def over_png(codec: CodecSettings, channels: int) -> float:
    """Bytes of a scene stored with a codec over those with PNG; 1 for lossy codecs. channels: of a voxel; half of PNG's are features."""
    colours, features = BYTES_OVER_PNG.get(codec.name, (1.0, 1.0))
    if channels == DIFFUSE_CHANNELS:
        return colours
    return (colours + (HALF_OVER_WHOLE if codec.half_features else features)) / 2


def _count(probe: FieldProbe, box: Box, settings: BakeSettings) -> _Counts:
    """Voxels by the share of the probe's points, blocks by the cubes that the small bake found occupied. Raises as `estimate`."""
    field = probe.field
    check_voxel_size(settings, field)
    grid = VoxelGrid.inside(box, settings.voxel_size or float(box.size.max()) / settings.resolution)
    inside = box.contains(probe.points)
    voxels_per_point = probe.share / grid.voxel_size**3
    held, kept = (voxels_per_point * _points_inside(probe, flags, inside, grid.voxel_size) for flags in (probe.held, probe.kept))
    if not (settings.visibility and field.cameras):
        kept = held
    centres, cube_size = probe.filled
    cubes = centres[box.contains(centres)]
    return _Counts(
        grid=grid,
        queried=voxels_per_point * int((probe.inside & inside).sum()),
        held=held,
        kept=kept,
        blocks=count_blocks((cubes, cube_size), grid) if len(cubes) else 0,
        samples=int(settings.supersampling or probe.samples[int(np.abs(np.log(probe.voxels / grid.voxel_size)).argmin())]),
        channels=DEFERRED_CHANNELS if settings.network and field.network is not None else DIFFUSE_CHANNELS,
        finer=probe.pilot / grid.voxel_size,
    )


def ray_slowdown(samples: float, growth: float, finer: float, coefficients: Coefficients = DEFAULT_COEFFICIENTS) -> float:
    """The ratio of a ray's marching time in a bake with voxels 1 / finer as long as those of the small bake, to its time in the small bake.

    samples: mean samples per ray in the small bake. growth: the exponent g in samples ~ resolution^g (see field_probe.sample_growth).
    """
    overhead = coefficients.ray_overhead
    return float((overhead + samples * finer ** (growth + coefficients.sample_growth)) / (overhead + samples))


def _stage_seconds(probe: FieldProbe, counts: _Counts, settings: BakeSettings, coefficients: Coefficients) -> dict[str, float]:
    """Seconds of each stage of a bake.

    start: compiling. occupancy: voxels of candidate blocks are tested, those in occupied cells queried. samples: where the number is
    chosen automatically, the test rays are filled with each number of samples up to twice the chosen one. prefilter: kept voxels, and
    their samples.
    """
    rates, tested = probe.rates, 0
    if settings.supersampling == AUTO_SUPERSAMPLING:
        tested = TEST_RAYS * TEST_RAY_VOXELS * (REFERENCE_SAMPLES_PER_VOXEL + 8 * (min(4 * counts.samples, 2 * MAX_SUPERSAMPLING) - 1))
    candidates = int(candidate_blocks(probe.coarse, counts.grid).sum()) * DATA_VOXELS**3
    return {
        "start": rates.compile,
        "occupancy": coefficients.occupancy_start + rates.block_voxel * candidates + rates.query * counts.queried,
        "visibility": _visibility_seconds(probe, counts.grid, coefficients) if settings.visibility else 0.0,
        "samples": rates.sample * tested,
        "prefilter": coefficients.prefilter_factor * counts.kept * (rates.kept_voxel + counts.samples * rates.sample),
    }


def _finishing_seconds(probe: FieldProbe, finishing: Finishing, network: bool, ray: float, coefficients: Coefficients) -> dict[str, float]:
    """Seconds of pruning, fitting and fine-tuning, those that the field's images allow. network: whether the scene has one. ray: seconds
    of a ray of a preview, on average over those that hit and miss the scene."""
    field, pixels = probe.field, sum(camera.width * camera.height for camera in probe.field.cameras)
    if not field.dataset:
        return {}
    views = probe.rates.preview_view * len(field.cameras)
    marched, pruned = min(pixels, FIT_PIXELS), min(pixels, PRUNING_PIXELS)
    fitted = min(FIT_PASSES * marched, FIT_RAYS / HIT_SHARE)
    seconds = {
        "prune": views + coefficients.recorded_ray * ray * pruned,
        "fit": coefficients.fit_seconds + views + (coefficients.recorded_ray * marched + coefficients.fitted_ray * fitted) * ray,
        "refine": coefficients.refine_seconds + views + ray * coefficients.refine_pixels,
    }
    return {name: seconds[name] for name in finishing.stages(network)}


def _peak_bytes(probe: FieldProbe, counts: _Counts, atlas_bytes: int, stages: Mapping[str, float], coefficients: Coefficients) -> float:
    """Memory of a bake with its finishing, of which the stage that takes most counts. stages: their names.

    The fit holds the atlas and its numbers, the voxels with their moments, and the samples of the pixels.
    """
    most = coefficients.cell_copies * atlas_bytes
    if "refine" in stages:
        most += coefficients.refine_bytes
    if "fit" in stages:
        pixels = min(sum(camera.width * camera.height for camera in probe.field.cameras), FIT_PIXELS)
        numbers = 8 * counts.blocks * CELL_VOXELS**3
        moved = coefficients.fit_copies * 4 * counts.channels * counts.kept
        most = max(most, 2 * atlas_bytes + numbers + moved + coefficients.fit_pixel_bytes * pixels)
    return coefficients.process_bytes + most


def _visibility_seconds(probe: FieldProbe, grid: VoxelGrid, coefficients: Coefficients) -> float:
    """Seconds of the visibility stage, which marches a grid of half the resolution from each camera."""
    rates, half = probe.rates, grid.halved()
    slowdown = ray_slowdown(rates.visibility_samples, rates.visibility_growth, probe.pilot / half.voxel_size, coefficients)
    return rates.visibility_view * len(probe.field.cameras) + rates.visibility_ray * slowdown * visibility_rays(probe.field, grid)


def _points_inside(probe: FieldProbe, flags: NDArray[Any], inside: NDArray[Any], voxel_size: float) -> float:
    """How many of the probe's points inside a box (inside [M] bool) have a flag of `flags` [S, M], interpolated in the voxel size."""
    count = int(inside.sum())
    share = (flags[:, inside].sum(axis=1) + PRIOR_POINTS * flags.mean(axis=1)) / (count + PRIOR_POINTS)
    return count * _at(probe, share, voxel_size)


def _at(probe: FieldProbe, values: NDArray[Any], voxel_size: float) -> float:
    """What the probe found at its voxel sizes, values [S], interpolated."""
    order = np.argsort(probe.voxels)
    return float(np.interp(np.log(voxel_size), np.log(probe.voxels[order]), values[order]))
