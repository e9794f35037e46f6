"""`snerg render`: renders a scene from cameras into images."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ..artifact import Result
from ..data.camera_world import CaptureWorld
from ..data.readers.camera_files import read_cameras
from ..data.readers.path_files import read_path
from ..errors import SnergError
from ..geometry.camera import Camera
from ..io.files import new_folder
from ..io.images import png_bytes, to_uint8
from ..io.lock import writes_out
from ..progress import Progress, silent, within
from ..rendering.render import MarchSettings, render_scene
from ..study.evaluate import ready_scene
from .check_out import check_out
from .command import Command
from .options import add_march_options, artifact, count, march_settings, path

DEFAULT_MARCH = MarchSettings()


@writes_out("a rendering")
def render_views(
    scene: Path,
    cameras: Path | None,
    out: Path,
    width: int | None = None,
    height: int | None = None,
    progress: Progress = silent,
    settings: MarchSettings = DEFAULT_MARCH,
    dataset: Path | None = None,
    path: Path | None = None,
) -> Result:
    """Render a scene from each camera of a transforms file into PNG files with straight alpha.

    width, height: pixels, in place of the cameras' own; with one of them alone the aspect ratio is kept. dataset: the capture in whose own
    world the cameras are (see CaptureWorld); None: they are in the scene's world.
    path: a camera path in place of the cameras, of which every frame is rendered, as frame_0001.png and so on.
    Raises SnergError on bad input, Cancelled when `progress` does; then `out` is as it was.
    """
    source = path or cameras
    if source is None or (path and cameras):
        raise SnergError("Give the cameras of a file, or a camera path: one of both.")
    check_out(out, "pictures", scene, source)
    size, world = (width, height), CaptureWorld(dataset)
    read = path_views(source, size, world) if path else world.moved_cameras(read_cameras(source, size), source)
    views = [resized(camera, width, height) for camera in read]
    snerg = ready_scene(scene, settings)
    names = [camera.name for camera in views] if path else file_names([camera.name for camera in views])
    began = time.perf_counter()
    with new_folder(out) as folder:
        for index, (camera, name) in enumerate(zip(views, names, strict=True)):
            part = within(progress, index / len(views), (index + 1) / len(views))
            frame = render_scene(snerg, camera, settings, part)
            (folder / f"{name}.png").write_bytes(png_bytes(to_uint8(frame.straight())))
            part(1.0, f"View {index + 1} of {len(views)}")
    seconds = time.perf_counter() - began
    return {
        "out": str(out),
        "views": len(views),
        "files": [f"{name}.png" for name in names],
        "seconds_per_view": round(seconds / len(views), 4),
    }


def path_views(file: Path, size: tuple[int | None, int | None], world: CaptureWorld) -> tuple[Camera, ...]:
    """The camera of each frame of a path, named after the frame. Raises as `read_path` and `CaptureWorld` do."""
    path = world.moved_path(read_path(file, size), file)
    return tuple(replace(path.camera_at(frame), name=f"frame_{frame:04d}") for frame in path.frames)


def resized(camera: Camera, width: int | None, height: int | None) -> Camera:
    """The camera with another size in pixels; with one side alone the aspect ratio is kept."""
    if width is None and height is None:
        return camera
    if height is None:
        height = max(1, round(camera.height * (width or 1) / camera.width))
    if width is None:
        width = max(1, round(camera.width * height / camera.height))
    return camera.resized(width, height)


def file_names(names: Sequence[str]) -> list[str]:
    """A file name for each camera without special characters, numbered where two would be the same."""
    plain = [re.sub(r"[^\w.-]+", "_", name).strip("._") for name in names]
    if all(plain) and len({name.lower() for name in plain}) == len(plain):
        return plain
    return [f"{index:03d}_{name}".rstrip("_") for index, name in enumerate(plain)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg render`."""
    parser.add_argument("scene", type=artifact, metavar="SCENE")
    shown = parser.add_mutually_exclusive_group(required=True)
    shown.add_argument("--cameras", type=path, metavar="TRANSFORMS.json")
    shown.add_argument("--path", type=path, metavar="FILE", help="a camera path, of which every frame is rendered")
    parser.add_argument("--out", type=path, required=True, metavar="DIR")
    parser.add_argument("--dataset", type=artifact, metavar="CAPTURE", help="the capture in whose own world the cameras are")
    parser.add_argument("--width", type=count, metavar="W", help="pixels, in place of the cameras' own")
    parser.add_argument("--height", type=count, metavar="H")
    add_march_options(parser)


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg render`."""
    settings = march_settings(options)
    return render_views(
        options.scene, options.cameras, options.out, options.width, options.height, progress, settings, options.dataset, options.path
    )  # fmt: skip


COMMAND = Command("render", "render a scene from cameras", add_options, run)
