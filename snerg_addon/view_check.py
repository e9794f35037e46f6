"""Checks of a rendered dataset: why its pictures are empty, and whether poses and pictures fit each other."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import bpy
import numpy as np

from ..core.geometry.camera import Camera
from ..core.io.exr import has_openimageio, read_channels
from .bridge import set_camera
from .capture_scene import CaptureSettings, capture_scene
from .render_evaluation import escaped, evaluate_render, render, temporary_camera
from .rendered import corners_of, rendered_instances

CHECKED = 96  # pixels of the longer side of the depth images that are compared
SEEN_THROUGH = 0.02  # relative depth by which a point lies before what another view shows there, so that this view should show the point
MISMATCH = 0.1  # share of points at which two views contradict each other; edges of exact poses give less than 0.02
FEW = 30  # points that two views must share for a judgement
NO_DEPTH = 1e10  # Cycles' depth where nothing is
NOTHING = 1e9  # depths from here on are NO_DEPTH
BEFORE_FAR = 0.999  # share of the clip end from which on a depth is nothing: EEVEE writes the clip end there


def why_clear(scene: bpy.types.Scene, cameras: Sequence[Camera], frame: int | None, settings: CaptureSettings) -> str:
    """Why no camera shows anything: half a sentence with what to do."""
    layer = settings.view_layer or scene.view_layers[0].name

    def read(depsgraph: bpy.types.Depsgraph) -> list[np.ndarray]:
        return [corners_of(instance) for instance in rendered_instances(depsgraph)]

    boxes = evaluate_render(scene, read, frame=frame, layer=layer)
    if not boxes:
        return f"nothing on the view layer {layer!r} renders; show objects to renders, or choose another layer"
    depths = [camera.project(np.concatenate(boxes))[1] for camera in cameras]
    if all((depth >= camera.far).all() for camera, depth in zip(cameras, depths, strict=True)):
        return f"all objects are farther from the cameras than their clip end ({cameras[0].far:.4g}); raise the clip end"
    if all((depth <= camera.near).all() for camera, depth in zip(cameras, depths, strict=True)):
        return f"all objects are behind the cameras, or nearer than their clip start ({cameras[0].near:.4g}); turn or move the cameras"
    if not any(overlaps(camera, corners) for camera in cameras for corners in boxes):
        return "no object is in front of a camera; point the cameras at the objects"
    return "objects are before the cameras but leave no trace, as with holdout, transparent materials or tiny size; render one to see why"


def overlaps(camera: Camera, corners: np.ndarray) -> bool:
    """Whether the bounding rectangle of a box's corners [8, 3] in the picture, before the camera, meets the picture."""
    pixels, depth = camera.project(corners)
    if not (depth > camera.near).all():
        return bool((depth > camera.near).any())
    return bool((pixels.max(axis=0) > 0).all() and (pixels.min(axis=0) < [camera.width, camera.height]).all())


def mismatch(
    scene: bpy.types.Scene, frames: Sequence[int | None], cameras: Sequence[Camera], alphas: Sequence[np.ndarray], settings: CaptureSettings
) -> str:
    """A sentence if two views contradict each other; '' if they agree, or share too little to tell.

    The depth of one view, rendered small, gives points of the world. In another view these must lie on what its picture shows, or
    behind it. alphas: of the pictures [H, W] uint8.
    """
    pair = best_pair(cameras, alphas) if has_openimageio() else None
    if pair is None:
        return ""
    one, other = pair
    points, shown = surface_points(scene, frames[one], cameras[one], settings), render_depth(scene, frames[other], cameras[other], settings)
    if points is None or shown is None:
        return ""
    seen = np.array(
        [contradicted(points, *shown, cameras[other], alphas[other]), contradicted(points, None, None, cameras[one], alphas[one])]
    )
    worst = seen.max()
    if worst <= MISMATCH:
        return ""
    return (
        f"The views {cameras[one].name!r} and {cameras[other].name!r} contradict each other at {100 * worst:.0f} % of the points that they "
        "share: something moves, faces the camera or is simulated between views; hold it still, or the field will be blurred."
    )


