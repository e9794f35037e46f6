"""Measures the largest error of every numerical promise over many random scenes, rays and cameras, and prints it beside what is claimed.

    python bench/proof.py [--count 1000] [--seed 0] [--only march,lens]

Exit status 1 where a claim does not hold. The same seed measures the same scenes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from oracle import dense_march
from scenes import looking, make_cameras, make_forward, make_forward_cameras, random_network, random_scene, rotation, snerg_from_volume
from snerg.core.baking.visibility_rays import RAY_SPACING, ray_grid
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.distortion import Distortion
from snerg.core.nerf.frame import NETWORK_TRANSMITTANCE, Frame
from snerg.core.nerf.model import ViewNetwork
from snerg.core.nerf.volume_rendering import composite, optical_depth
from snerg.core.rendering.early_termination import ROUNDING, error_bound
from snerg.core.rendering.render import MarchSettings, render_scene
from snerg.core.scene.half_features import LEVELS, with_half_features
from snerg.core.scene.quantize import quantize
from snerg.core.scene.scene import Scene

Draw = np.random.Generator
EXACT = MarchSettings()
PACKED_RAYS = 3
SLOW = 10  # a promise whose scenes are slow is measured on so many fewer


@dataclass(frozen=True)
class Promise:
    """What is claimed of one thing: `error`, of a random case, is at most `claim`."""

    name: str
    claim: float
    text: str  # what the error is, with its unit
    error: Callable[[Draw], float]
    share: int = 1  # of the cases that are asked for, one of so many is measured


def pictures(scene: Scene, camera: Camera, settings: MarchSettings = EXACT) -> float:
    """The largest difference of a march from the float64 reference: of opacity, and of the picture over three backgrounds.

    Without the pixels in which the network may set in or not, by rounding (see early_termination.error_bound).
    """
    got, truth = (
        render_scene(scene, camera, settings),
        dense_march(scene, camera, settings.per_sample_network and scene.network is not None),
    )
    clear = np.abs(truth.transmittance - NETWORK_TRANSMITTANCE) > 1.5 * ROUNDING + settings.tolerance * (
        settings.tolerance > EXACT.tolerance
    )
    over = [np.abs(got.over(b) - truth.over(b))[clear].max(initial=0) for b in ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0.2, 0.9, 0.5))]
    return float(max(*over, np.abs(1 - got.alpha - truth.transmittance).max()))


def any_scene(draw: Draw) -> Scene:
    """A random scene, with and without a network, equation 9, and colours above their opacity."""
    return random_scene(draw, *(bool(draw.integers(2)) for _ in range(3)))


def any_camera(draw: Draw, width: int = 16, height: int = 12) -> Camera:
    """One of the cameras of tests, of each kind."""
    cameras = make_cameras(size=2.0, width=width, height=height)
    return cameras[int(draw.integers(len(cameras)))]


def march(draw: Draw) -> float:
    return pictures(any_scene(draw), any_camera(draw))


def tolerance(draw: Draw) -> float:
    asked = float(10 ** draw.uniform(-3.5, -0.5))
    settings = MarchSettings(asked, per_sample_network=bool(draw.integers(2)))
    scene = any_scene(draw)
    return pictures(scene, any_camera(draw), settings) / error_bound(asked, scene, settings.per_sample_network)


def strong_network(draw: Draw) -> float:
    scene = random_scene(draw, False, bool(draw.integers(2)), False)
    assert scene.network is not None
    strong = ViewNetwork(*(np.float32(draw.uniform(1, 10)) * a for a in scene.network))
    scene = replace(scene, network=strong)
    return pictures(scene, any_camera(draw)) / error_bound(EXACT.tolerance, scene)


def forward_facing(draw: Draw) -> float:
    scene = make_forward(bool(draw.integers(2)))
    assert scene.ndc is not None
    camera = make_forward_cameras(scene.ndc, 16, 12)[int(draw.integers(2))]
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = rotation(tuple(draw.normal(0, 0.02, 3))), draw.normal(0, 0.02, 3)
    return pictures(scene, replace(camera, camera_to_world=camera.camera_to_world @ turn))


def difference(one: Frame, other: Frame) -> float:
    return float(max(np.abs(one.over() - other.over()).max(), np.abs(one.alpha - other.alpha).max()))


def skipping(draw: Draw) -> float:
    scene, camera = any_scene(draw), any_camera(draw)
    return difference(*(render_scene(scene, camera, MarchSettings(tolerance=0, skip=skip)) for skip in (True, False)))


def batches(draw: Draw) -> float:
    scene, camera = any_scene(draw), any_camera(draw)
    settings = (MarchSettings(tolerance=0, batch=int(draw.integers(1, 200)), threads=int(draw.integers(1, 4))), MarchSettings(tolerance=0))
    return difference(*(render_scene(scene, camera, one) for one in settings))


def long_scene(draw: Draw) -> tuple[Scene, Camera, int]:
    """A long grid with clutter at its far end, and a camera that looks along it."""
    length = int(draw.integers(1100, 4090))
    values = np.zeros((length, 12, 14, 8), np.uint8)
    far = values[-60:]
    alpha = draw.integers(0, 256, far.shape[:3]) * (draw.random(far.shape[:3]) < draw.choice([0.02, 0.2, 1.0]))
    far[..., 7], far[..., :7] = alpha, np.rint(draw.random((*alpha.shape, 7)) * alpha[..., None])
    pose = np.eye(4)
    pose[:3, :3] = rotation(tuple(draw.normal(0, 1, 3)))
    pose[:3, 3] = -pose[:3, :3] @ np.array(values.shape[:3]) / 2
    scene = snerg_from_volume(values, random_network(int(draw.integers(1000))), grid_to_world=pose, voxel_size=1.0)
    eye = pose[:3, :3] @ [-0.55 * length, *draw.normal(0, 3, 2)]
    return scene, Camera(12, 8, (0.8 * length,) * 2, (6, 4), looking(tuple(eye), (0, 0, 0))), length


def long_picture(draw: Draw) -> float:
    scene, camera, _ = long_scene(draw)
    return pictures(scene, camera)


def long_depth(draw: Draw) -> float:
    scene, camera, _ = long_scene(draw)
    got, truth = render_scene(scene, camera, MarchSettings(tolerance=0)), dense_march(scene, camera)
    seen = got.alpha > 0.1
    return float(np.abs(got.depth[seen] - truth.depth[seen]).max(initial=0))


def far_away(draw: Draw) -> float:
    scene, camera = any_scene(draw), any_camera(draw)
    shift = np.eye(4)
    shift[:3, 3] = 10 ** draw.uniform(3, 6) * draw.normal(size=3) / 2
    moved = replace(scene, grid_to_world=shift @ scene.grid_to_world), replace(camera, camera_to_world=shift @ camera.camera_to_world)
    return difference(render_scene(scene, camera), render_scene(*moved))


def packed(composited: Callable[..., np.ndarray], draw: Draw) -> float:
    """Relative error of the sums of weights, of rays of up to ten thousand samples. composited: (depth, values, ray) to the sums."""
    count = 12_000
    ray = np.sort(draw.choice(PACKED_RAYS, count, p=draw.dirichlet([1, 1, 0.05]))).astype(np.int32)
    depth = (10 ** draw.uniform(-8, 0) * draw.uniform(0.5, 1.5, count)).astype(np.float32)
    got = np.asarray(composited(depth, np.ones((count, 1), np.float32), ray))[:, 0]
    truth = -np.expm1(-np.bincount(ray, depth.astype(np.float64), PACKED_RAYS))
    return float(np.abs(got[truth > 0] / truth[truth > 0] - 1).max())


def packed_numpy(draw: Draw) -> float:
    return packed(lambda *arrays: composite(np, *arrays, PACKED_RAYS)[0], draw)


@cache
def compiled() -> Callable[..., np.ndarray]:
    """`composite` of JAX, compiled once."""
    import jax
    import jax.numpy as jnp

    return jax.jit(lambda *arrays: composite(jnp, *arrays, PACKED_RAYS)[0])


def packed_jax(draw: Draw) -> float:
    return packed(compiled(), draw)


def finite_depth(draw: Draw) -> float:
    density = draw.choice([0, 1e-40, 1, 1e30, 3e38, np.inf, -np.inf, -1], 100).astype(np.float32)
    length = draw.choice([0, 1e-40, 1e-6, 1, 1e4, 1e8], 100).astype(np.float32)
    depth = optical_depth(np, density, length)
    return float((~(np.isfinite(depth) & (depth >= 0) & (depth <= 80))).sum())


def lens(draw: Draw) -> float:
    """Pixels between where a ray of a pixel's centre is projected to, and the centre."""
    bends = (None, Distortion("opencv", tuple(draw.normal(0, [0.1, 0.02, 0.002, 0.002]))), Distortion("fisheye", (0.05, -0.02, 0.004, 0.0)))
    camera = replace(any_camera(draw, 24, 18), distortion=None)
    if camera.projection == "perspective":
        camera = replace(camera, distortion=bends[int(draw.integers(3))])
    valid = camera.valid_pixels()
    origins, directions = camera.rays()
    pixels, _ = camera.project(origins + directions * draw.uniform(1, 50))
    error = np.abs(pixels - camera.pixels() - 0.5).max(axis=-1)
    return float(error[slice(None) if valid is None else valid.reshape(-1)].max(initial=0))


