"""The marcher: a baked scene and a camera to colour, alpha and depth, with NumPy alone (section 5.2).

One lattice of samples a ray, t_start + 0.5 + k voxels: skipping only ever moves to a later integer k, so the
picture is the one that a dense march gives (hard case 33). What is skipped is known to be zero: blocks
without a cell, and runs of voxels at whose 8 corners the atlas holds nothing (Chebyshev distance).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np

from ..capture.camera import Camera
from ..capture.ndc import space_rays, world_distance
from ..field.networks import ViewNetwork, view_residual
from .box import CELL_VOXELS, DATA_VOXELS
from .snerg import NETWORK_TRANSMITTANCE, Snerg, blocks_of

Progress = Callable[[float, str], None]
MAX_SKIP = 10  # voxels that one jump inside a block can pass; more costs set-up time and saves little
SHARE = 2**17  # rays between two calls of `progress`, in each thread
CORNERS = np.array([(x * CELL_VOXELS + y) * CELL_VOXELS + z for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32)


@dataclass(frozen=True)
class MarchSettings:
    """stop_transmittance: a ray ends when less than this passes; it bounds the error of a pixel.

    batch: rays marched together (what fits the caches), new ones taken in as others end. threads: such batches at a time.
    skip: jump over empty voxels; the picture is the same without, only later.
    """

    stop_transmittance: float = 4e-5
    batch: int = 65536
    threads: int = 2
    skip: bool = True


@dataclass(frozen=True, eq=False)
class Frame:
    """colour [H, W, 3] float32 premultiplied, display-referred, over nothing; alpha [H, W]; depth [H, W], the
    expected distance along the ray in world units, infinite where alpha is 0."""

    colour: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray

    def over(self, background: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> np.ndarray:
        """[H, W, 3] in [0, 1] over a colour."""
        return np.clip(self.colour + (1 - self.alpha[..., None]) * np.array(background, np.float32), 0, 1)

    def straight(self) -> np.ndarray:
        """[H, W, 4] in [0, 1] with straight alpha, as pictures hold it."""
        alpha = self.alpha[..., None]
        colour = np.clip(self.colour / np.maximum(alpha, 1e-6), 0, 1)
        return np.concatenate([np.where(alpha > 0, colour, 0), alpha], axis=-1)


def march(
    snerg: Snerg,
    camera: Camera,
    settings: MarchSettings = MarchSettings(),
    progress: Progress = lambda fraction, what: None,
) -> Frame:
    """Render a baked scene from a camera. `progress` may raise Cancelled, which it does between batches."""
    origins, directions = camera.rays()
    near = max(snerg.near, camera.near)
    composited = march_rays(snerg, origins, directions, settings, progress, near)
    colour = shade(snerg.network, composited, directions @ snerg.view_rotation.T)
    alpha = 1 - composited.transmittance
    depth = world_distance(snerg.ndc, origins, directions, composited.depth / np.maximum(alpha, 1e-6), near)
    depth = np.where(alpha > 0, depth, np.inf)
    shape = camera.height, camera.width
    return Frame(colour.reshape(*shape, 3), alpha.reshape(shape), depth.astype(np.float32).reshape(shape))


@dataclass(frozen=True, eq=False)
class Composited:
    """What a ray gathers: colour [N, 3], features [N, 4] (none in a diffuse scene: [N, 0]), transmittance [N], and
    depth [N], distance times opacity in units of the space (see `space_rays`). float32."""

    colour: np.ndarray
    features: np.ndarray
    transmittance: np.ndarray
    depth: np.ndarray


def shade(network: ViewNetwork | None, rays: Composited, directions: np.ndarray) -> np.ndarray:
    """Composited colour plus the view-dependent residual (eq. 7), [N, 3], once a ray and only where something is.

    directions: [N, 3] unit, in the axes in which the network was trained.
    """
    if network is None:
        return rays.colour
    colour = rays.colour.copy()
    seen = np.flatnonzero(rays.transmittance <= np.float32(NETWORK_TRANSMITTANCE))
    over_white = colour[seen] + rays.transmittance[seen, None]
    colour[seen] += view_residual(np, network, over_white, rays.features[seen], directions[seen].astype(np.float32))
    return colour


def march_rays(
    snerg: Snerg,
    origins: np.ndarray,
    directions: np.ndarray,
    settings: MarchSettings = MarchSettings(),
    progress: Progress = lambda fraction, what: None,
    near: float = 0.0,
    visited: np.ndarray | None = None,
) -> Composited:
    """Composite rays given in the world (origins and unit directions [N, 3] float64) through the grid (eqs. 5, 6).

    near: world units along the ray. visited: bool [M * 32^3], set where a sample was taken in a voxel (always in a block's
    own part of its cell).
    """
    tables = tables_of(snerg)
    origin, direction, start, stop = enter(snerg, origins, directions, near)
    count = len(origin)
    gathered = np.zeros((count, tables.channels), np.float32)
    through = np.ones(count, np.float32)
    depth = np.zeros(count, np.float32)
    hit = np.flatnonzero(stop > start + 0.5)
    share = max(settings.batch, min(SHARE, -(-len(hit) // settings.threads)))
    batches = [hit[i : i + share] for i in range(0, len(hit), share)]

    def run(rays: np.ndarray) -> None:
        walk = _Walk(tables, origin[rays], direction[rays], start[rays], stop[rays], settings, visited)
        gathered[rays], through[rays], depth[rays] = walk.run()

    with ThreadPoolExecutor(settings.threads) as pool:
        for done, _ in enumerate(pool.map(run, batches)):
            progress((done + 1) / len(batches), "Marching")
    found = Composited(gathered[:, :3], gathered[:, 3:-1], through, depth * np.float32(snerg.voxel_size))
    return filled(found) if snerg.fill_holes else found


def filled(rays: Composited) -> Composited:
    """Rays up to 1.5 times as opaque, all of what they gather with them (eq. 9): baking lets a little light through surfaces.

    The factor is written so that it is finite at alpha 0 and continuous at 2/3, above which a ray is opaque (hard case 53).
    """
    alpha = 1 - rays.transmittance
    factor = np.where(alpha < 2 / 3, 1.5, 1 / np.maximum(alpha, 2 / 3)).astype(np.float32)
    through = np.maximum(1 - factor * alpha, 0)
    return Composited(rays.colour * factor[:, None], rays.features * factor[:, None], through, rays.depth * factor)


def enter(snerg: Snerg, origins: np.ndarray, directions: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays of the world in voxel coordinates, re-based to where they enter the grid.

    Returns point of entry [N, 3], direction [N, 3] (both float32), and the distances in voxels [N] at which the
    ray starts and stops, from where it begins (the eye, or NDC's near plane). Everything up to here is float64, so a scene far from the
    origin is as steady as one at it (hard case 6); a direction of 0 along an axis is a miss or all of it (31, 32).
    """
    rotation = snerg.grid_to_world[:3, :3]
    origins, directions, begins, _ = space_rays(snerg.ndc, origins, directions, near)
    local = (origins - snerg.grid_to_world[:3, 3]) @ rotation / snerg.voxel_size
    towards = directions @ rotation
    shape = np.array(snerg.shape, np.float64)
    flat = np.abs(towards) < 1e-12
    inverse = 1 / np.where(flat, 1, towards)
    low, high = -local * inverse, (shape - local) * inverse
    inside = (local >= 0) & (local <= shape)
    first = np.where(flat, np.where(inside, -np.inf, np.inf), np.minimum(low, high)).max(axis=-1)
    last = np.where(flat, np.where(inside, np.inf, -np.inf), np.maximum(low, high)).min(axis=-1)
    start = np.maximum(first, begins / snerg.voxel_size)
    start = np.where(np.isfinite(start) & (start < last), start, 0)
    last = np.where(first < last, last, -1)
    entry = local + towards * start[:, None]
    return entry.astype(np.float32), towards.astype(np.float32), start, last


