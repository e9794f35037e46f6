"""`snerg bundle`: a scene as a web page."""

from __future__ import annotations

from pathlib import Path

from ..artifact import Result, kind_of
from ..data.readers.transforms import read_cameras
from ..export.bundle import viewer_files, write_bundle
from ..export.codecs import PNG, CodecSettings
from ..export.scene_files import codec_of, is_current
from ..io.generation import one_generation
from ..io.lock import writes_out
from ..progress import Progress, silent
from ..scene.scene import Scene
from .check_out import check_out
from .export import published


@writes_out("a bundle")
def bundle_scene(
    scene: Path,
    out: Path,
    cameras: Path | None = None,
    single_file: bool = False,
    progress: Progress = silent,
    codec: CodecSettings | None = None,
) -> Result:
    """Write a web page that shows a scene: a folder for any static server, or one .html when `single_file`.

    cameras: a transforms file whose cameras the page lists. codec: of the scene's pictures; the scene's own when None.
    """
    check_out(out, "page", scene, *([cameras] if cameras else []))
    viewer_files()
    views = read_cameras(cameras) if cameras else ()

    def opened() -> tuple[Scene, CodecSettings | None]:
        stored = codec_of(scene) if kind_of(scene) == "scene" and is_current(scene) else None
        return published(scene), stored

    snerg, stored = one_generation(scene, opened)
    source = scene if stored is not None and codec in (None, stored) else None
    codec = codec or stored or PNG
    written = write_bundle(snerg, views, out, single_file=single_file, progress=progress, codec=codec, source=source)
    return {"out": str(out), "page": str(out / "index.html"), "cameras": len(views), "codec": codec.name, **written}
