"""A baked scene in the graphics card's memory: pages of cells, tables of what can be skipped, and the shader that marches them."""

from __future__ import annotations

import itertools
from functools import cache

import gpu
import numpy as np

from ...core.rendering.acceleration import chebyshev_distance, dilate_axis
from ...core.scene.blocks import CELL_VOXELS
from ...core.scene.scene import Scene
from . import shader
from .view import Part

COARSE = 4  # voxels along an axis of a coarse voxel, the unit of skipping within a cell
COARSE_CELL = CELL_VOXELS // COARSE
SIDES = (16, 32)  # cells along the side of a page that are tried: few pages, since a sample asks for its page by comparing with each
_numbers = itertools.count()
PIXEL_BYTES = 12  # of a Target
LEAST_SIDE = 256  # texels along a side of a 3D texture that every card takes (OpenGL 4.3 and Vulkan guarantee no less)


class GpuScene:
    """Textures and shader of a scene. bytes: what they take of the card's memory. number: no other one has had it; an identity is given
    again when its owner is gone.

    Raises ValueError when the card has no room for so many cells, and whatever Blender raises when it refuses a texture or the shader.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.number = scene, next(_numbers)
        kinds = 2 if scene.network is None else 3
        self.page_cells, self.layout = layout(len(scene.cells), (gpu.capabilities.max_textures_frag_get() - 1) // kinds)
        self.pages = max(1, -(-len(scene.cells) // self.page_cells))
        self.bytes = 0
        self.textures: dict[str, gpu.types.GPUTexture] = {}
        self._add("indirection", self._indirection(), "RGBA32F")
        skips = skip_tables(scene.cells)
        features_need_alpha = True  # as baked; an atlas from elsewhere, or from a lossy codec, may be otherwise
        for page in range(self.pages):
            rows = slice(page * self.page_cells, (page + 1) * self.page_cells)
            cells = as_bytes(scene.cells[rows], scene)
            alpha = cells[..., -1:]
            colour = np.concatenate([cells[..., :3], alpha], axis=-1)
            self._add(f"rgba_{page}", self._laid_out(colour), "RGBA8")
            self._add(f"skip_{page}", self._laid_out(skips[rows, ..., None]), "R8")
            if scene.network is not None:
                self._add(f"feature_{page}", self._laid_out(cells[..., 3:7]), "RGBA8")
                features_need_alpha &= not cells[..., 3:7][alpha[..., 0] == 0].any()
        self.shader = shader.march_shader(scene, self.pages, features_need_alpha)

    def _add(self, name: str, values: np.ndarray, form: str) -> None:
        self.textures[name] = texture(values, form)
        self.bytes += values.nbytes

    def _laid_out(self, cells: np.ndarray) -> np.ndarray:
        """Cells [n, s, s, s, C] uint8, z fastest, to a page [Z, Y, X, C]: cell i stands at x = i mod nx and so on."""
        nx, ny, nz = self.layout
        side, channels = cells.shape[1], cells.shape[-1]
        whole = np.zeros((nx * ny * nz, side, side, side, channels), np.uint8)
        whole[: len(cells)] = cells
        grid = whole.reshape(nz, ny, nx, side, side, side, channels)  # cell z, y, x; voxel x, y, z
        return grid.transpose(0, 5, 1, 4, 2, 3, 6).reshape(nz * side, ny * side, nx * side, channels)

    def _indirection(self) -> np.ndarray:
        """[Z, Y, X, 4] float32: a cell's place in its page and 1 + the page; or 0 there, and the distance in blocks to the nearest cell."""
        blocks = self.scene.indirection
        nx, ny, _ = self.layout
        page, inside = np.divmod(np.maximum(blocks, 0), self.page_cells)
        found = np.stack([inside % nx, inside // nx % ny, inside // (nx * ny), page + 1], axis=-1).astype(np.float32)
        empty = blocks < 0
        found[empty] = 0
        found[empty, 0] = chebyshev_distance(~empty, 255)[empty]
        return np.ascontiguousarray(found.transpose(2, 1, 0, 3))


def bytes_of(scene: Scene) -> int:
    """Bytes of graphics memory that a scene takes, about: its cells, and a 256th of that for what can be skipped."""
    channels = 4 if scene.network is None else 8
    return len(scene.cells) * CELL_VOXELS**3 * channels + len(scene.cells) * COARSE_CELL**3 + 16 * scene.indirection.size


def layout(cells: int, most_pages: int) -> tuple[int, tuple[int, int, int]]:
    """(cells a page, cells along x, y and z of it): the fewest pages of the first of SIDES with which `most_pages` hold all."""
    for side in SIDES:
        if cells <= most_pages * side**3:
            each = -(-max(cells, 1) // -(-max(cells, 1) // side**3))
            x = min(side, int(np.ceil(each ** (1 / 3) - 1e-9)))
            y = int(np.ceil(np.sqrt(each / x) - 1e-9))
            return each, (x, y, -(-each // (x * y)))
    raise ValueError(f"it has {cells} blocks, and the viewport holds {most_pages * SIDES[-1] ** 3}")


def as_bytes(cells: np.ndarray, scene: Scene) -> np.ndarray:
    """Cells as uint8, those of an unquantised scene rounded."""
    return cells if cells.dtype == np.uint8 else np.clip(np.rint(cells * (255 / scene.unit)), 0, 255).astype(np.uint8)


def skip_tables(cells: np.ndarray) -> np.ndarray:
    """Of each cell [M, 32, 32, 32, C] the distance [M, 8, 8, 8] uint8, in coarse voxels in the maximum norm, from a coarse voxel to the
    nearest in its cell that a sample could find something in; 0 there. A voxel weighs on samples up to one voxel away."""
    wide = (cells != 0).any(axis=-1)
    for axis in (1, 2, 3):
        wide = dilate_axis(wide, axis)
    n = COARSE_CELL
    coarse = wide.reshape(-1, n, COARSE, n, COARSE, n, COARSE).any(axis=(2, 4, 6))
    return chebyshev_distance(coarse, n, axes=(1, 2, 3))


def texture(values: np.ndarray, form: str) -> gpu.types.GPUTexture:
    """[Z, Y, X, C] uint8 or float32 to a 3D texture; Blender takes floats alone, which are made in its own buffer: pages are large."""
    depth, height, width = values.shape[:3]
    if max(values.shape[:3]) > largest_side():
        raise ValueError(f"it needs a texture of {width} x {height} x {depth} texels, and the card takes {largest_side()} along a side")
    buffer = gpu.types.Buffer("FLOAT", values.size)
    np.divide(values.reshape(-1), np.float32(255 if values.dtype == np.uint8 else 1), out=np.asarray(buffer))
    return gpu.types.GPUTexture((width, height, depth), format=form, data=buffer)


@cache
def largest_side() -> int:
    """Texels along a side of the largest 3D texture. Blender tells scripts of 2D ones alone: thin ones are tried, which take no room."""
    side = int(gpu.capabilities.max_texture_size_get())
    while side > LEAST_SIDE:
        try:
            gpu.types.GPUTexture((1, 1, side), format="R8")
            return side
        except (RuntimeError, ValueError, MemoryError):
            side //= 2
    return LEAST_SIDE


class Target:
    """A picture that a march draws into, with each ray's depth beside it (see march.glsl)."""

    def __init__(self, width: int, height: int) -> None:
        self.size = width, height
        self.picture = gpu.types.GPUTexture(self.size, format="RGBA16F")
        self.depths = gpu.types.GPUTexture(self.size, format="R32F")
        self.buffer = gpu.types.GPUFrameBuffer(color_slots=(self.picture, self.depths))

    @classmethod
    def of(cls, colour: np.ndarray, depths: np.ndarray) -> Target:
        """A finished picture, as `pixels` gives it but with the lowest row first."""
        found = cls.__new__(cls)
        found.size = depths.shape[1], depths.shape[0]
        for name, values, form in (("picture", colour, "RGBA16F"), ("depths", depths, "R32F")):
            buffer = gpu.types.Buffer("FLOAT", values.size)
            np.asarray(buffer)[:] = values.reshape(-1)  # Blender's own copy takes values one at a time
            setattr(found, name, gpu.types.GPUTexture(found.size, format=form, data=buffer))
        return found

    @property
    def bytes(self) -> int:
        """Of the card's memory."""
        return PIXEL_BYTES * self.size[0] * self.size[1]

    def wait(self) -> None:
        """Until the card is done with what was drawn: reading a pixel takes that long."""
        with self.buffer.bind():
            self.buffer.read_color(0, 0, 1, 1, 4, 0, "FLOAT")

    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Premultiplied colour and alpha [H, W, 4], and depths [H, W] along the view axis in world units, top row first, float32."""
        width, height = self.size
        colour, depths = (np.array(t.read(), np.float32) for t in (self.picture, self.depths))
        return colour.reshape(height, width, 4)[::-1], depths.reshape(height, width)[::-1]


@cache
def triangle() -> gpu.types.GPUBatch:
    """One triangle over the whole picture, for any of the viewport's shaders."""
    form = gpu.types.GPUVertFormat()
    form.attr_add(id="pos", comp_type="F32", len=2, fetch_mode="FLOAT")
    corners = gpu.types.GPUVertBuf(form, 3)
    corners.attr_fill("pos", ((-1, -1), (3, -1), (-1, 3)))
    return gpu.types.GPUBatch(type="TRIS", buf=corners)


def march(scene: GpuScene, view: np.ndarray, target: Target, part: Part | None = None) -> None:
    """March a view [12, 4] (see view.uniforms) into a part of a target, all of it when None."""
    buffer = gpu.types.GPUUniformBuf(gpu.types.Buffer("FLOAT", view.size, np.ascontiguousarray(view).reshape(-1)))
    with target.buffer.bind():
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        gpu.state.blend_set("NONE")
        gpu.state.scissor_test_set(True)
        gpu.state.scissor_set(*(part or (0, 0, *target.size)))
        scene.shader.bind()
        scene.shader.uniform_block("view", buffer)
        for name, held in scene.textures.items():
            scene.shader.uniform_sampler(name, held)
        triangle().draw(scene.shader)
        gpu.state.scissor_test_set(False)
