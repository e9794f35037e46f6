"""Rendering a dataset from a Blender scene: views on transparent film, each with the pose that it was rendered from."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.data.readers.camera_files import write_transforms
from ..core.data.readers.transforms_camera import intrinsics_json
from ..core.errors import SnergError
from ..core.geometry.box import Box
from ..core.geometry.camera import Camera
from ..core.io.files import MARK, cannot_write, check_replaceable, discard, new_folder, write_bytes
from ..core.io.images import read_image, read_size
from ..core.io.json_files import json_bytes, read_json
from ..core.progress import Progress, silent
from .bridge import set_camera
from .capture_scene import CaptureSettings, capture_scene, colour_settings, layer_warning
from .render_evaluation import escaped, render, temporary_camera
from .render_passes import check_passes, enable_light, file_extra, frame_extra, pass_files, write_passes
from .shots import Shot, camera_of, evaluated_shots, frame_of
from .simulations import listed
from .view_check import mismatch, why_clear

TEXT_CHUNKS = (b"tEXt", b"zTXt", b"iTXt", b"eXIf", b"tIME")  # PNG chunks that hold texts and times
RENDERING = "rendering.json"  # in an unfinished dataset: its `rendering_key`


def render_dataset(
    scene: bpy.types.Scene,
    shots: Sequence[Shot],
    folder: Path,
    settings: CaptureSettings | None = None,
    box: Box | None = None,
    progress: Progress = silent,
    resume: bool = True,
) -> dict[str, Any]:
    """Render every shot into the dataset `folder`: train/, test/, transforms_train.json, transforms_test.json, and a folder of each pass.

    shots: camera objects, such at frames, or core cameras. box: recorded as the dataset's box. resume: see `render_steps`.
    Returns {"train", "test": number of views, "width", "height": pixels}, and where there are any "kept": views reused from an earlier
    run, "warnings": sentences about what the dataset shows otherwise than the artist may expect.
    Raises SnergError where a shot cannot be rendered or no view shows anything, and Cancelled where `progress` does. Changes no setting
    of the scene.
    """
    steps = render_steps(scene, shots, folder, settings, box, resume)
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
    resume: bool = True,
) -> Generator[tuple[float, str], None, dict[str, Any]]:
    """`render_dataset` as a generator that yields (fraction, text) before each view and returns what `render_dataset` does.

    The views are collected in `unfinished(folder)`, which replaces `folder` when it is complete. A run that is stopped or killed leaves
    the views so far there, as a valid dataset. The next run renders only the missing views if `resume` is set and the `rendering_key` is
    the same; else it starts again.
    """
    settings = settings or CaptureSettings()
    check_passes(settings.passes)
    cameras, warnings = evaluated_shots(scene, shots)
    splits = shot_splits(shots, settings)
    check_replaceable(folder)
    part, key = unfinished(folder), rendering_key(scene, cameras, settings)
    if not resume or read_rendering(part) != key:
        start_unfinished(part, key)
    kept = sum((part / f"{name}.png").is_file() for name in splits)
    for index, (shot, camera) in enumerate(zip(shots, cameras, strict=True)):
        if not (part / f"{splits[index]}.png").is_file():
            yield index / len(shots), f"View {index + 1} of {len(shots)}: {camera.name}"
            files = pass_files(part, splits[index], settings.passes)
            recorded = render_file(scene, frame_of(shot), part / f"{splits[index]}.png", camera, settings, files)
            write_splits(part, cameras, splits, box, recorded, settings.passes)
    if kept == len(shots):  # the run before was stopped between its last view and its end
        with capture_scene(scene, settings) as copy:
            write_splits(part, cameras, splits, box, colour_settings(copy), settings.passes)
    warnings += [layer_warning(scene, settings.view_layer), *checked(scene, shots, cameras, [part / f"{n}.png" for n in splits], settings)]
    complete(part, folder, splits, settings.passes)
    held_out, first = sum(name.startswith("test") for name in splits), cameras[0]
    counts: dict[str, Any] = {"train": len(shots) - held_out, "test": held_out, "width": first.width, "height": first.height}
    said = [sentence for sentence in warnings if sentence]
    return counts | ({"kept": kept} if kept else {}) | ({"warnings": said} if said else {})


def checked(
    scene: bpy.types.Scene, shots: Sequence[Shot], cameras: Sequence[Camera], pictures: Sequence[Path], settings: CaptureSettings
) -> list[str]:
    """Sentences about views that show nothing, and about poses that do not fit the pictures. Raises SnergError where none shows anything.

    The unfinished dataset is then deleted, so that its empty views are not kept for the next rendering.
    """
    alphas = [np.asarray(read_image(path))[..., 3] for path in pictures]
    clear = [camera.name for camera, alpha in zip(cameras, alphas, strict=True) if not alpha.any()]
    if len(clear) == len(cameras):
        discard(pictures[0].parent.parent)
        raise SnergError(f"Every picture is empty: {why_clear(scene, cameras, frame_of(shots[0]), settings)}.")
    said = [f"{len(clear)} of {len(cameras)} pictures show nothing: {listed(clear)}."] if clear else []
    return [*said, mismatch(scene, [frame_of(shot) for shot in shots], cameras, alphas, settings)]


def shot_splits(shots: Sequence[Shot], settings: CaptureSettings) -> list[str]:
    """`split_names` of the shots: by their cameras where the settings name some for testing. Raises SnergError where none is left."""
    if not settings.test_cameras:
        return split_names(len(shots), settings.test_every)
    names = [camera.name_full if (camera := camera_of(shot)) is not None else "" for shot in shots]
    test = [name in settings.test_cameras for name in names]
    if all(test):
        raise SnergError("All cameras are test cameras; choose some that are not in the collection of the test cameras.")
    return numbered(test)


def start_unfinished(part: Path, key: dict[str, Any]) -> None:
    """Make an empty unfinished dataset, in place of an earlier one. key: its `rendering_key`. Raises SnergError."""
    check_replaceable(part)
    discard(part)
    write_bytes(part / MARK, b"Written by SNeRG for Blender; an unfinished dataset that the next rendering completes.\n")
    write_bytes(part / RENDERING, json_bytes(key))


def complete(part: Path, folder: Path, splits: Sequence[str], passes: Sequence[str] = ()) -> None:
    """Make the unfinished dataset `part` the dataset `folder`, in one step. splits: each view's path without suffix."""
    files = [path for split in splits for path in (part / f"{split}.png", *pass_files(part, split, passes).values())]
    with new_folder(folder) as whole:
        for name in (path.relative_to(part) for path in (*files, *part.glob("transforms_*.json"))):
            (whole / name).parent.mkdir(parents=True, exist_ok=True)
            link_or_copy(part / name, whole / name)
    discard(part)


