"""An object's picture in one region: marched on the graphics card in short steps, and laid over the viewport with its depth."""

from __future__ import annotations

import time
from dataclasses import dataclass

import gpu
import numpy as np

from . import shader
from .gpu_scene import GpuScene, Target, march, triangle
from .view import Part, Projection

BUDGET = 0.03  # seconds of marching at a time
SETTLE = 0.12  # seconds without change after which a view counts as still
COARSEST = 8  # times smaller, each way, that the picture of a moving view may be

_composite: gpu.types.GPUShader | None = None


@dataclass
class Picture:
    """An object as one region sees it. full: marched whole, `rows` of the part in which the object is so far, from the
    top; draft: what is shown until then."""

    full: Target
    key: bytes = b""
    draft: Target | None = None
    part: Part = Part(0, 0, 0, 0)  # of the picture, in which the object is
    rows: int = 0
    changed: float = 0.0
    pixel: float = 0.0  # seconds, as measured; 0: not yet

    @property
    def done(self) -> bool:
        """Whether the whole picture is there."""
        return self.rows >= self.part.height

    @property
    def bytes(self) -> int:
        """Of the card's memory."""
        return self.full.bytes + (self.draft.bytes if self.draft is not None else 0)


def work(held: GpuScene, seen: np.ndarray, picture: Picture, part: Part) -> None:
    """March as much of the part of a picture in which the object is as BUDGET allows: all of it where that is quick; else a coarse one,
    and once the view rests the full one, a band of rows at a time."""
    now, (width, height) = time.monotonic(), picture.full.size
    if picture.key != (key := seen.tobytes() + held.number.to_bytes(8, "little")):
        picture.key, picture.part, picture.rows, picture.changed = key, part, 0, now
        affordable = BUDGET / (picture.pixel * part.pixels) if picture.pixel else 0.0
        if affordable >= 0.8:
            picture.rows = part.height
            _timed(held, seen, picture, picture.full, part)
            return
        scale = 2.0 ** max(-np.log2(COARSEST), np.floor(np.log2(max(affordable, 1e-9))) / 2)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        if picture.draft is None or picture.draft.size != size:
            picture.draft = Target(*size)
        _timed(held, seen, picture, picture.draft, part.scaled(picture.full.size, size))
    elif not picture.done and now - picture.changed > SETTLE:
        left = part.height - picture.rows
        count = min(left, max(left // 8, 8, int(BUDGET / (max(picture.pixel, 1e-12) * part.width))))
        _timed(held, seen, picture, picture.full, part.rows(picture.rows, count))
        picture.rows += count


def _timed(held: GpuScene, seen: np.ndarray, picture: Picture, target: Target, part: Part) -> None:
    """March a part of a target, and learn what a pixel takes."""
    began = time.perf_counter()
    march(held, seen, target, part)
    target.wait()
    cost = (time.perf_counter() - began) / part.pixels
    picture.pixel = cost if not picture.pixel or cost < picture.pixel else 0.5 * (cost + picture.pixel)


def show(picture: Picture, projection: Projection, holdout: bool = False) -> None:
    """The picture into the viewport: the rows that are marched in full, and the draft's below them."""
    part, rows = picture.part, picture.rows
    lay(picture.full, part.rows(0, rows), projection, holdout)
    if picture.draft is not None:
        lay(picture.draft, part.rows(rows, part.height - rows), projection, holdout)


def lay(target: Target, part: Part, projection: Projection, holdout: bool = False) -> None:
    """A part of a target's picture into the viewport whose framebuffer is bound: over what is behind it, hidden by what is in front.
    holdout: black where it is."""
    global _composite
    if not part.pixels:
        return
    if _composite is None:
        _composite = shader.composite_shader()
    p = projection.matrix
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.depth_mask_set(True)
    gpu.state.blend_set("ALPHA_PREMULT")
    gpu.state.scissor_test_set(True)
    left, bottom = gpu.state.viewport_get()[:2]
    gpu.state.scissor_set(left + part.left, bottom + part.bottom, part.width, part.height)
    _composite.bind()
    _composite.uniform_float("projection", (p[2, 2], p[2, 3], p[3, 2], p[3, 3]))
    _composite.uniform_float("seen", 0.0 if holdout else 1.0)
    _composite.uniform_sampler("picture", target.picture)
    _composite.uniform_sampler("depths", target.depths)
    triangle().draw(_composite)
    restore()


def restore() -> None:
    """The drawing state that Blender expects of a draw handler, after an error too."""
    gpu.state.scissor_test_set(False)
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)
    gpu.state.blend_set("NONE")


def forget_shader() -> None:
    """Let go of the shader."""
    global _composite
    _composite = None