def quantising(draw: Draw) -> float:
    """Levels that the mean of quantised values of one voxel is off from the value."""
    alpha = draw.random() * draw.choice([0.02, 0.2, 1.0])
    values = np.tile(np.float32([*(draw.random(3) * alpha), alpha]), (40_000, 1))
    error = np.abs(quantize(values, draw.random(values.shape, np.float32)).mean(axis=0) - 255 * values[0]).max()
    return float(error)


def half_features(draw: Draw) -> float:
    """Levels by which features at half the resolution are above their alpha, or differ from themselves where all of a group are alike."""
    scene = snerg_from_volume(_groups(draw), random_network(0), grid_to_world=np.eye(4), voxel_size=1.0)
    cells = with_half_features(scene.cells)
    above = np.maximum(cells[..., 3:7].astype(int) - cells[..., 7:], 0).max()
    return float(max(above, np.abs(cells[..., 3:7].astype(int) - scene.cells[..., 3:7]).max()))


def _groups(draw: Draw) -> np.ndarray:
    """[62, 32, 32, 8]: opaque voxels whose features are levels that are stored exactly, alike in each group of 2 x 2 x 2 of a cell."""
    straight = LEVELS[draw.integers(0, 256, (32, 17, 17, 4))].repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)[1:63, 1:33, 1:33]
    return np.concatenate([np.full((62, 32, 32, 3), 99), straight, np.full((62, 32, 32, 1), 255)], axis=-1).astype(np.uint8)