def unfinished(folder: Path) -> Path:
    """The folder beside `folder` in which the dataset is rendered until it is complete."""
    return folder.with_name(f"{folder.name}.unfinished")


def views_rendered(folder: Path) -> tuple[int, int]:
    """(rendered, total) number of views of the unfinished dataset of `folder`; (0, 0) where there is none."""
    part = unfinished(folder)
    count = read_rendering(part).get("views", 0)
    return (len(list(part.glob("*/r_*.png"))), count) if isinstance(count, int) and count else (0, 0)


def rendering_key(scene: bpy.types.Scene, cameras: Sequence[Camera], settings: CaptureSettings) -> dict[str, Any]:
    """{"views": their number, "key": a hash of the cameras, the frame and the render settings}. Objects and materials are not in it."""
    parts = (scene.render, scene.view_settings, scene.display_settings, *(getattr(scene, name, None) for name in ("cycles", "eevee")))
    poses = [[camera.name, *intrinsics_json(camera).items(), camera.camera_to_world.tolist()] for camera in cameras]
    value = [vars(settings), scene.name, scene.frame_current, scene.frame_subframe, poses, [rna_settings(part) for part in parts]]
    key = hashlib.sha256(json.dumps(value, default=str).encode()).hexdigest()
    return {"views": len(cameras), "key": key}


def rna_settings(thing: Any) -> dict[str, Any]:
    """The numbers, enums and booleans of a Blender struct, by name. Strings are left out: they are mostly output paths."""
    if thing is None:
        return {}
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        for prop in thing.bl_rna.properties:
            if prop.type in ("INT", "FLOAT", "BOOLEAN", "ENUM") and not prop.is_readonly:
                value = getattr(thing, prop.identifier)
                found[prop.identifier] = list(value) if getattr(prop, "is_array", False) else value
    return found


def read_rendering(part: Path) -> dict[str, Any]:
    """The `rendering_key` of an unfinished dataset; {} where there is none."""
    try:
        value = read_json(part / RENDERING)
    except SnergError:
        return {}
    return value if isinstance(value, dict) else {}


def render_file(
    scene: bpy.types.Scene,
    frame: int | None,
    path: Path,
    camera: Camera,
    settings: CaptureSettings | None = None,
    passes: Mapping[str, Path] | None = None,
) -> dict[str, Any]:
    """`render_view` into a PNG without text chunks; the file is complete or absent, and where it is there, so are the passes.

    Raises SnergError also where it cannot be written.

    Blender writes to a temporary folder: a path of the artist's may hold braces, which Blender fills in, or other signs that it knows.
    """
    with tempfile.TemporaryDirectory(prefix="snerg-") as room:
        beside = Path(room) / "view.png"
        recorded = render_view(scene, frame, beside, camera, settings, passes)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, strip_text_chunks(beside.read_bytes()))
        except OSError as error:
            raise cannot_write(path, error) from error
    return recorded


