"""Rendering a dataset from a Blender scene: views on transparent film, whose colours any NeRF tool can compare."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import bpy

from ..core.capture.camera import Camera
from ..core.capture.images import read_size
from ..core.capture.readers.transforms import write_transforms
from ..core.errors import SnergError
from ..core.files import new_folder
from ..core.grid.box import Box
from .bridge import camera_from_blender, set_camera, temporary_camera

Shot: TypeAlias = bpy.types.Object | Camera


@dataclass(frozen=True)
class CaptureSettings:
    """test_every: every n-th camera is held out of training, to measure on; 0 holds none out."""

    test_every: int = 8


def render_dataset(
    scene: bpy.types.Scene,
    shots: Sequence[Shot],
    folder: Path,
    settings: CaptureSettings | None = None,
    box: Box | None = None,
    progress: Callable[[float, str], None] = lambda fraction, message: None,
) -> dict[str, Any]:
    """Render every shot and write the folder whole: train/, test/, transforms_train.json, transforms_test.json.

    shots: camera objects, or core cameras of the scene's resolution. box: recorded as what the scene is about.
    Returns {"train", "test": views, "width", "height": pixels}. Raises SnergError on shots that cannot be
    rendered; `progress` may raise Cancelled. No setting of the scene is touched.
    """
    steps = render_steps(scene, shots, folder, settings, box)
    try:
        while True:
            try:
                progress(*next(steps))
            except StopIteration as end:
                return dict(end.value)
    finally:
        steps.close()


def render_steps(
    scene: bpy.types.Scene,
    shots: Sequence[Shot],
    folder: Path,
    settings: CaptureSettings | None = None,
    box: Box | None = None,
) -> Any:
    """`render_dataset` as a generator of (fraction, message), a view a step; closing it leaves nothing behind."""
    settings = settings or CaptureSettings()
    cameras = core_cameras(scene, shots)
    splits = split_names(len(shots), settings.test_every)
    recorded: dict[str, Any] = {}
    with new_folder(folder) as part:
        for index, (shot, camera) in enumerate(zip(shots, cameras, strict=True)):
            yield index / len(shots), f"View {index + 1} of {len(shots)}: {camera.name}"
            recorded = render_view(scene, shot, part / f"{splits[index]}.png", camera)
        for split in ("train", "test"):
            chosen = [i for i, name in enumerate(splits) if name.startswith(split)]
            if chosen:
                names = [f"./{splits[i]}" for i in chosen]
                write_transforms(part / f"transforms_{split}.json", [cameras[i] for i in chosen], names, box, {"snerg_render": recorded})
    held_out = sum(name.startswith("test") for name in splits)
    first = cameras[0]
    return {"train": len(shots) - held_out, "test": held_out, "width": first.width, "height": first.height}


def core_cameras(scene: bpy.types.Scene, shots: Sequence[Shot]) -> list[Camera]:
    """The shots as core cameras. Raises SnergError when there are none, or one cannot be used."""
    if not shots:
        raise SnergError("There is no camera to render from; add cameras to the scene, select some, or use the rig.")
    depsgraph = evaluated(scene)
    return [shot if isinstance(shot, Camera) else camera_from_blender(shot, scene, depsgraph) for shot in shots]


def evaluated(scene: bpy.types.Scene) -> bpy.types.Depsgraph:
    """The scene's evaluated state; of any scene, not only the one in the window."""
    if bpy.context.scene == scene:
        return bpy.context.evaluated_depsgraph_get()
    layer = scene.view_layers[0]
    layer.update()
    return layer.depsgraph


def split_names(count: int, test_every: int) -> list[str]:
    """'train/r_0', 'test/r_0', ... for each of `count` views, every `test_every`-th for testing."""
    counts = {"train": 0, "test": 0}
    names = []
    for index in range(count):
        split = "test" if test_every > 1 and (index + 1) % test_every == 0 else "train"
        names.append(f"{split}/r_{counts[split]}")
        counts[split] += 1
    return names


def render_view(scene: bpy.types.Scene, shot: Shot, path: Path, camera: Camera) -> dict[str, Any]:
    """Render one view to a PNG with straight alpha, and return the settings that decide its colours.

    Raises SnergError when Blender wrote no picture, or one of another size than `camera`'s.
    """
    with capture_scene(scene) as copy, temporary_camera() as stand_in:
        copy.render.filepath = str(path)
        if isinstance(shot, Camera):
            copy.collection.objects.link(stand_in)
            set_camera(stand_in, shot, copy)
            copy.camera = stand_in
        else:
            copy.camera = shot
        try:
            bpy.ops.render.render(write_still=True, scene=copy.name)
        except RuntimeError as error:  # how Blender's operators tell what went wrong
            why = str(error).strip()
            raise SnergError(f"Blender could not render {camera.name!r} ({why}); render it once by hand to see why.") from error
        recorded = colour_settings(copy)
    if not path.is_file():
        raise SnergError(f"Blender wrote no picture for {camera.name!r}; check that the scene renders and that the disk has space.")
    if read_size(path) != (camera.width, camera.height):
        raise SnergError(f"Blender rendered {camera.name!r} at another size than the scene's resolution; turn off what crops it.")
    return recorded


@contextmanager
def capture_scene(scene: bpy.types.Scene) -> Iterator[bpy.types.Scene]:
    """A copy of the scene, sharing its objects, set for capture (hard cases 7, 8); taken away at the end.

    Because every setting is made on the copy, the artist's own are never touched, whatever happens.
    """
    copy, camera = scene.copy(), scene.camera
    try:
        render, image = copy.render, copy.render.image_settings
        copy.timeline_markers.clear()  # markers bind cameras to frames; ours decides
        render.film_transparent = True
        render.use_border = render.use_multiview = render.use_stamp = False
        render.use_compositing = render.use_sequencer = render.use_motion_blur = False
        render.dither_intensity = 0.0
        render.use_file_extension, render.use_overwrite, render.use_placeholder = False, True, False
        if hasattr(image, "media_type"):
            image.media_type = "IMAGE"
        image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "8"
        image.color_management = "FOLLOW_SCENE"
        image.compression = 50
        _standard_view(copy)
        yield copy
    finally:
        scene.camera = camera  # rendering updates every scene's frame, at which a marker may have chosen another
        bpy.data.scenes.remove(copy)


def _standard_view(scene: bpy.types.Scene) -> None:
    view = scene.view_settings
    try:
        scene.display_settings.display_device = "sRGB"
        view.view_transform = "Standard"
        view.look = "None"
    except TypeError as error:  # a colour configuration of the artist's own, without these names
        raise SnergError(
            "The colour configuration has no view transform 'Standard' for sRGB; start Blender without the OCIO variable."
        ) from error
    view.exposure, view.gamma = 0.0, 1.0
    view.use_curve_mapping = False
    for name in ("use_white_balance", "use_hdr_view"):
        if hasattr(view, name):
            setattr(view, name, False)


def colour_settings(scene: bpy.types.Scene) -> dict[str, Any]:
    """What decides a render's colours, for the dataset to remember."""
    view = scene.view_settings
    return {
        "engine": scene.render.engine,
        "blender": bpy.app.version_string,
        "display_device": scene.display_settings.display_device,
        "view_transform": view.view_transform,
        "look": view.look,
        "exposure": view.exposure,
        "gamma": view.gamma,
        "dither": scene.render.dither_intensity,
        "film_transparent": scene.render.film_transparent,
    }
