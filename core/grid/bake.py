"""Baking a field into a SNeRG (section 5.3), coarse to fine inside the artist's box (JAX, through the field)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from ..capture.camera import Camera
from ..capture.ndc import Ndc
from ..errors import SnergError
from ..field.field import Field
from ..field.volume import opacity, optical_depth
from .blocks import cells_of, dilate, number, with_apron
from .box import DATA_VOXELS, Box
from .jitter import voxel_normal, voxel_uniform
from .quantize import quantize
from .snerg import Snerg, blocks_of
from .visibility import visible_voxels

Progress = Callable[[float, str], None]
BATCH = 24  # blocks evaluated together
OWN = (DATA_VOXELS,) * 3


@dataclass(frozen=True)
class BakeSettings:
    """resolution: voxels along the box's longest side. samples: points averaged in a voxel, Gaussian with a standard
    deviation of voxel / sqrt(12). alpha_threshold: blocks whose opacity is nowhere above it are culled;
    visibility_threshold: voxels that no camera sees with at least this transmittance are culled (section 5.3).
    seed: of the jitter. fill_holes: see Snerg; None: in forward-facing scenes, as in the paper (supplement C.3).
    """

    resolution: int = 512
    samples: int = 4
    alpha_threshold: float = 0.005
    visibility_threshold: float = 0.01
    seed: int = 0
    fill_holes: bool | None = None

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.resolution > 4096:
            raise SnergError(f"A resolution of {self.resolution} voxels cannot be baked; choose 2 to 4096.")
        if not 1 <= self.samples <= 64:
            raise SnergError(f"{self.samples} samples a voxel cannot be averaged; choose 1 to 64.")


def bake(
    field: Field,
    box: Box,
    cameras: Sequence[Camera],
    settings: BakeSettings = BakeSettings(),
    progress: Progress = lambda fraction, what: None,
) -> Snerg:
    """Evaluate a field inside a box of its space (see Field.ndc) into a sparse grid.

    cameras: those that decide what is visible; none keeps everything. Raises SnergError for a field whose values are not
    finite, or that depends on the direction in each sample, which a grid cannot hold; Cancelled when `progress` does. An empty
    result is a valid scene; `about` says so.
    """
    if field.view not in ("deferred", "diffuse"):
        raise SnergError(
            f"The field's view dependence is of the kind {field.view!r}, sample by sample, which no grid can hold; "
            "train it with view dependence 'deferred' or 'diffuse' to bake it."
        )
    clock = _Clock()
    lattice = Lattice.inside(box, settings.resolution)
    blocks, alpha = occupied_blocks(field, lattice, settings, lambda f, w: progress(0.3 * f, w))
    clock.lap("occupancy")
    indirection = number(blocks)
    keep = dilate(alpha > 1 / 1024, indirection, 1)
    if cameras and len(alpha):
        opaque = opacity_scene(lattice, alpha, indirection, field.ndc)
        seen = visible_voxels(opaque, cameras, settings.visibility_threshold, lambda f, w: progress(0.3 + 0.3 * f, w))
        keep &= dilate(seen, indirection, 2)
        del opaque, seen
    clock.lap("visibility")
    del alpha
    values = prefilter(field, lattice, indirection, keep, settings, lambda f, w: progress(0.6 + 0.4 * f, w))
    cells, indirection = cells_of(values, indirection)
    clock.lap("prefilter")
    about = {"bake": {"settings": asdict(settings), "seconds": clock.laps, "blocks": len(cells), "blocks_in_all": indirection.size}}
    if not len(cells):
        about["bake"]["warning"] = "The box holds nothing; move it over the object, or train longer."
    fill = settings.fill_holes if settings.fill_holes is not None else field.ndc is not None
    return Snerg(
        lattice.grid_to_world,
        lattice.voxel_size,
        lattice.shape,
        indirection,
        cells,
        field.network,
        about=about,
        ndc=field.ndc,
        fill_holes=fill,
    )


@dataclass(frozen=True, eq=False)
class Lattice:
    """Voxels inside a box, and one more on each side so that what lies on a face keeps its tent (hard case 36)."""

    grid_to_world: np.ndarray
    voxel_size: float
    shape: tuple[int, int, int]

    @classmethod
    def inside(cls, box: Box, resolution: int) -> Lattice:
        """`resolution` voxels along the longest side."""
        voxel = float(box.size.max()) / resolution
        counts = np.ceil(box.size / voxel - 1e-6).astype(int).clip(1) + 2
        pose = box.box_to_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ (counts * voxel / 2)
        x, y, z = (int(n) for n in counts)
        return cls(pose, voxel, (x, y, z))

    @property
    def blocks(self) -> tuple[int, int, int]:
        """Macroblocks along each axis."""
        return blocks_of(self.shape)

    def points(self, voxels: np.ndarray) -> np.ndarray:
        """Centres [N, 3] float64 of voxels given by (possibly fractional) index [N, 3]."""
        local = (voxels + 0.5) * self.voxel_size
        return local @ self.grid_to_world[:3, :3].T + self.grid_to_world[:3, 3]

    def of_blocks(self, places: np.ndarray) -> np.ndarray:
        """Voxel indices [B, 27000, 3] of blocks by place [B, 3]."""
        offsets = np.stack(np.meshgrid(*(np.arange(DATA_VOXELS),) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return places[:, None] * DATA_VOXELS + offsets


def occupied_blocks(field: Field, lattice: Lattice, settings: BakeSettings, progress: Progress) -> tuple[np.ndarray, np.ndarray]:
    """Which blocks have opacity above the threshold, bool [bx, by, bz], and theirs at voxel centres, float32 [M, 30, 30, 30]."""
    candidates = np.argwhere(may_hold(field, lattice))
    kept: list[np.ndarray] = []
    mask = np.zeros(lattice.blocks, bool)
    for start in range(0, len(candidates), BATCH):
        places = candidates[start : start + BATCH]
        voxels = lattice.of_blocks(places)
        inside = (voxels < np.array(lattice.shape)).all(axis=-1).reshape(-1)
        alpha = np.zeros(len(inside), np.float32)
        alpha[inside] = field_alpha(field, lattice, voxels.reshape(-1, 3)[inside])[0]
        alpha = alpha.reshape(len(places), -1)
        full = alpha.max(axis=-1) >= settings.alpha_threshold
        mask[tuple(places[full].T)] = True
        kept.append(alpha[full].reshape(-1, *OWN))
        progress(min(start + BATCH, len(candidates)) / len(candidates), "Looking where something is")
    return mask, np.concatenate(kept) if kept else np.zeros((0, *OWN), np.float32)


def may_hold(field: Field, lattice: Lattice) -> np.ndarray:
    """bool [bx, by, bz]: blocks that meet an occupied cell of the field's own grid, or all where it has none.

    Points half an occupancy cell apart are enough to meet each cell that a block does.
    """
    if field.occupancy is None:
        return np.ones(lattice.blocks, bool)
    cells = round(len(field.occupancy) ** (1 / 3))
    cell = 2 / cells / field.domain.scale
    steps = int(np.ceil(DATA_VOXELS * lattice.voxel_size / (cell / 2))) + 1
    ticks = np.linspace(0, DATA_VOXELS, steps) - 0.5
    offsets = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    found = np.zeros(lattice.blocks, bool)
    for place in np.ndindex(*lattice.blocks):
        points = lattice.points(np.array(place) * DATA_VOXELS + offsets)
        found[place] = field.holds(field.domain.from_world(points)).any()
    return found


def field_alpha(field: Field, lattice: Lattice, voxels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Opacity over one voxel (1 - exp(-density * voxel)) and RGB with features [N, C], at voxel indices [N, 3]."""
    density, colour, features = field.query(lattice.points(voxels))
    return opacity(np, optical_depth(np, density, np.float32(lattice.voxel_size))), np.concatenate([colour, features], axis=-1)