def best_pair(cameras: Sequence[Camera], alphas: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """The first view that shows something, and of those that do the one whose axis is nearest to 30 degrees from it; None without two."""
    shown = [index for index, alpha in enumerate(alphas) if alpha.any()]
    if len(shown) < 2:
        return None
    axis = cameras[shown[0]].camera_to_world[:3, 2]
    angles = [abs(np.degrees(np.arccos(np.clip(cameras[index].camera_to_world[:3, 2] @ axis, -1, 1))) - 30) for index in shown[1:]]
    return shown[0], shown[1 + int(np.argmin(angles))]


def surface_points(scene: bpy.types.Scene, frame: int | None, camera: Camera, settings: CaptureSettings) -> np.ndarray | None:
    """World points [N, 3] of a view's surfaces, away from edges in depth; None where the engine gives no depth."""
    found = render_depth(scene, frame, camera, settings)
    if found is None:
        return None
    small, depth = found
    rows, columns = np.nonzero(flat(depth))
    origins, directions = small.rays(np.stack([columns, rows], axis=-1))
    along = depth[rows, columns] / small.cosines(directions)
    return np.asarray(origins + directions * along[:, None])


def flat(depth: np.ndarray) -> np.ndarray:
    """Whether a pixel [H, W] and its 8 neighbours show surfaces of about the same depth."""
    padded = np.pad(depth, 1, constant_values=np.inf)
    around = np.stack([padded[y : y + depth.shape[0], x : x + depth.shape[1]] for y in range(3) for x in range(3)])
    return np.asarray((depth < NOTHING) & (around.max(axis=0) < depth * 1.1) & (around.min(axis=0) > depth / 1.1))


def contradicted(points: np.ndarray, small: Camera | None, depth: np.ndarray | None, camera: Camera, alpha: np.ndarray) -> float:
    """The share of points [N, 3] in a view's picture where the picture is clear or shows what is behind them; 0 for too few points."""
    inside = camera.shows(points)
    if inside.sum() < FEW:
        return 0.0
    pixels, along = camera.project(points[inside])
    column, row = np.minimum(pixels.astype(int), [camera.width - 1, camera.height - 1]).T
    wrong = near_most(alpha)[row, column] == 0
    if small is not None and depth is not None:
        scale = [small.width / camera.width, small.height / camera.height]
        column, row = np.minimum((pixels * scale).astype(int), [small.width - 1, small.height - 1]).T
        wrong |= -near_most(-depth)[row, column] > along * (1 + SEEN_THROUGH)
    return float(wrong.mean())


def near_most(values: np.ndarray) -> np.ndarray:
    """The largest value [H, W] among a pixel and its 8 neighbours."""
    padded = np.pad(values, 1, mode="edge")
    return np.stack([padded[y : y + values.shape[0], x : x + values.shape[1]] for y in range(3) for x in range(3)]).max(axis=0)


def render_depth(scene: bpy.types.Scene, frame: int | None, camera: Camera, settings: CaptureSettings) -> tuple[Camera, np.ndarray] | None:
    """(the camera at a small size, its depth [H, W] along the view axis, at least NOTHING where nothing is); None without a depth pass."""
    scale = min(1.0, CHECKED / max(camera.width, camera.height))
    small = camera.resized(max(1, round(camera.width * scale)), max(1, round(camera.height * scale)))
    with capture_scene(scene, settings) as copy, temporary_camera() as stand_in, tempfile.TemporaryDirectory(prefix="snerg-") as room:
        layer, image = copy.view_layers[0], copy.render.image_settings
        layer.use_pass_z = True
        if hasattr(image, "media_type"):
            image.media_type = "MULTI_LAYER_IMAGE"
        image.file_format, image.color_depth = "OPEN_EXR_MULTILAYER", "32"
        if hasattr(image, "use_exr_interleave"):
            image.use_exr_interleave = True  # one part: Blender 5.0 cannot write several with a pixel aspect other than 1
        path = Path(room) / "depth.exr"
        copy.render.filepath = escaped(path)
        if frame is not None:
            copy.frame_current, copy.frame_subframe = frame, 0.0
        if copy.render.engine == "CYCLES":
            copy.cycles.samples, copy.cycles.use_denoising, copy.cycles.use_adaptive_sampling = 1, False, False
        copy.collection.objects.link(stand_in)
        set_camera(stand_in, small, copy)
        copy.camera = stand_in
        try:
            render(copy, write_still=True)
        except RuntimeError:
            return None
        depth = read_depth(path)
    if depth is None or depth.shape != (small.height, small.width):
        return None
    return small, np.where(depth > BEFORE_FAR * small.far, NO_DEPTH, depth)


def read_depth(path: Path) -> np.ndarray | None:
    """The depth pass [H, W] of a multilayer OpenEXR file; None where there is none."""
    found = [values for name, values in read_channels(path).items() if name.endswith((".Depth.Z", ".Depth.V"))]
    return found[0].astype(np.float64) if found else None