def visibility_rays(draw: Draw) -> float:
    """Voxels between two neighbouring rays of visibility, at a random point of the box that the camera sees."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(tuple(draw.normal(0, 1, 3))), draw.normal(0, 1, 3)
    box, voxel = Box(pose, draw.uniform(0.5, 2, 3)), float(10 ** draw.uniform(-2.5, -1))
    eye = pose[:3, 3] + 10 ** draw.uniform(-0.5, 1.5) * draw.normal(size=3)
    width = int(draw.integers(1, 500))
    camera = Camera(width, width, (width * draw.uniform(0.5, 3),) * 2, (width / 2, width / 2), looking(tuple(eye), tuple(pose[:3, 3])))
    grid = ray_grid(camera, box, voxel, None)
    points = pose[:3, 3] + (draw.uniform(-0.5, 0.5, (500, 3)) * box.size) @ pose[:3, :3].T
    pixels, depth = camera.project(points)
    seen = (depth > 0) & ((pixels >= 0) & (pixels <= width)).all(axis=-1)
    if not seen.any():
        return 0.0
    outside = np.maximum(grid.low - pixels[seen], pixels[seen] - grid.low - grid.step * [grid.columns, grid.rows]).max()
    return float(max(depth[seen].max() * (grid.step / camera.focal).max() / voxel, np.inf if outside > 1e-6 * width else 0))


PROMISES = (
    Promise("march", 1e-4, "of a displayed value", march),
    Promise("tolerance", 1, "share of the bound for a tolerance from 3e-4 to 0.3", tolerance),
    Promise("strong network", 1, "share of the bound on rounding, weights up to 10 times as large", strong_network),
    Promise("forward-facing", 1e-4, "of a displayed value", forward_facing),
    Promise("skipping", 1e-6, "of a displayed value, against a march without skipping", skipping),
    Promise("batches", 1e-6, "of a displayed value, against another batch and thread count", batches),
    Promise("long grids", 1e-4, "of a displayed value, 1100 to 4090 voxels", long_picture, SLOW),
    Promise("depth of long grids", 1e-2, "voxels", long_depth, SLOW),
    Promise("far from the origin", 1 / 255, "of a displayed value, up to 1e6 units", far_away),
    Promise("packed samples, NumPy", 1e-6, "of the opacity of up to 12,000 samples", packed_numpy),
    Promise("packed samples, JAX", 1e-6, "of the opacity of up to 12,000 samples", packed_jax),
    Promise("optical depth", 0, "values that are not in [0, 80]", finite_depth),
    Promise("lens", 1e-3, "pixels between a ray and its projection", lens),
    Promise("quantising", 0.51, "levels between a value and the mean of what is stored", quantising),
    Promise("half features", 0, "levels, of features that are stored exactly", half_features, SLOW),
    Promise("visibility", RAY_SPACING * (1 + 1e-9), "voxels of the marched scene between two rays", visibility_rays),
)


def measure(promise: Promise, count: int, seed: int) -> float:
    """The largest error of a promise in `count` random cases; NaN counts as infinite."""
    errors = (promise.error(np.random.default_rng([seed, number])) for number in range(count))
    return max((error if error == error else np.inf for error in errors), default=0.0)


def prove(promises: Iterable[Promise], count: int, seed: int) -> bool:
    """Print a table of the promises; returns whether all hold."""
    print(f"{'promise':24s} {'claim':>9s} {'largest':>9s} {'cases':>6s} {'seconds':>8s}  error")
    holds = True
    for promise in promises:
        cases, began = max(-(-count // promise.share), 1), time.monotonic()
        largest = measure(promise, cases, seed)
        kept = largest <= promise.claim
        holds &= kept
        seconds = time.monotonic() - began
        verdict = "" if kept else "  DOES NOT HOLD"
        print(f"{promise.name:24s} {promise.claim:9.3g} {largest:9.3g} {cases:6d} {seconds:8.1f}  {promise.text}{verdict}", flush=True)
    return holds


def main() -> int:
    parser = argparse.ArgumentParser(description="Measure the largest error of every numerical promise.")
    parser.add_argument("--count", type=int, default=1000, help="random cases of each promise")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="names, separated by commas")
    options = parser.parse_args()
    chosen = [promise for promise in PROMISES if not options.only or promise.name in options.only.split(",")]
    return 0 if prove(chosen, options.count, options.seed) else 1


if __name__ == "__main__":
    sys.exit(main())
