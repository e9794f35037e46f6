"""The frame time of Blender's viewport against the web viewer's: one scene, the same cameras, the same OpenGL, in turns.

`make bench-viewport BLENDER=/path/to/blender BROWSER=/path/to/chromium`, after `make demo`. Prints a line of JSON: medians in
milliseconds of a whole picture and their ratio, and of the viewport's draft while the view moves. The ratio says something only where
both drivers are the same, which the line names.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import io
import json
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from common import OUT, ROOT
from PIL import Image

from snerg.core.export.bundle import write_bundle
from snerg.core.export.scene_files import read_scene
from snerg.core.geometry.camera import Camera

sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "window")]

from snerg.tests.web.conftest import Handler  # noqa: E402
from snerg.tests.window.conftest import OUT as WINDOW  # noqa: E402
from snerg.tests.window.conftest import Blender, with_extension  # noqa: E402

GL = ["--no-sandbox", "--ignore-gpu-blocklist", "--use-gl=angle", "--use-angle=gl-egl", "--enable-unsafe-swiftshader"]
PATIENCE = 120  # seconds for a frame
# Times every draw call that marches, to where a pixel of it can be read.
TIMED = """
window.draws = [];
const plain = WebGL2RenderingContext.prototype.drawArrays;
WebGL2RenderingContext.prototype.drawArrays = function (...values) {
  const pixel = new Uint8Array(4);
  const marches = this.getParameter(this.FRAMEBUFFER_BINDING) !== null;
  const [width, height] = this.getParameter(this.VIEWPORT).slice(2);
  this.readPixels(0, 0, 1, 1, this.RGBA, this.UNSIGNED_BYTE, pixel);
  const began = performance.now();
  plain.apply(this, values);
  this.readPixels(0, 0, 1, 1, this.RGBA, this.UNSIGNED_BYTE, pixel);
  window.draws.push({ marches, width, height, milliseconds: performance.now() - began });
};
"""
AGAIN = """async () => {
  await window.snerg.settled();
  window.draws = [];
  document.querySelector("snerg-viewer").shadowRoot.querySelector("[name=background]:not(:checked)").click();
  await window.snerg.settled();
  return window.draws;
}"""
RENDERER = """() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  return gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL);
}"""


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    options = parsed(arguments)
    scene = options.scene / "scene" if (options.scene / "scene").is_dir() else options.scene
    cameras = [wide(camera, *options.size) for camera in some(options)]
    web = OUT / "viewport" / "web"
    shutil.rmtree(web, ignore_errors=True)
    write_bundle(read_scene(scene), cameras, web, source=scene)
    rows: dict[str, list[dict[str, Any]]] = {camera.name: [] for camera in cameras}
    with viewport(options.blender, scene) as draw, pages(options.browser, web, cameras) as (renderer, shown):
        for turn in range(options.pairs + 1):
            for camera in cameras:
                pair = draw(camera, None if turn else WINDOW / f"{camera.name}.npy") | {"web": shown[camera.name].frame()}
                if turn:
                    rows[camera.name].append(pair)
                else:
                    difference = differs(WINDOW / f"{camera.name}.npy", shown[camera.name].picture(), OUT / "viewport" / camera.name)
                    print(f"{camera.name}: the pictures differ by {difference:.2f} levels of 8 bits in the mean", file=sys.stderr)
        drivers = {"viewport": draw.seen()["renderer"], "web": renderer}
    print(json.dumps(summary(rows, options, drivers)))
    return 0


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """The command-line options."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blender", required=True, help="a full Blender")
    parser.add_argument("--browser", required=True, help="a Chromium whose WebGL runs on the same driver as that Blender")
    parser.add_argument("--scene", type=Path, default=ROOT / "build" / "demo", help="a scene's folder (default: build/demo)")
    parser.add_argument("--cameras", type=int, default=3, help="how many of its held-out cameras (default: %(default)s)")
    parser.add_argument("--pairs", type=int, default=10, help="frames of each, for each camera (default: %(default)s)")
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540), metavar=("WIDTH", "HEIGHT"))
    return parser.parse_args(arguments)


