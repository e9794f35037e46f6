"""The web page of a baked scene: a folder for any static server, or one file that opens from the disk.

The page's script, viewer.js, is built once from viewer/src and from the part of three.js that it uses, by `npm run build`; code that
only some pages need is built beside it (optional_code.py). Writing a page needs no npm, no network and no server-side code. The page
allows itself no script, style or request but its own.
"""

from __future__ import annotations

import base64
import hashlib
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import SnergError
from ..geometry.camera import Camera
from ..geometry.camera_path import CameraPath, path_bytes
from ..io.files import MARK, new_folder
from ..io.generation import one_generation
from ..io.json_files import json_bytes, read_json
from ..progress import Progress, silent, within
from ..scene.coarse import coarse_scene
from ..scene.scene import Scene
from .annotations import annotations_json
from .backdrop import BACKDROP, backdrop_bytes
from .cell_order import cell_order
from .codecs import PNG, CodecSettings
from .optional_code import FOLDER as OPTIONAL
from .optional_code import optional_names, page_parts
from .page import POSTER, data_address, page_html, poster_bytes
from .page_settings import PLAIN, PageSettings
from .scene_files import copy_scene_files, is_current, write_scene_files
from .thumbnails import thumbnail_name, thumbnails

VIEWER = Path(__file__).parents[2] / "viewer"
SCRIPT_TAG = '<script src="viewer.js"></script>'
STYLE_TAG = '<link rel="stylesheet" href="page.css">'
COARSE_FROM = 64  # cells from which on a page has the scene at a quarter of its resolution too, which it shows first
POSTER_END, THUMBNAILS_END, ORDER_END = 0.15, 0.3, 0.35  # of the time of an export
FILES_MARK = "<!-- files -->"  # where a single-file page holds the scene's files


def write_bundle(
    scene: Scene,
    cameras: Sequence[Camera],
    folder: Path,
    single_file: bool = False,
    progress: Progress = silent,
    codec: CodecSettings = PNG,
    source: Path | None = None,
    page: PageSettings = PLAIN,
    path: CameraPath | None = None,
) -> dict[str, Any]:
    """Write index.html, page.css, viewer.js, cameras.json, a poster and scene/ (see scene_files.write_scene_files), whole or not at all.

    cameras: the cameras that the page lists, but for wide ones; it opens at the first. single_file: write index.html alone, with the
    rest inside. source: the folder that `scene` was read from; its files are copied unchanged, so that a lossy codec is not applied twice;
    exact ones are written anew where that brings the cells that the first camera sees to the front (see cell_order.py).
    The poster is the first camera's picture, which the page shows until the scene has arrived. A page of a scene that is not small also
    holds coarse/, which it shows as soon as somebody moves, and where a device does not hold the whole. path: a camera path that the page
    can play; path.json and the code that plays it are there only with one.
    Not all browsers decode JPEG XL: with it, the scene's images are written a second time, as WebP, and the page asks its browser.
    Returns {"files": their number, "bytes": their total size}. Raises SnergError when `folder` cannot be written, the viewer is not
    built, or browsers cannot show the scene or decode the codec.
    """
    check_showable(scene, codec, single_file)
    files = viewer_files(optional_names(single_file, page, path is not None))
    backdrop = backdrop_bytes(page.background_image) if page.background_image else None
    cameras = [camera for camera in cameras if not camera.is_wide]
    first = cameras[0] if cameras else path.camera_at(path.start) if path else None
    poster = poster_bytes(scene, first, page, within(progress, 0.0, POSTER_END)) if first else None
    small = thumbnails(scene, cameras, page, within(progress, POSTER_END, THUMBNAILS_END)) if page.thumbnails else []
    coarse = len(scene.cells) >= COARSE_FROM
    listed = cameras_json(cameras, len(small)) | _flags(coarse=coarse, path=path is not None)
    if coarse and first:
        scene, source, listed["layers"] = _in_order(scene, first, codec, source, within(progress, THUMBNAILS_END, ORDER_END))
    writing = within(progress, ORDER_END, 1.0)

    def write_data(data: Path) -> None:
        """Write cameras.json, coarse/ and scene/, which the page reads."""
        for index, picture in enumerate(small):
            (data / thumbnail_name(index)).parent.mkdir(exist_ok=True)
            (data / thumbnail_name(index)).write_bytes(picture)
        if path is not None:
            (data / "path.json").write_bytes(path_bytes(path))
        (data / "cameras.json").write_bytes(json_bytes(listed | parts_json(page)))
        if page.annotations:
            (data / "annotations.json").write_bytes(json_bytes(annotations_json(page.annotations)))
        if coarse:
            (data / "coarse").mkdir()
            write_scene_files(coarse_scene(scene), data / "coarse", silent, CodecSettings("webp") if codec.name in ("webp", "jxl") else PNG)
        _write_scene(scene, data / "scene", codec, source, writing)

    with new_folder(folder) as temporary:
        if single_file:
            inside = [data_address(picture) if picture else None for picture in (poster, backdrop)]
            files["index.html"] = page_html(files["index.html"], page, *inside)
            write_single_file(files, temporary, write_data)
        else:
            pictures = {POSTER: poster, BACKDROP: backdrop}
            files["index.html"] = page_html(files["index.html"], page, *(name if picture else None for name, picture in pictures.items()))
            for name, picture in pictures.items():
                if picture:
                    (temporary / name).write_bytes(picture)
            for name, text in files.items():
                (temporary / name).parent.mkdir(exist_ok=True)
                (temporary / name).write_text(text, encoding="utf-8", newline="\n")
            write_data(temporary)
        written = [path for path in temporary.rglob("*") if path.is_file() and path.name != MARK]
        return {"files": len(written), "bytes": sum(path.stat().st_size for path in written)}