@dataclass(frozen=True, eq=False)
class _Tables:
    """What a march looks up.

    words: the atlas, one word of C bytes a voxel [M * 32^3]. base: [blocks] int32 first word of a block's cell,
    -1 where empty. block_skip: [blocks] int32 Chebyshev distance in blocks to the nearest with a cell.
    voxel_skip: uint8 [M * 32^3] Chebyshev distance in voxels to the nearest with something at its 8 corners,
    within the cell, and at most the distance to the cell's border, past which this cell knows nothing; 0 there.
    """

    words: np.ndarray
    channels: int
    base: np.ndarray
    block_skip: np.ndarray
    voxel_skip: np.ndarray
    blocks: tuple[int, int, int]


_tables: WeakKeyDictionary[Snerg, _Tables] = WeakKeyDictionary()


def tables_of(snerg: Snerg) -> _Tables:
    """The look-up tables of a scene, made once."""
    tables = _tables.get(snerg)
    if tables is None:
        tables = _tables[snerg] = _make_tables(snerg)
    return tables


def _make_tables(snerg: Snerg) -> _Tables:
    channels = snerg.cells.shape[-1]
    word = np.uint64 if channels == 8 else np.uint32
    words = np.ascontiguousarray(snerg.cells).reshape(-1).view(word) if len(snerg.cells) else np.zeros(CELL_VOXELS**3, word)
    full = snerg.indirection >= 0
    base = np.where(full, snerg.indirection.astype(np.int64) * CELL_VOXELS**3, -1)
    return _Tables(
        words=words,
        channels=channels,
        base=base.reshape(-1).astype(np.int64),
        block_skip=chebyshev(full, max(full.shape)).reshape(-1).astype(np.int32),
        voxel_skip=_voxel_skip(words.reshape(-1, CELL_VOXELS, CELL_VOXELS, CELL_VOXELS)),
        blocks=blocks_of(snerg.shape),
    )


