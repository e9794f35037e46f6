"""The web page of a baked scene: a folder for any static server, or one file that opens from the disk.

The page's script, viewer.js, is built once from viewer/src and from the part of three.js that it uses, by `npm run build`. Writing
a page needs no npm, no network and no server-side code. The page allows itself no script, style or request but its own.
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
from ..io.files import MARK, new_folder
from ..io.generation import one_generation
from ..io.json_files import json_bytes, read_json
from ..progress import Progress, silent, within
from ..scene.coarse import coarse_scene
from ..scene.scene import Scene
from .backdrop import BACKDROP, backdrop_bytes
from .codecs import PNG, CodecSettings
from .page import POSTER, data_address, page_html, poster_bytes
from .page_settings import PLAIN, PageSettings
from .scene_files import copy_scene_files, is_current, write_scene_files

VIEWER = Path(__file__).parents[2] / "viewer"
SCRIPT_TAG = '<script src="viewer.js"></script>'
STYLE_TAG = '<link rel="stylesheet" href="page.css">'
COARSE_FROM = 64  # cells from which on a page has the scene at a quarter of its resolution too, which it shows first
POSTER_SHARE = 0.2  # of the time of an export
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
) -> dict[str, Any]:
    """Write index.html, page.css, viewer.js, cameras.json, a poster and scene/ (see scene_files.write_scene_files), whole or not at all.

    cameras: the cameras that the page lists, but for wide ones; it opens at the first. single_file: write index.html alone, with the
    rest inside. source: the folder that `scene` was read from; its files are copied unchanged, so that a lossy codec is not applied twice.
    The poster is the first camera's picture, which the page shows until the scene has arrived. A folder of a scene that is not small also
    holds coarse/, which the page shows as soon as somebody moves. The page's background picture is written anew, see `backdrop_bytes`.
    Not all browsers decode JPEG XL: with it, the scene's images are written a second time, as WebP, and the page asks its browser.
    Returns {"files": their number, "bytes": their total size}. Raises SnergError when `folder` cannot be written, the viewer is not
    built, or browsers cannot show the scene or decode the codec.
    """
    check_showable(scene, codec, single_file)
    files = viewer_files()
    backdrop = backdrop_bytes(page.background_image) if page.background_image else None
    cameras = [camera for camera in cameras if not camera.is_wide]
    rendering: Progress = lambda fraction, _: progress(POSTER_SHARE * fraction, "Rendering the poster")  # noqa: E731
    poster = poster_bytes(scene, cameras[0], page, rendering) if cameras else None
    writing = within(progress, POSTER_SHARE, 1.0)

    def write_data(data: Path) -> None:
        """Write cameras.json, coarse/ and scene/, which the page reads."""
        coarse = not single_file and len(scene.cells) >= COARSE_FROM
        (data / "cameras.json").write_bytes(json_bytes(cameras_json(cameras) | ({"coarse": True} if coarse else {})))
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
                (temporary / name).write_text(text, encoding="utf-8", newline="\n")
            write_data(temporary)
        written = [path for path in temporary.rglob("*") if path.is_file() and path.name != MARK]
        return {"files": len(written), "bytes": sum(path.stat().st_size for path in written)}


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


def viewer_files() -> dict[str, str]:
    """The texts of index.html, page.css and viewer.js, by their names. Raises SnergError when viewer.js is not built."""
    paths = (VIEWER / "index.html", VIEWER / "page.css", VIEWER / "dist" / "viewer.js")
    try:
        return {path.name: path.read_text(encoding="utf-8") for path in paths}
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


def cameras_json(cameras: Sequence[Camera]) -> dict[str, Any]:
    """The value of cameras.json: pixels from the top left corner, OpenGL camera-to-world, world units. The page ignores distortion.

    Panoramas and fisheyes that are computed in angles are left out: the page cannot draw them.
    """
    return {
        "format": "snerg-cameras",
        "version": 1,
        "cameras": [camera.to_json() for camera in cameras if not camera.is_wide],
    }


def write_single_file(files: Mapping[str, str], folder: Path, write_data: Callable[[Path], None]) -> None:
    """Write index.html with everything inside: the script, the style and, as base64, every file that `write_data` writes into its folder.

    The files are encoded one at a time, so that they are not all in memory. files: of `viewer_files`.
    """
    # "</script" would end the script; in JavaScript it occurs in strings and comments only, where a backslash is ignored.
    style, script = files["page.css"], files["viewer.js"].replace("</script", "<\\/script")
    page = files["index.html"].replace(STYLE_TAG, f"<style>{style}</style>")
    for kind, text in (("script-src", script), ("style-src", style)):  # a browser runs only the script with this hash
        page = page.replace(f"{kind} 'self'", f"{kind} 'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'")
    before, after = page.split(FILES_MARK)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".") as name:
        data = Path(name)
        write_data(data)
        with open(folder / "index.html", "w", encoding="utf-8", newline="\n") as file:
            file.write(before)
            for tag in file_tags(data):
                file.write(tag)
            file.write(after.replace(SCRIPT_TAG, f"<script>{script}</script>"))


def file_tags(folder: Path) -> Iterator[str]:
    """A script tag for each file below a folder, with its content as base64; the viewer finds it by its relative path."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            text = base64.b64encode(path.read_bytes()).decode("ascii")
            yield f'<script type="text/plain" data-file="{path.relative_to(folder).as_posix()}">{text}</script>\n'
