"""A real browser, and a plain static server for the pages that it opens."""

from __future__ import annotations

import functools
import http.server
import io
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, Playwright, sync_playwright

ROOT = Path(__file__).parents[2]
ARGUMENTS = [
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-background-networking",
]


@pytest.fixture(scope="session")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="session")
def launch(playwright: Playwright) -> Callable[..., Browser]:
    """Start a browser with more arguments than the usual ones."""
    script = "import('@sparticuz/chromium').then(async (m) => console.log(await m.default.executablePath()))"
    found = subprocess.run(["node", "-e", script], cwd=ROOT, capture_output=True, text=True, check=True)
    path = found.stdout.strip()
    return lambda *more: playwright.chromium.launch(executable_path=path, args=[*ARGUMENTS, *more])


@pytest.fixture(scope="session")
def browser(launch: Callable[..., Browser]) -> Iterator[Browser]:
    browser = launch()
    yield browser
    browser.close()


@pytest.fixture
def page(browser: Browser) -> Iterator[Page]:
    context = browser.new_context(viewport={"width": 1200, "height": 400})
    context.set_default_timeout(60_000)
    yield context.new_page()
    context.close()


class Handler(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="session")
def serve() -> Iterator[Callable[[Path], str]]:
    """A folder to its address."""
    servers: list[http.server.ThreadingHTTPServer] = []

    def start(folder: Path) -> str:
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(folder)))
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        servers.append(server)
        return f"http://127.0.0.1:{server.server_port}/"

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


def opened(page: Page, address: str) -> str | None:
    """Open a page and wait until it shows its scene or says why not, which is returned."""
    page.goto(address)
    ready = page.evaluate("window.snerg.ready")
    problem = page.evaluate("window.snerg.problem")
    assert ready == (problem is None)
    if problem:
        assert page.get_by_role("alert").inner_text().endswith(f"{problem}\n\nReload")
    return problem


def picture(page: Page) -> np.ndarray:
    """What the canvas shows, float64 [H, W, 3] in [0, 1]."""
    page.evaluate("window.snerg.settled()")
    return picture_of(page)


def picture_of(page: Page) -> np.ndarray:
    """What the canvas shows now, as `picture` returns it."""
    canvas = page.locator("#canvas")
    canvas.evaluate("canvas => canvas.blur()")  # without the ring of the focus
    data = canvas.screenshot()
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")) / 255