def opacity_scene(lattice: Lattice, alpha: np.ndarray, indirection: np.ndarray, ndc: Ndc | None) -> Snerg:
    """A scene of opacity alone, for the visibility march; faint voxels stay, so that fog adds up."""
    own = np.zeros((*alpha.shape, 4), np.uint8)
    own[..., 3] = np.ceil(alpha * 255 - 1e-3).clip(0, 255)
    cells = with_apron(own, indirection)
    return Snerg(lattice.grid_to_world, lattice.voxel_size, lattice.shape, indirection, cells, None, ndc=ndc)


def prefilter(
    field: Field, lattice: Lattice, indirection: np.ndarray, keep: np.ndarray, settings: BakeSettings, progress: Progress
) -> np.ndarray:
    """Average `samples` jittered points in each voxel kept: uint8 [M, 30, 30, 30, 8 or 4], 0 elsewhere.

    Opacity is averaged and colour premultiplied by it, as the reference does where the paper says density: half
    a voxel of solid matter then stops half the light, where the mean density would stop all of it (hard case 49).
    """
    channels = 4 if field.network is None else 8
    values = np.zeros((len(keep), *OWN, channels), np.uint8)
    places = np.argwhere(indirection >= 0)
    for start in range(0, len(places), BATCH):
        part = keep[start : start + BATCH].reshape(len(places[start : start + BATCH]), -1)
        voxels = lattice.of_blocks(places[start : start + BATCH])[part]
        colour, alpha = average(field, lattice, voxels, settings.samples, settings.seed)
        flat = np.zeros((part.size, channels), np.uint8)
        flat[part.reshape(-1)] = quantize(colour[:, : channels - 1], alpha, voxel_uniform(voxels, channels, settings.seed + 1))
        values[start : start + BATCH] = flat.reshape(-1, *OWN, channels)
        progress(min(start + BATCH, len(places)) / len(places), "Baking colour and opacity")
    return values


def average(field: Field, lattice: Lattice, voxels: np.ndarray, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied RGB and features [N, C], and opacity [N], averaged over each voxel's own jitter.

    Offsets come in pairs of opposite signs, so that no voxel's content moves (hard case 48); an odd one is the centre.
    """
    colour: np.ndarray | float = 0.0
    total = np.zeros(len(voxels), np.float32)
    offsets = voxel_normal(voxels, samples // 2, seed) / np.sqrt(12)
    signed = [sign * offsets[:, pair] for pair in range(samples // 2) for sign in (1, -1)]
    if samples % 2:
        signed.append(np.zeros(voxels.shape))
    for offset in signed:
        alpha, values = field_alpha(field, lattice, voxels + offset)
        colour = colour + values * alpha[:, None]
        total += alpha
    return np.asarray(colour) / np.float32(samples), total / np.float32(samples)


class _Clock:
    """Seconds of each stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self.last, 3)
        self.last = now
