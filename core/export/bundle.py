"""The web bundle: a baked scene and the page that shows it, for any static server or as one file that opens from the disk.

The page's script (viewer/src and the part of three.js that it uses) is put together once, by `npm run build`; what is written
here needs no npm, no network and no server-side code.
"""

from __future__ import annotations

import base64
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..errors import SnergError
from ..geometry.camera import Camera
from ..io.files import MARK, json_bytes, new_folder, read_json
from ..io.generation import one_generation
from ..progress import Progress, silent
from ..scene.scene import Scene
from .codecs import CodecSettings
from .scene_files import PNG, copy_scene_files, is_current, write_scene_files

VIEWER = Path(__file__).parents[2] / "viewer"
SCRIPT_TAG = re.compile(r'<script src="viewer.js".*?</script>', re.DOTALL)
FILES_MARK = "<!-- files -->"


def write_bundle(
    snerg: Scene,
    cameras: Sequence[Camera],
    folder: Path,
    single_file: bool = False,
    progress: Progress = silent,
    codec: CodecSettings = PNG,
    source: Path | None = None,
) -> dict[str, Any]:
    """Write index.html, viewer.js, cameras.json and scene/ (see scene.write_scene_files), whole or not at all.

    cameras: what the page lists to jump to; it opens at the first. single_file: index.html alone, with the rest inside it.
    source: a folder that `snerg` was read from, whose files are taken as they are: a lossy codec loses nothing more.
    Returns {"files": how many, "bytes": in all}. Raises SnergError when `folder` cannot be written, the viewer is not built, or
    browsers cannot show the scene or decode the codec.
    """
    check_shown(snerg, codec)
    page, script = viewer_files()

    def fill(data: Path) -> None:
        """cameras.json and scene/, what the page reads."""
        (data / "cameras.json").write_bytes(json_bytes(cameras_json(cameras)))
        if source is None:
            (data / "scene").mkdir()
            write_scene_files(snerg, data / "scene", progress, codec)
        else:
            one_generation(source, lambda: _copied(source, data / "scene", codec))

    with new_folder(folder) as temporary:
        if single_file:
            write_single_file(page, script, temporary, fill)
        else:
            (temporary / "index.html").write_text(page, encoding="utf-8", newline="\n")
            (temporary / "viewer.js").write_text(script, encoding="utf-8", newline="\n")
            fill(temporary)
        files = [path for path in temporary.rglob("*") if path.is_file() and path.name != MARK]
        return {"files": len(files), "bytes": sum(path.stat().st_size for path in files)}


def _copied(source: Path, to: Path, codec: CodecSettings) -> None:
    """The files of a scene into a new folder. Raises SnergError when it is no longer of the kind that was looked at."""
    shutil.rmtree(to, ignore_errors=True)  # of an attempt before
    to.mkdir()
    copy_scene_files(source, to)
    if not is_current(to) or read_json(to / "scene.json").get("codec") != codec.to_json():
        raise SnergError(f"{source} was replaced by a scene of another kind meanwhile; start it again.")


def viewer_files() -> tuple[str, str]:
    """The page and its script. Raises SnergError when the script has not been built."""
    script = VIEWER / "dist" / "viewer.js"
    try:
        return (VIEWER / "index.html").read_text(encoding="utf-8"), script.read_text(encoding="utf-8")
    except OSError as error:
        raise SnergError(
            f"The web viewer is not built ({error.filename} cannot be read); run `make setup`, or install the extension from its zip."
        ) from error


def check_shown(snerg: Scene, codec: CodecSettings) -> None:
    """Raise SnergError, saying why, when a browser could not show the scene or decode the codec."""
    if not snerg.quantised:
        raise SnergError("The scene is not quantised, and a web page holds 8 bits a value: bake it quantised.")
    if codec.name == "h264":
        raise SnergError("Browsers decode no H.264 at full chroma, which features need; choose the codec avif for a page as small.")
    codec.check()


def cameras_json(cameras: Sequence[Camera]) -> dict[str, Any]:
    """Every camera in full: pixels from the top left corner, OpenGL camera-to-world, world units; the page leaves distortion out."""
    return {
        "format": "snerg-cameras",
        "version": 1,
        "cameras": [camera.to_json() for camera in cameras],
    }


def write_single_file(page: str, script: str, folder: Path, fill: Callable[[Path], None]) -> None:
    """index.html with the script and, as base64, every file that `fill` writes, piece by piece."""
    before, between, after = split_page(page)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".") as name:
        data = Path(name)
        fill(data)
        with open(folder / "index.html", "w", encoding="utf-8", newline="\n") as file:
            file.write(before)
            for tag in embedded(data):
                file.write(tag)
            # In JavaScript "</script" only occurs in strings and comments; here it would end the script.
            file.write(between + "<script>" + script.replace("</script", "<\\/script") + "</script>" + after)


def split_page(page: str) -> tuple[str, str, str]:
    """The page up to where files go, up to the script, and after it."""
    before, between_and_after = page.split(FILES_MARK)
    between, after = SCRIPT_TAG.split(between_and_after)
    return before, between, after


def embedded(folder: Path) -> Iterator[str]:
    """A tag for each file, which the viewer finds by its name."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            text = base64.b64encode(path.read_bytes()).decode("ascii")
            yield f'<script type="text/plain" data-file="{path.relative_to(folder).as_posix()}">{text}</script>\n'