def _flags(**there: bool) -> dict[str, Any]:
    """What else the page's folder holds, as in cameras.json."""
    return {name: True for name, is_there in there.items() if is_there}


def _in_order(
    scene: Scene, camera: Camera, codec: CodecSettings, source: Path | None, progress: Progress
) -> tuple[Scene, Path | None, dict[str, Any]]:
    """The scene with the cells that a camera sees first, the source to copy, and "layers" of cameras.json. A source with loss is kept."""
    order = cell_order(scene, camera, progress)
    if source is not None and (not codec.lossless or codec.half_features):
        return scene, source, order.layers(in_order=False)
    return order.sorted(scene), None, order.layers(in_order=True)


def _write_scene(scene: Scene, folder: Path, codec: CodecSettings, source: Path | None, progress: Progress) -> None:
    """Write the scene's files, or copy those of `source`. Of JPEG XL, which not all browsers decode, WebP lies beside it."""
    if source is not None and codec.name != "jxl":
        one_generation(source, lambda: _copy_scene(source, folder, codec))
        return
    folder.mkdir()
    write_scene_files(scene, folder, progress, codec, (replace(codec, name="webp"),) if codec.name == "jxl" else ())


def _copy_scene(source: Path, target: Path, codec: CodecSettings) -> None:
    """Copy the files of a scene into a new folder. Raises SnergError when its version or codec has changed since it was read."""
    shutil.rmtree(target, ignore_errors=True)  # left by an earlier attempt of `one_generation`
    target.mkdir()
    copy_scene_files(source, target)
    if not is_current(target) or read_json(target / "scene.json").get("codec") != codec.to_json():
        raise SnergError(f"{source} was replaced by a scene of another kind meanwhile; start the export again.")


def viewer_files(optional: Sequence[str] = ()) -> dict[str, str]:
    """The texts of index.html, page.css, viewer.js and optional code, by their paths. Raises SnergError when the viewer is not built."""
    scripts = [f"{OPTIONAL}/{name}.js" for name in optional]
    sources = {"index.html": "index.html", "page.css": "page.css", **{name: f"dist/{name}" for name in ("viewer.js", *scripts)}}
    try:
        return {name: (VIEWER / path).read_text(encoding="utf-8") for name, path in sources.items()}
    except OSError as error:
        raise SnergError(
            f"The web viewer is not built ({error.filename} cannot be read); run `make setup`, or install the extension from its zip."
        ) from error


def check_showable(scene: Scene, codec: CodecSettings, single_file: bool = False) -> None:
    """Raise SnergError when browsers cannot show the scene or decode the codec, or when the codec is not installed."""
    if not scene.quantised:
        raise SnergError("The scene is not quantised, and a web page holds 8 bits a value: bake it quantised.")
    if codec.name == "h264":
        raise SnergError("Browsers decode no H.264 at full chroma, which features need; choose the codec avif for a page as small.")
    if codec.name == "jxl" and single_file:
        raise SnergError(
            "Not all browsers decode JPEG XL, so a page of one file would hold every image twice: choose the codec webp, or no single file."
        )
    codec.check()


def cameras_json(cameras: Sequence[Camera], thumbnails: int = 0) -> dict[str, Any]:
    """The value of cameras.json: pixels from the top left corner, OpenGL camera-to-world, world units. The page ignores distortion.

    Panoramas and fisheyes that are computed in angles are left out: the page cannot draw them. thumbnails: how many cameras have one.
    """
    drawn = [camera.to_json() for camera in cameras if not camera.is_wide]
    for index, value in enumerate(drawn[:thumbnails]):
        value["thumbnail"] = thumbnail_name(index)
    return {
        "format": "snerg-cameras",
        "version": 1,
        "cameras": drawn,
    }


def parts_json(page: PageSettings) -> dict[str, Any]:
    """What cameras.json says about the optional code that the page loads, and about units where that code needs them."""
    parts = page_parts(page)
    units = {"units": page.units.to_json()} if page.measures or page.vr else {}
    return ({"parts": list(parts)} if parts else {}) | units


def write_single_file(files: Mapping[str, str], folder: Path, write_data: Callable[[Path], None]) -> None:
    """Write index.html with everything inside: the script, the style and, as base64, every file that `write_data` writes into its folder.

    The files are encoded one at a time, so that they are not all in memory. files: of `viewer_files`.
    """
    # "</script" would end the script; in JavaScript it occurs in strings and comments only, where a backslash is ignored.
    style = files["page.css"]
    scripts = [text.replace("</script", "<\\/script") for name, text in files.items() if name.endswith(".js")]
    page = files["index.html"].replace(STYLE_TAG, f"<style>{style}</style>")
    for kind, texts in (("script-src", scripts), ("style-src", [style])):  # a browser runs only the scripts with these hashes
        page = page.replace(f"{kind} 'self'", f"{kind} {' '.join(map(_hash, texts))}")
    before, after = page.split(FILES_MARK)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".") as name:
        data = Path(name)
        write_data(data)
        with open(folder / "index.html", "w", encoding="utf-8", newline="\n") as file:
            file.write(before)
            for tag in file_tags(data):
                file.write(tag)
            file.write(after.replace(SCRIPT_TAG, "\n".join(f"<script>{script}</script>" for script in reversed(scripts))))


def _hash(text: str) -> str:
    """A text as the Content-Security-Policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def file_tags(folder: Path) -> Iterator[str]:
    """A script tag for each file below a folder, with its content as base64; the viewer finds it by its relative path."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            text = base64.b64encode(path.read_bytes()).decode("ascii")
            yield f'<script type="text/plain" data-file="{path.relative_to(folder).as_posix()}">{text}</script>\n'