def _voxel_skip(words: np.ndarray) -> np.ndarray:
    """[M, 32, 32, 32] words to flat uint8 distances; the tent of voxel i reaches from i to i + 1 on each axis."""
    occupied = words != 0
    for axis in (1, 2, 3):
        ahead = [slice(None)] * 4
        here = [slice(None)] * 4
        ahead[axis], here[axis] = slice(1, None), slice(None, -1)
        occupied[tuple(here)] |= occupied[tuple(ahead)]
    index = np.arange(CELL_VOXELS)
    border = np.clip(np.minimum(index + 1, CELL_VOXELS - 1 - index), 1, None).astype(np.uint8)
    border = np.minimum(np.minimum(border[:, None, None], border[:, None]), border)
    return np.minimum(chebyshev(occupied, MAX_SKIP, first_axis=1), border).reshape(-1)


def chebyshev(occupied: np.ndarray, most: int, first_axis: int = 0) -> np.ndarray:
    """Distance to the nearest True in the maximum norm along the axes from `first_axis`, uint8, at most `most`."""
    distance = np.where(occupied, 0, 1).astype(np.uint8)
    reached = occupied.copy()
    for _ in range(1, min(most, 255)):
        if reached.all():
            break
        for axis in range(first_axis, reached.ndim):
            reached = _spread(reached, axis)
        distance += ~reached
    return distance


def _spread(mask: np.ndarray, axis: int) -> np.ndarray:
    """True also where a neighbour along the axis is."""
    wide = mask.copy()
    ahead, back = [slice(None)] * mask.ndim, [slice(None)] * mask.ndim
    ahead[axis], back[axis] = slice(1, None), slice(None, -1)
    wide[tuple(back)] |= mask[tuple(ahead)]
    wide[tuple(ahead)] |= mask[tuple(back)]
    return wide


