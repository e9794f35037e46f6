"""Draw the pictures of the documentation anew: the panels in a full Blender, the web page in a browser, and the demo's contact sheet.

`make pictures BLENDER=/path/to/blender`, after `make demo`, whose dataset is trained on for a few minutes. Writes docs/pictures,
and the demo's figures into the README.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import shutil
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "window"), str(ROOT / "tests" / "web")]

from snerg.tests.web.conftest import ARGUMENTS  # noqa: E402
from snerg.tests.window.conftest import Blender, with_extension  # noqa: E402

DEMO = ROOT / "build" / "demo"
WORK = ROOT / "build" / "pictures"
OUT = ROOT / "docs" / "pictures"
PANELS = ("box", "dataset", "field", "bake", "preview", "study", "export", "results")
MOST_BYTES = 150_000  # of a picture, so that the README opens quickly
PAGE_SIZE = (800, 900)  # pixels of the browser's window: as high as Blender's
PAGE_SECONDS = 40  # until a software renderer has drawn the first frame
TEST_VIEWS = 8  # of the demo
CAMERA = "Camera 42"  # which is the still life's active one
LIVE_WIDTH = 800  # pixels of the pictures of the viewport
BESIDE_WIDTH = 1400  # pixels of Blender and the page together
SHEET_ROWS = (3, 8)  # of the contact sheet: how many are shown, and how many it has
EDGE, TABS, MARGIN = 14, 60, 10  # pixels of the sidebar: left of its buttons, right of them, and below the last panel


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", required=True, help="a full Blender, whose Python has JAX, Pillow and msgpack")
    parser.add_argument("--minutes", type=float, default=4.0, help="of training (default: %(default)s)")
    parser.add_argument("--keep", action="store_true", help="use the project of an earlier run: only take the pictures anew")
    parser.add_argument(
        "--only", choices=("object", "panels"), help="only the pictures of the baked scene as an object, or those of the panel's steps"
    )
    options = parser.parse_args(arguments)
    if not (DEMO / "dataset").is_dir():
        sys.exit("There is no dataset in build/demo; run `make demo` first.")
    if shutil.which(options.blender) is None:
        sys.exit(f"There is no Blender at {options.blender!r}; make pictures BLENDER=/path/to/blender")
    OUT.mkdir(parents=True, exist_ok=True)
    blender = with_extension(options.blender)
    file = WORK / "still life.blend"
    if options.only == "object":
        object_pictures(blender)
        return
    if not options.keep:
        make_project(blender, file, options.minutes)
    photograph(blender, "panels", file)
    for name in PANELS:
        write(cropped(name), OUT / f"panel-{name}.png")
    if options.only == "panels":
        return
    box_picture(blender, file)
    web = next(WORK.glob("*.snerg/*/web"))
    write(beside(Image.open(WORK / "panels" / "blender.png"), page(web)), OUT / "blender-and-web.webp")
    write(contact_sheet(), OUT / "contact.webp")
    object_pictures(blender)
    readme = ROOT / "README.md"
    readme.write_text(with_results(readme.read_text(), json.loads((DEMO / "report.json").read_text())))


def make_project(blender: Blender, file: Path, minutes: float) -> None:
    """The file with a finished project, made in Blender without a window. Raises RuntimeError with its output when that fails."""
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    script = ("--python", str(ROOT / "tools" / "picture_scene.py"), "--", str(file), str(DEMO / "dataset"), str(minutes))
    result = blender.run("-b", "--python-exit-code", "1", *script, seconds=1800)
    if result.returncode:
        raise RuntimeError(f"Blender did not make the project: {(result.stdout + result.stderr)[-3000:]}")


def box_picture(blender: Blender, file: Path) -> None:
    """The box with its handles in the viewport of Blender's window."""
    photograph(blender, "box", file)
    picture = Image.open(WORK / "box" / "box.png").convert("RGB").crop(json.loads((WORK / "box" / "box.json").read_text())["crop"])
    size = (LIVE_WIDTH, picture.height * LIVE_WIDTH // picture.width)
    write(picture.resize(size, Image.Resampling.LANCZOS), OUT / "box.webp")


def object_pictures(blender: Blender) -> None:
    """The baked scene of the demo as an object: in the viewport and the camera view of Blender's window, and as Blender renders it."""
    photograph(blender, "live", DEMO / "scene")
    crops = json.loads((WORK / "live" / "live.json").read_text())["crop"]
    for name, rectangle in crops.items():
        picture = Image.open(WORK / "live" / f"{name}.png").convert("RGB").crop(rectangle)
        size = (LIVE_WIDTH, picture.height * LIVE_WIDTH // picture.width)
        write(picture.resize(size, Image.Resampling.LANCZOS), OUT / f"object-{name}.webp")
    photograph(blender, "growing", DEMO / "dataset")
    write(growing(), OUT / "object-growing.webp")
    rendered, volume = WORK / "rendered", WORK / "volume.vdb"
    shutil.rmtree(rendered, ignore_errors=True)
    rendered.mkdir()
    made = blender.snerg("export-vdb", str(DEMO / "scene"), "--out", str(volume))  # openvdb comes with Blender, not with the module
    if made.returncode:
        raise RuntimeError(f"Blender wrote no volume: {(made.stdout + made.stderr)[-3000:]}")
    script = ROOT / "tools" / "picture_object.py"
    subprocess.run([sys.executable, str(script), str(DEMO / "scene"), str(volume), str(rendered)], check=True)
    for name in ("f12", "composite", "volume"):
        write(Image.open(rendered / f"{name}.png").convert("RGB"), OUT / f"object-{name}.webp")


def growing() -> Image.Image:
    """The previews of a training side by side."""
    folder = WORK / "growing"
    crop = json.loads((folder / "growing.json").read_text())["crop"]
    pictures = [Image.open(path).convert("RGB").crop(crop) for path in sorted(folder.glob("growing-*.png"))]
    side = LIVE_WIDTH // len(pictures)
    strip = Image.new("RGB", (side * len(pictures), side))
    for index, picture in enumerate(pictures):
        strip.paste(picture.resize((side, side), Image.Resampling.LANCZOS), (index * side, 0))
    return strip


def photograph(blender: Blender, walk: str, file: Path) -> None:
    """Take the pictures of Blender's window of a walk into build/pictures/WALK. Raises RuntimeError with the reason when that fails."""
    folder = WORK / walk
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    script = ("--python", str(ROOT / "tools" / "picture_walk.py"), "--", walk, str(folder), str(file))
    result = blender.run("--enable-event-simulate", *script, screen=True, seconds=600)
    report = folder / f"{walk}.json"
    error = json.loads(report.read_text())["error"] if report.is_file() else (result.stdout + result.stderr)[-3000:]
    if error:
        raise RuntimeError(f"The pictures of Blender were not taken: {error}")


def cropped(name: str) -> Image.Image:
    """The picture of a step, cut to its panels."""
    left, top, right, bottom = json.loads((WORK / "panels" / "panels.json").read_text())["crop"][name]
    picture = Image.open(WORK / "panels" / f"{name}.png").convert("RGB").crop((left, top, right, bottom))
    rows = np.asarray(picture)[:, EDGE:-TABS]
    uniform = (rows == rows[:, :1]).all(axis=(1, 2))
    filled = np.flatnonzero((rows != rows[-1:, :1]).any(axis=(1, 2)))
    if uniform[-1]:
        end = int(filled[-1]) + MARGIN
    else:  # the panel goes on below the window: end between two of its boxes
        end = int(np.flatnonzero(uniform)[-1])
    return picture.crop((0, 0, picture.width, min(end, picture.height)))


def page(web: Path) -> Image.Image:
    """The web page in a browser."""
    from playwright.sync_api import sync_playwright

    script = "import('@sparticuz/chromium').then(async (m) => console.log(await m.default.executablePath()))"
    found = subprocess.run(["node", "-e", script], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    handler = functools.partial(Quiet, directory=str(web))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        shown = browser.new_page(viewport={"width": PAGE_SIZE[0], "height": PAGE_SIZE[1]})
        shown.set_default_timeout(120_000)
        shown.goto(f"http://127.0.0.1:{server.server_port}/#camera={CAMERA}")
        shown.wait_for_timeout(PAGE_SECONDS * 1000)
        shown.locator("#readout").evaluate("shown => { shown.style.visibility = 'hidden'; }")  # a software renderer's time says nothing
        shown.screenshot(path=str(WORK / "page.png"))
        browser.close()
    server.shutdown()
    return Image.open(WORK / "page.png").convert("RGB")


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Serves files and prints nothing."""

    def log_message(self, *_: object) -> None:
        pass


def beside(left: Image.Image, right: Image.Image) -> Image.Image:
    """Two pictures side by side, of the same height, BESIDE_WIDTH wide."""
    height = min(left.height, right.height)
    pair = [
        picture.convert("RGB").resize((picture.width * height // picture.height, height), Image.Resampling.LANCZOS)
        for picture in (left, right)
    ]
    both = Image.new("RGB", (sum(picture.width for picture in pair), height))
    both.paste(pair[0], (0, 0))
    both.paste(pair[1], (pair[0].width, 0))
    return both.resize((BESIDE_WIDTH, height * BESIDE_WIDTH // both.width), Image.Resampling.LANCZOS)


def contact_sheet() -> Image.Image:
    """The first rows of the demo's contact sheet."""
    sheet = Image.open(DEMO / "contact.png").convert("RGB")
    return sheet.crop((0, 0, sheet.width, sheet.height * SHEET_ROWS[0] // SHEET_ROWS[1]))


def with_results(page: str, report: dict[str, dict[str, float]]) -> str:
    """A page whose table between the marks `<!-- demo -->` has the figures of the demo's report. Raises ValueError without the marks."""
    head, _, rest = page.partition("<!-- demo -->\n")
    _, mark, tail = rest.partition("<!-- /demo -->")
    if not mark:
        raise ValueError("The page has no place for the demo's results.")
    seconds, size = report["seconds"], report["bytes"]
    quality = {name: f"{report['psnr'][name]:.1f} dB | {report['ssim'][name]:.3f}" for name in report["psnr"]}
    rows = (
        ("render the dataset with Cycles", f"{seconds['render']:.0f}", " | ", ""),
        ("train", f"{seconds['train']:.0f}", quality["field"], ""),
        ("bake", f"{seconds['bake']:.0f}", quality["bake"], ""),
        ("fine-tune the highlights", f"{seconds['refine']:.0f}", quality["refined"], f"{size['scene'] / 1e6:.1f}"),
        (f"preview, {TEST_VIEWS} views", f"{seconds['preview']:.1f}", " | ", ""),
        ("export the web page", f"{seconds['export']:.0f}", " | ", f"{size['web'] / 1e6:.1f}"),
    )
    lines = [
        "| stage | seconds | PSNR, mean of views | SSIM | megabytes |",
        "|---|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]
    return f"{head}<!-- demo -->\n" + "\n".join(lines) + f"\n{mark}{tail}"


def write(picture: Image.Image, path: Path) -> None:
    """Write a picture of at most MOST_BYTES: PNG with a palette, or WebP of the highest quality that fits."""
    if path.suffix == ".png":
        picture.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    else:
        for quality in range(92, 30, -4):
            picture.save(path, quality=quality, method=6)
            if path.stat().st_size <= MOST_BYTES:
                break
    if path.stat().st_size > MOST_BYTES:
        raise RuntimeError(f"{path.name} has {path.stat().st_size} bytes; at most {MOST_BYTES} are allowed.")
    print(f"{path} ({path.stat().st_size // 1000} kB)")


if __name__ == "__main__":
    main()
