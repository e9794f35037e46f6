"""The web page of a baked scene: a folder for any static server, or one file that opens from the disk.

The page's script, viewer.js, is built once from viewer/src and from the part of three.js that it uses, by `npm run build`. Writing
a page needs no npm, no network and no server-side code.
"""

from __future__ import annotations

import base64
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import SnergError
from ..geometry.camera import Camera
from ..io.files import MARK, json_bytes, new_folder, read_json
from ..io.generation import one_generation
from ..progress import Progress, silent
from ..scene.scene import Scene
from .codecs import PNG, CodecSettings
from .scene_files import copy_scene_files, is_current, write_scene_files

VIEWER = Path(__file__).parents[2] / "viewer"
SCRIPT_TAG = re.compile(r'<script src="viewer.js".*?</script>', re.DOTALL)
FILES_MARK = "<!-- files -->"  # where a single-file page holds the scene's files


def write_bundle(
    scene: Scene,
    cameras: Sequence[Camera],
    folder: Path,
    single_file: bool = False,
    progress: Progress = silent,
    codec: CodecSettings = PNG,
    source: Path | None = None,
) -> dict[str, Any]:
    """Write index.html, viewer.js, cameras.json and scene/ (see scene_files.write_scene_files), whole or not at all.

    cameras: the cameras that the page lists; it opens at the first. single_file: write index.html alone, with the rest inside.
    source: the folder that `scene` was read from; its files are copied unchanged, so that a lossy codec is not applied twice.
    Not all browsers decode JPEG XL: with it, the scene's images are written a second time, as WebP, and the page asks its browser.
    Returns {"files": their number, "bytes": their total size}. Raises SnergError when `folder` cannot be written, the viewer is not
    built, or browsers cannot show the scene or decode the codec.
    """
    check_showable(scene, codec, single_file)
    page, script = viewer_files()
    alternatives = (replace(codec, name="webp"),) if codec.name == "jxl" else ()

    def write_data(data: Path) -> None:
        """Write cameras.json and scene/, which the page reads."""
        (data / "cameras.json").write_bytes(json_bytes(cameras_json(cameras)))
        if source is None or alternatives:
            (data / "scene").mkdir()
            write_scene_files(scene, data / "scene", progress, codec, alternatives)
        else:
            one_generation(source, lambda: _copy_scene(source, data / "scene", codec))

    with new_folder(folder) as temporary:
        if single_file:
            write_single_file(page, script, temporary, write_data)
        else:
            (temporary / "index.html").write_text(page, encoding="utf-8", newline="\n")
            (temporary / "viewer.js").write_text(script, encoding="utf-8", newline="\n")
            write_data(temporary)
        files = [path for path in temporary.rglob("*") if path.is_file() and path.name != MARK]
        return {"files": len(files), "bytes": sum(path.stat().st_size for path in files)}


def _copy_scene(source: Path, target: Path, codec: CodecSettings) -> None:
    """Copy the files of a scene into a new folder. Raises SnergError when its version or codec has changed since it was read."""
    shutil.rmtree(target, ignore_errors=True)  # left by an earlier attempt of `one_generation`
    target.mkdir()
    copy_scene_files(source, target)
    if not is_current(target) or read_json(target / "scene.json").get("codec") != codec.to_json():
        raise SnergError(f"{source} was replaced by a scene of another kind meanwhile; start the export again.")


def viewer_files() -> tuple[str, str]:
    """The text of index.html and of viewer.js. Raises SnergError when viewer.js is not built."""
    script = VIEWER / "dist" / "viewer.js"
    try:
        return (VIEWER / "index.html").read_text(encoding="utf-8"), script.read_text(encoding="utf-8")
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
    """The value of cameras.json: pixels from the top left corner, OpenGL camera-to-world, world units. The page ignores distortion."""
    return {
        "format": "snerg-cameras",
        "version": 1,
        "cameras": [camera.to_json() for camera in cameras],
    }


def write_single_file(page: str, script: str, folder: Path, write_data: Callable[[Path], None]) -> None:
    """Write index.html with the script and, as base64, every file that `write_data` writes into the folder it is given.

    The files are encoded one at a time, so that they are not all in memory. page, script: the text of index.html and viewer.js.
    """
    before, between, after = split_page(page)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".") as name:
        data = Path(name)
        write_data(data)
        with open(folder / "index.html", "w", encoding="utf-8", newline="\n") as file:
            file.write(before)
            for tag in file_tags(data):
                file.write(tag)
            # "</script" would end the script; in JavaScript it occurs in strings and comments only, where a backslash is ignored.
            file.write(between + "<script>" + script.replace("</script", "<\\/script") + "</script>" + after)


def split_page(page: str) -> tuple[str, str, str]:
    """index.html in three parts: up to where the files go, from there to the script's tag, and from behind that tag."""
    before, between_and_after = page.split(FILES_MARK)
    between, after = SCRIPT_TAG.split(between_and_after)
    return before, between, after


def file_tags(folder: Path) -> Iterator[str]:
    """A script tag for each file below a folder, with its content as base64; the viewer finds it by its relative path."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            text = base64.b64encode(path.read_bytes()).decode("ascii")
            yield f'<script type="text/plain" data-file="{path.relative_to(folder).as_posix()}">{text}</script>\n'