def some(options: argparse.Namespace) -> list[Camera]:
    """Cameras of the scene's page, spread over the demo's."""
    listed = json.loads((options.scene / "web" / "cameras.json").read_text())["cameras"]
    cameras = [Camera.from_json(value) for value in listed]
    return [cameras[i * len(cameras) // options.cameras] for i in range(options.cameras)]


def wide(camera: Camera, width: int, height: int) -> Camera:
    """The camera with another picture, which shows as much from its top to its bottom."""
    scale = height / camera.height
    focal = camera.focal[0] * scale, camera.focal[1] * scale
    return Camera(width, height, focal, (width / 2, height / 2), camera.camera_to_world, name=camera.name, near=camera.near)


class Viewport:
    """A Blender that waits for cameras in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.number = folder, 0

    def __call__(self, camera: Camera | None, picture: Path | None = None) -> dict[str, Any]:
        """The times of a camera's frame; without one, Blender ends."""
        self.number += 1
        ask = {"number": self.number, "camera": camera and camera.to_json(), "picture": picture and str(picture)}
        (self.folder / "ask.part").write_text(json.dumps(ask))
        (self.folder / "ask.part").replace(self.folder / "ask.json")
        if camera is None:
            return {}
        return waited(lambda: self.answer(), f"Blender draws no frame; see {self.folder}")

    def answer(self) -> dict[str, Any] | None:
        """The answer to what was asked last, once it is there."""
        path = self.folder / "answer.json"
        value: dict[str, Any] = json.loads(path.read_text()) if path.is_file() else {}
        return value if value.get("number") == self.number else None

    def seen(self) -> dict[str, Any]:
        """What Blender says of itself, once it is ready."""
        value: dict[str, Any] = json.loads(waited(lambda: (self.folder / "frames.json").read_text(), "Blender does not start"))
        return value


def waited(look: Any, problem: str) -> Any:
    """What `look` returns once that is something. Raises SystemExit with `problem` after PATIENCE."""
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        try:
            if found := look():
                return found
        except FileNotFoundError:
            pass
        time.sleep(0.02)
    raise SystemExit(problem)


@contextmanager
def viewport(program: str, scene: Path) -> Iterator[Viewport]:
    """A full Blender with the extension, and the scene on its graphics card."""
    blender: Blender = with_extension(program)
    folder = blender.folder("frames")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    copy = WINDOW / "measured"  # where a Blender in a container sees it
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(scene, copy)
    script = (
        "--enable-event-simulate",
        "--python",
        str(Path(__file__).with_name("viewport_walk.py")),
        "--",
        "frames",
        str(folder),
        str(copy),
    )
    logged: list[subprocess.CompletedProcess[str]] = []
    thread = threading.Thread(target=lambda: logged.append(blender.run(*script, screen=True, seconds=3600)))
    thread.start()
    asked = Viewport(folder)
    try:
        asked.seen()
        yield asked
    finally:
        asked(None)
        thread.join(60)
        (folder / "log").write_text("".join(result.stdout + result.stderr for result in logged))


class WebPage:
    """A page of the web viewer at a camera."""

    def __init__(self, browser: Any, address: str, camera: Camera) -> None:
        self.width = camera.width
        self.page = browser.new_page(viewport={"width": camera.width + 40, "height": camera.height + 160})
        self.page.set_default_timeout(1000 * PATIENCE)
        self.page.add_init_script(TIMED)
        self.page.goto(f"{address}?camera={quote(camera.name)}&width={camera.width}&height={camera.height}")
        if not self.page.evaluate("window.snerg.ready"):
            raise SystemExit(self.page.evaluate("window.snerg.problem"))

    def frame(self) -> float:
        """Milliseconds of a whole picture: the march of all its bands, and one copy to the page."""
        draws = self.page.evaluate(AGAIN)
        copy = statistics.median(draw["milliseconds"] for draw in draws if not draw["marches"])
        return copy + sum(draw["milliseconds"] for draw in draws if draw["marches"] and draw["width"] == self.width)

    def picture(self) -> np.ndarray:
        """What it shows over white, [H, W, 3] in [0, 1]."""
        self.page.check("[name=background][value=white]", force=True)
        self.page.evaluate("window.snerg.settled()")
        data = self.page.locator("#canvas").screenshot()
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255


@contextmanager
def pages(program: str, web: Path, cameras: list[Camera]) -> Iterator[tuple[str, dict[str, WebPage]]]:
    """The driver's name, and a page for each camera."""
    from playwright.sync_api import sync_playwright

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(web)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=GL)
        address = f"http://127.0.0.1:{server.server_port}/"
        shown = {camera.name: WebPage(browser, address, camera) for camera in cameras}
        yield shown[cameras[0].name].page.evaluate(RENDERER), shown
        browser.close()
    server.shutdown()
    server.server_close()


def differs(viewport: Path, web: np.ndarray, out: Path) -> float:
    """The mean difference of the pictures in levels of 8 bits; keeps them side by side, so that one sees that they show the same."""
    values = np.clip(np.load(viewport), 0, 1)
    ours = values[..., :3] + 1 - values[..., 3:]
    both = np.clip(np.concatenate([ours, web], axis=1), 0, 1)
    Image.fromarray(np.rint(255 * both).astype(np.uint8)).save(f"{out}.png")
    return float(255 * np.abs(ours - web).mean())


def summary(rows: dict[str, list[dict[str, Any]]], options: argparse.Namespace, drivers: dict[str, str]) -> dict[str, Any]:
    """Medians of each camera in milliseconds, their means, and the ratio of these."""
    cameras: dict[str, dict[str, Any]] = {}
    for name, pairs in rows.items():
        whole, draft, web = (statistics.median(pair[kind] for pair in pairs) for kind in ("whole", "draft", "web"))
        draft_size = " x ".join(map(str, pairs[-1]["draft_size"]))
        cameras[name] = {"viewport": round(whole, 1), "web": round(web, 1), "draft": round(draft, 1), "draft_size": draft_size}
    ours, web, draft = (statistics.mean(found[side] for found in cameras.values()) for side in ("viewport", "web", "draft"))
    size = " x ".join(map(str, options.size))
    times = {"viewport": round(ours, 1), "web": round(web, 1), "ratio": round(ours / web, 3), "draft": round(draft, 1)}
    return {"size": size, "pairs": options.pairs, **times, "cameras": cameras, "drivers": drivers}


if __name__ == "__main__":
    sys.exit(main())
