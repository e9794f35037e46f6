"""Measures the marcher: preview times, a profile by function, memory bandwidth, and how the time grows with rays and samples."""

from __future__ import annotations

import re
import statistics
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import CodeType, FrameType
from typing import Any

import numpy as np
from common import ROOT
from naive_march import naive_march

from snerg.core.geometry.camera import Camera
from snerg.core.rendering import interpolator, ray_marcher
from snerg.core.rendering.acceleration import acceleration_of
from snerg.core.rendering.render import PREVIEW_TOLERANCE, MarchSettings, march_rays, render_progressively, render_scene, tiled_pixels
from snerg.core.scene.scene import Scene

SINGLE_THREAD = MarchSettings(threads=1)
PREVIEW = MarchSettings(PREVIEW_TOLERANCE)
REPEATS = 3  # timed runs, after one that is not timed
RANDOM_WORDS = 2**22  # voxels read in random order


def sized(camera: Camera, size: int) -> Camera:
    """A camera with `size` pixels along its longer side."""
    scale = size / max(camera.width, camera.height)
    return camera.resized(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def timed(work: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Seconds of the fastest of some repeats, after a warm-up: other load on the machine can only add time."""
    work()
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def preview(scene: Scene, cameras: Sequence[Camera], size: int) -> dict[str, Any]:
    """Render times at two sizes, `size` pixels along the longer side and twice that, and against the naive march.

    For each size, seconds: median over the views ("seconds"), the slowest view, median to the first picture of a progressive render
    ("first"), median at the tolerance of Blender's preview ("shown").
    """
    result: dict[str, Any] = {"views": len(cameras)}
    for name, pixels in (("small", size), ("large", 2 * size)):
        views = [sized(camera, pixels) for camera in cameras]
        seconds = [timed(lambda view=view: render_scene(scene, view)) for view in views]  # type: ignore[misc]
        first = [timed(lambda view=view: next(render_progressively(scene, view))) for view in views]  # type: ignore[misc]
        shown = [timed(lambda view=view: render_scene(scene, view, PREVIEW)) for view in views]  # type: ignore[misc]
        medians = {key: statistics.median(values) for key, values in (("seconds", seconds), ("first", first), ("shown", shown))}
        result[name] = {"pixels": pixels, "slowest": max(seconds), **medians}
    view = sized(cameras[0], size)
    ours = timed(lambda: render_scene(scene, view))
    began = time.perf_counter()
    naive = naive_march(scene, view)
    baseline = time.perf_counter() - began
    difference = float(np.abs(naive - render_scene(scene, view).over()).max())
    return result | {"naive": {"seconds": baseline, "ours": ours, "times": baseline / ours, "difference": difference}}


class Profile:
    """A profiler: seconds spent in each function of this package, calls into NumPy included, in threads started while it is open."""

    def __init__(self) -> None:
        self.seconds: dict[CodeType, float] = defaultdict(float)
        self.local = threading.local()

    def __enter__(self) -> Profile:
        threading.setprofile(self._event)
        return self

    def __exit__(self, *problem: object) -> None:
        threading.setprofile(None)  # type: ignore[arg-type]

    def _event(self, frame: FrameType, what: str, _argument: object) -> None:
        if what not in ("call", "return"):
            return
        now, local = time.perf_counter(), self.local.__dict__
        stack: list[CodeType | None] = local.setdefault("stack", [])
        if stack and stack[-1] is not None:
            self.seconds[stack[-1]] += now - local["since"]
        if what == "return":
            if stack:
                stack.pop()
        elif frame.f_code.co_filename.startswith(str(ROOT / "core")):
            stack.append(frame.f_code)
        else:  # a function of Python or NumPy counts for its caller
            stack.append(stack[-1] if stack else None)
        local["since"] = time.perf_counter()

    def rows(self) -> list[dict[str, Any]]:
        """{"function", "what", "seconds"}, slowest first; nested functions count for the function that defines them."""
        found: dict[str, dict[str, Any]] = {}
        for code, seconds in self.seconds.items():
            module = code.co_filename.rsplit("/", 1)[-1].removesuffix(".py")
            name = f"{module}.{code.co_qualname.split('.<locals>')[0]}"
            row = found.setdefault(name, {"function": name, "what": "", "seconds": 0.0})
            row["seconds"] += seconds
            text = code.co_consts[0] if code.co_consts and isinstance(code.co_consts[0], str) else ""
            if text and "<locals>" not in code.co_qualname:
                row["what"] = re.split(r"(?<!eq)\.(?: |$)", text.strip().split("\n")[0])[0]
        return sorted(found.values(), key=lambda row: -row["seconds"])


def profile(scene: Scene, cameras: Sequence[Camera], size: int) -> dict[str, Any]:
    """Profile rendering some views in one thread: seconds in total and by function."""
    views = [sized(camera, size) for camera in cameras]
    alone = sum(timed(lambda view=view: render_scene(scene, view, SINGLE_THREAD), 1) for view in views)  # type: ignore[misc]
    with Profile() as found:
        began = time.perf_counter()
        for view in views:
            render_scene(scene, view, SINGLE_THREAD)
        watched = time.perf_counter() - began
    rows = found.rows()
    left = watched - sum(row["seconds"] for row in rows)
    rows.append({"function": "the rest", "what": "starting threads and assembling the picture", "seconds": left})
    return {"views": len(views), "pixels": size, "seconds": alone, "seconds_watched": watched, "rows": rows}


@contextmanager
def interpolated() -> Iterator[list[np.ndarray]]:
    """Records the stencils that the marcher interpolates: an array of base indices [n] a call."""
    calls: list[np.ndarray] = []

    class Recorder(ray_marcher.Interpolator):
        def __call__(self, base: np.ndarray, fraction: np.ndarray) -> np.ndarray:
            calls.append(base.copy())
            return super().__call__(base, fraction)

    original = ray_marcher.Interpolator
    ray_marcher.Interpolator = Recorder  # type: ignore[misc]
    try:
        yield calls
    finally:
        ray_marcher.Interpolator = original  # type: ignore[misc]


def gathering(scene: Scene, camera: Camera, size: int) -> dict[str, Any]:
    """The time of a single-threaded march, and of only reading the same voxels, in the same and in random order."""
    view, acceleration = sized(camera, size), acceleration_of(scene)
    with interpolated() as calls:
        render_scene(scene, view, SINGLE_THREAD)
    reader = ray_marcher.Interpolator(acceleration)
    spare = np.empty((interpolator.MAX_INTERPOLATED, *acceleration.voxels.shape[1:]), acceleration.voxels.dtype)

    def read(calls: list[np.ndarray]) -> None:
        for base in calls:
            for corner in reader.corners:
                corner.take(base, axis=0, out=spare[: len(base)], mode="clip")

    samples = sum(len(base) for base in calls)
    rng = np.random.default_rng(0)
    random_bases = rng.integers(
        0, len(reader.corners[-1]), max(1, RANDOM_WORDS // 8 // interpolator.MAX_INTERPOLATED) * interpolator.MAX_INTERPOLATED
    ).reshape(-1, interpolator.MAX_INTERPOLATED)
    return {
        "pixels": size,
        "rays": view.width * view.height,
        "samples": samples,
        "word_bytes": acceleration.voxels.itemsize * (acceleration.voxels.shape[1] if acceleration.voxels.ndim > 1 else 1),
        "march": timed(lambda: render_scene(scene, view, SINGLE_THREAD)),
        "in_order": timed(lambda: read(calls)),
        "at_random": timed(lambda: read(list(random_bases))) * 8 * samples / (8 * random_bases.size),
    }


def growing(scene: Scene, camera: Camera, size: int) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Scaling of the render time: (rays, seconds) of a view at growing sizes, (samples, seconds) of it at growing focal lengths."""
    rays = []
    for share in (0.25, 0.5, 0.75, 1, 1.25, 1.5, 1.75, 2):
        view = sized(camera, max(8, round(share * size)))
        rays.append((float(view.width * view.height), timed(lambda view=view: render_scene(scene, view))))  # type: ignore[misc]
    samples = []
    for zoom in (0.3, 0.5, 0.7, 0.85, 1, 1.15, 1.3):
        view = sized(camera, size)
        view = replace(view, focal=(zoom * view.focal[0], zoom * view.focal[1]))
        rays_of_view = view.rays(tiled_pixels(view.width, view.height))
        samples.append(
            (float(march_rays(scene, *rays_of_view, near=view.near).samples or 0), timed(lambda view=view: render_scene(scene, view)))
        )  # type: ignore[misc]
    return rays, samples
