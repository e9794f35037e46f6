"""`snerg bundle`: writes a scene as a web page."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..artifact import Result, kind_of
from ..data.camera_world import CaptureWorld
from ..data.readers.camera_files import read_cameras
from ..data.readers.path_files import read_path
from ..errors import SnergError
from ..export.annotations import read_annotations, with_known_cameras
from ..export.bundle import viewer_files, write_bundle
from ..export.codecs import PNG, CodecSettings
from ..export.page_settings import AUTOMATIC, BACKGROUND_NAMES, MODES, PLAIN, QUALITIES, THUMBNAILS, PageSettings, is_background
from ..export.scene_files import codec_of, is_current
from ..export.thumbnails import SECONDS
from ..export.world_units import SYSTEMS, WorldUnits
from ..io.generation import one_generation
from ..io.lock import writes_out
from ..progress import Note, Progress, silent
from ..scene.scene import Scene
from .check_out import check_out
from .command import Command
from .export import published
from .options import add_codec_options, artifact, codec_settings, natural, path

THUMBNAILS_HELP = f"cameras with a small picture: 1 to 4 KB and about 0.3 s each, {SECONDS:g} s in all at most (default: {THUMBNAILS})"


@writes_out("a bundle")
def bundle_scene(
    scene: Path,
    out: Path,
    cameras: Path | None = None,
    single_file: bool = False,
    progress: Progress = silent,
    codec: CodecSettings | None = None,
    dataset: Path | None = None,
    page: PageSettings = PLAIN,
    path: Path | None = None,
    annotations: Path | None = None,
) -> Result:
    """Write a web page that shows a scene: a folder for a static web server, or one .html when `single_file`.

    cameras: a transforms file whose cameras the page lists. dataset: as in `render_views`. codec: of the scene's pictures; the scene's
    own when None. path: a camera path (see `read_path`) that the page can play; dataset goes for it, too. annotations: a file of labels
    (see `read_annotations`), in the same world as the cameras.
    """
    check_out(out, "page", scene, *(file for file in (cameras, path, annotations, page.background_image) if file))
    viewer_files()
    world = CaptureWorld(dataset)
    move = world.moved_path(read_path(path), path) if path else None
    listed = world.moved_cameras(read_cameras(cameras), cameras) if cameras else ()
    views = tuple(camera for camera in listed if not camera.is_wide)
    if len(views) < len(listed):
        progress(0.0, Note(f"{len(listed) - len(views)} panoramic or fisheye cameras are left out: a web page cannot draw them."))
    if annotations:
        page = annotated(page, annotations, [camera.name for camera in views], world, progress)

    def opened() -> tuple[Scene, CodecSettings | None]:
        stored = codec_of(scene) if kind_of(scene) == "scene" and is_current(scene) else None
        return published(scene), stored

    snerg, stored = one_generation(scene, opened)
    source = scene if stored is not None and codec in (None, stored) else None
    codec = codec or stored or PNG
    written = write_bundle(snerg, views, out, single_file=single_file, progress=progress, codec=codec, source=source, page=page, path=move)
    moves = {"path_keys": move.keys, "path_frames": len(move.frames)} if move else {}
    return {"out": str(out), "page": str(out / "index.html"), "cameras": len(views), "codec": codec.name, **moves, **written}


def annotated(page: PageSettings, file: Path, cameras: list[str], world: CaptureWorld, progress: Progress) -> PageSettings:
    """The page with the annotations of a file, in the world of the scene. Says which of their cameras the page does not list."""
    to_world = world.to_training(file)
    found = tuple(annotation.moved(to_world) for annotation in read_annotations(file))
    kept, missing = with_known_cameras(found, cameras)
    if missing:
        progress(0.0, Note(f"Annotations lead to no camera where the page does not list theirs: {', '.join(missing)}."))
    return replace(page, annotations=kept)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg bundle`."""
    parser.add_argument("scene", type=artifact, metavar="SCENE")
    parser.add_argument("--out", type=path, required=True, metavar="DIR")
    parser.add_argument("--cameras", type=path, metavar="FILE", help="a transforms file whose cameras the page lists")
    parser.add_argument("--path", type=path, metavar="FILE", help="a camera path that the page can play")
    parser.add_argument("--play", action="store_true", help="play the path as soon as the scene is there")
    parser.add_argument("--thumbnails", type=natural, default=THUMBNAILS, metavar="N", help=THUMBNAILS_HELP)
    parser.add_argument("--dataset", type=artifact, metavar="CAPTURE", help="the capture in whose own world the cameras are")
    parser.add_argument("--annotations", type=path, metavar="FILE", help="a JSON file of labels in the scene")
    parser.add_argument("--measure", action="store_true", help="let people measure lengths in the scene")
    parser.add_argument("--vr", action="store_true", help="let people enter the scene with a headset")
    parser.add_argument(
        "--unit-scale", type=float, default=1.0, metavar="METRES", help="length of a unit of the scene, as Blender's unit scale"
    )
    parser.add_argument("--unit-system", choices=SYSTEMS, default="metric", help="how measured lengths are told")
    parser.add_argument("--single-file", action="store_true", help="one self-contained .html that opens from the disk")
    parser.add_argument("--title", default="", metavar="TEXT", help="of the page, also where a link to it is shared")
    parser.add_argument("--description", default="", metavar="TEXT", help="a sentence for search engines and shared links")
    parser.add_argument("--address", default="", metavar="URL", help="where the page will be published; shared links then show its picture")
    parser.add_argument(
        "--background", default="white", metavar="WHAT", help=f"{BACKGROUND_NAMES}, a colour as #204060, or the path of a picture"
    )
    parser.add_argument(
        "--move", choices=MODES, default="orbit", help="how people move at first: fly and walk suit scenes seen from inside"
    )
    parser.add_argument(
        "--preset", choices=QUALITIES, default=AUTOMATIC, help="how fine the page's picture is, and how much graphics memory it takes"
    )
    pair: dict[str, Any] = {"type": float, "nargs": 2, "metavar": ("MIN", "MAX")}
    parser.add_argument("--orbit-distance", **pair, help="how near and far people may orbit, in units of the scene")
    parser.add_argument("--orbit-elevation", **pair, help="how low and high people may orbit, in degrees above the horizon")
    add_codec_options(parser, "the scene's own")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg bundle`."""
    distance, elevation = (tuple(pair) if pair else None for pair in (options.orbit_distance, options.orbit_elevation))
    if options.play and options.path is None:
        raise SnergError("--play plays a camera path; give one with --path, or leave --play out.")
    background, picture = background_of(options.background)
    page = PageSettings(
        options.title,
        options.description,
        options.address,
        background,
        distance,
        elevation,
        picture,
        options.move,
        quality=options.preset,
        play=options.play,
        thumbnails=options.thumbnails,
        measures=options.measure,
        vr=options.vr,
        units=WorldUnits(options.unit_scale, options.unit_system),
    )
    return bundle_scene(
        options.scene,
        options.out,
        options.cameras,
        options.single_file,
        progress,
        codec_settings(options),
        options.dataset,
        page,
        options.path,
        options.annotations,
    )


def background_of(text: str) -> tuple[str, Path | None]:
    """A background by its name or its colour, or else the picture at a path, with what is shown without it.

    Raises SnergError where it is none of them.
    """
    if is_background(text) or text.startswith("#"):
        return text, None
    if not Path(text).is_file():
        raise SnergError(
            f"There is no background {text!r}, and no picture of that name: give {BACKGROUND_NAMES}, a colour as #204060, or a picture."
        )
    return PLAIN.background, Path(text)


COMMAND = Command("bundle", "write a scene as a web page", add_options, run)