def strip_text_chunks(png: bytes) -> bytes:
    """A PNG without the texts that Blender and Cycles add, such as the render time, so that the same view gives the same bytes."""
    kept, at = [png[:8]], 8
    while at + 8 <= len(png):
        size = 12 + int.from_bytes(png[at : at + 4], "big")  # length (4 bytes), type (4), data and checksum (4)
        if png[at + 4 : at + 8] not in TEXT_CHUNKS:
            kept.append(png[at : at + size])
        at += size
    return b"".join(kept)


def write_splits(
    part: Path,
    cameras: Sequence[Camera],
    splits: Sequence[str],
    box: Box | None,
    recorded: dict[str, Any],
    passes: Sequence[str] = (),
) -> None:
    """Write transforms_train.json and transforms_test.json for the views that are rendered. splits: each view's path without suffix."""
    rendered = [index for index, name in enumerate(splits) if (part / f"{name}.png").is_file()]
    for split in ("train", "test"):
        chosen = [index for index in rendered if splits[index].startswith(split)]
        if chosen:
            names = [f"./{splits[index]}" for index in chosen]
            extra = {"snerg_render": recorded, **file_extra(passes)}
            frames = [frame_extra(splits[index], passes) for index in chosen]
            write_transforms(part / f"transforms_{split}.json", [cameras[i] for i in chosen], names, box, extra, frames)


def link_or_copy(source: Path, target: Path) -> None:
    """Make `target` a hard link to `source`, or a copy where the file system has no hard links."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)


def core_cameras(scene: bpy.types.Scene, shots: Sequence[Shot]) -> list[Camera]:
    """The shots as core cameras. Raises SnergError where there are none, or one cannot be used."""
    return evaluated_shots(scene, shots)[0]


def evaluated(scene: bpy.types.Scene) -> bpy.types.Depsgraph:
    """The evaluated dependency graph of any scene, also of one that no window shows."""
    if bpy.context.scene == scene:
        return bpy.context.evaluated_depsgraph_get()
    layer = scene.view_layers[0]
    layer.update()
    return layer.depsgraph


def split_names(count: int, test_every: int) -> list[str]:
    """'train/r_0', 'test/r_0', ... for each of `count` views: every `test_every`-th is a test view."""
    return numbered([test_every > 1 and (index + 1) % test_every == 0 for index in range(count)])


def numbered(test: Sequence[bool]) -> list[str]:
    """'train/r_0', 'test/r_0', ... for each view. test: whether it is a test view."""
    counts = {"train": 0, "test": 0}
    names = []
    for held_out in test:
        split = "test" if held_out else "train"
        names.append(f"{split}/r_{counts[split]}")
        counts[split] += 1
    return names


def render_view(
    scene: bpy.types.Scene,
    frame: int | None,
    path: Path,
    camera: Camera,
    settings: CaptureSettings | None = None,
    passes: Mapping[str, Path] | None = None,
) -> dict[str, Any]:
    """Render one view to a PNG with straight alpha, and its passes, and return its `colour_settings`.

    frame: None for the scene's own. passes: the file of each pass by its name.

    A pinhole camera of its own stands where `camera` does, so that the picture and the pose are one whatever moves the artist's camera
    while Blender renders. Raises SnergError where Blender wrote no image, or one that does not have the camera's size.
    """
    with capture_scene(scene, settings) as copy, temporary_camera() as stand_in:
        copy.render.filepath = escaped(path)
        if frame is not None:
            copy.frame_current, copy.frame_subframe = frame, 0.0
        copy.collection.objects.link(stand_in)
        set_camera(stand_in, camera, copy)
        copy.camera = stand_in
        try:
            enable_light(copy, tuple(passes or ()))
            render(copy, write_still=True)
            write_passes(copy, passes or {}, lambda: render(copy))
        except RuntimeError as error:  # the error report of a Blender operator
            why = str(error).strip()
            raise SnergError(f"Blender could not render {camera.name!r} ({why}); render it once by hand to see why.") from error
        recorded = colour_settings(copy)
    if not path.is_file():
        raise SnergError(f"Blender wrote no picture for {camera.name!r}; check that the scene renders and that the disk has space.")
    if read_size(path) != (camera.width, camera.height):
        raise SnergError(f"Blender rendered {camera.name!r} at another size than the scene's resolution; turn off what crops it.")
    return recorded