class _Walk:
    """A batch of rays on their way through the grid.

    What a ray carries lies in one array a quantity, packed together as rays end: NumPy is fast on long plain arrays
    and slow on gathering rows of three.
    """

    def __init__(
        self,
        tables: _Tables,
        entry: np.ndarray,
        direction: np.ndarray,
        start: np.ndarray,
        stop: np.ndarray,
        settings: MarchSettings,
        visited: np.ndarray | None = None,
    ) -> None:
        self.tables, self.settings, self.visited = tables, settings, visited
        count = len(entry)
        self.colour = np.zeros((count, tables.channels), np.float32)
        self.through = np.ones(count, np.float32)
        self.depth = np.zeros(count, np.float32)
        # Steps to move a voxel along the fastest axis; and how many samples come before the exit, sample k at start + 0.5 + k.
        pace = 1 / np.maximum(np.abs(direction).max(axis=-1), np.float32(1e-12))
        samples = np.ceil(stop - start - 0.5).astype(np.int32)
        inverse = 1 / np.where(np.abs(direction) < 1e-7, np.float32(1e-7), direction)
        columns = [*entry.T, *direction.T, *inverse.T, start.astype(np.float32), pace, samples]
        self.all = [np.ascontiguousarray(column) for column in columns]
        self.begun = 0
        self.ray = np.zeros(0, np.int64)
        self.step = np.zeros(0, np.int32)
        self.light = np.zeros(0, np.float32)
        self.live = [column[:0] for column in self.all]
        self.samples = samples[:0]
        self.pack(np.zeros(0, bool))

    def run(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Composited values [N, C] (the last channel is alpha's), transmittance [N], depth times opacity in voxels [N]."""
        while len(self.ray):
            self.step += self.advance()
            live = (self.step < self.samples) & (self.light > self.settings.stop_transmittance)
            kept = int(np.count_nonzero(live))
            if kept < 0.85 * len(live):
                self.pack(live)
            elif kept < len(live):
                # Too few have ended to be worth packing: they stand still at their last sample, and let no light through.
                self.rest(~live)
        return self.colour, self.through, self.depth

    def pack(self, live: np.ndarray) -> None:
        """Keep the live rays only, and begin as many new ones as a batch has room for."""
        self.rest(~live)
        new = np.arange(self.begun, min(self.begun + self.settings.batch - int(np.count_nonzero(live)), len(self.colour)))
        self.begun += len(new)
        fresh = slice(self.begun - len(new), self.begun)
        self.ray = np.concatenate([self.ray[live], new])
        self.step = np.concatenate([self.step[live], np.zeros(len(new), np.int32)])
        self.light = np.concatenate([self.light[live], np.ones(len(new), np.float32)])
        self.live = [np.concatenate([here[live], column[fresh]]) for here, column in zip(self.live, self.all, strict=True)]
        self.entry, self.direction, self.inverse = self.live[:3], self.live[3:6], self.live[6:9]
        self.start, self.pace, self.samples = self.live[9:]

    def rest(self, ended: np.ndarray) -> None:
        """Set ended rays aside: what they have is written down, and light below 0 marks them."""
        rows = np.flatnonzero(ended & (self.light >= 0))
        self.through[self.ray[rows]] = self.light[rows]
        self.light[rows] = -1
        self.step[rows] = self.samples[rows]

    def advance(self) -> np.ndarray:
        """Take the sample that each live ray stands at; return how many steps to the next that can matter."""
        tables, blocks = self.tables, self.tables.blocks
        t = self.step + np.float32(0.5)
        point = [e + d * t for e, d in zip(self.entry, self.direction, strict=True)]
        # The grid's outer faces belong to it: rounding must not push a sample out of its block.
        scale = np.float32(1 / DATA_VOXELS)
        block = [np.minimum((p * scale).astype(np.int32), n - 1) for p, n in zip(point, blocks, strict=True)]
        number = (block[0] * blocks[1] + block[1]) * blocks[2] + block[2]
        base = tables.base[number]
        move = np.ones(len(t), np.int32)
        full = base >= 0
        if self.settings.skip:
            empty = np.flatnonzero(~full)
            move[empty] = self.leave(empty, point, block, tables.block_skip[number[empty]])
        rows = np.flatnonzero(full & (self.light >= 0))
        local = [p[rows] - (b[rows] * DATA_VOXELS - np.float32(0.5)).astype(np.float32) for p, b in zip(point, block, strict=True)]
        corner = [np.minimum(x.astype(np.int32), CELL_VOXELS - 2) for x in local]
        first = base[rows] + ((corner[0] * CELL_VOXELS + corner[1]) * CELL_VOXELS + corner[2])
        skip = tables.voxel_skip[first]
        if self.settings.skip:
            move[rows] = 1 + (np.maximum(skip, 1) - 1) * self.pace[rows]
        near = np.flatnonzero(skip == 0)
        if len(near):
            fraction = [x[near] - c[near] for x, c in zip(local, corner, strict=True)]
            self.gather(rows[near], first[near], fraction, t[rows[near]])
        return move

    def leave(self, rows: np.ndarray, point: list[np.ndarray], block: list[np.ndarray], distance: np.ndarray) -> np.ndarray:
        """Steps to the first sample outside the cube of empty blocks around `block` (a hair early, never late)."""
        steps = np.full(len(rows), np.float32(1e9))
        for axis in range(3):
            inverse = self.inverse[axis][rows]
            # In blocks, to the cube's far face: `distance` ahead, or distance - 1 back.
            faces = block[axis][rows] + np.where(inverse > 0, distance, 1 - distance)
            np.minimum(steps, (faces * np.float32(DATA_VOXELS) - point[axis][rows]) * inverse, out=steps)
        return np.maximum((steps - np.float32(1e-2)).astype(np.int32) + 1, 1)

    def gather(self, rows: np.ndarray, first: np.ndarray, fraction: list[np.ndarray], t: np.ndarray) -> None:
        """Trilinear interpolation at the samples that hold something, composited front to back."""
        if self.visited is not None:
            nearest = sum((f >= 0.5) * step for f, step in zip(fraction, CORNERS[[4, 2, 1]], strict=True))
            self.visited[first + nearest] = True
        words = self.tables.words[first[:, None] + CORNERS]
        values = words.view(np.uint8).reshape(len(rows), 8, self.tables.channels).astype(np.float32)
        fx, fy, fz = fraction
        light = self.light[rows]
        scale = light * np.float32(1 / 255)
        weights = np.empty((len(rows), 8), np.float32)
        for i, wx in enumerate(((1 - fx) * scale, fx * scale)):
            for j, wy in enumerate((1 - fy, fy)):
                both = wx * wy
                weights[:, 4 * i + 2 * j + 1] = both * fz
                weights[:, 4 * i + 2 * j] = both - weights[:, 4 * i + 2 * j + 1]
        sample = np.einsum("nk,nkc->nc", weights, values)
        rays = self.ray[rows]
        self.colour[rays] += sample
        self.light[rows] = np.maximum(light - sample[:, -1], 0)
        self.depth[rays] += sample[:, -1] * (self.start[rows] + t)
