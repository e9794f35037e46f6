"""viewer/README.md: its code runs, and it names all that the package has."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page

from scenes import make_cameras, make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.tests.web.conftest import ROOT

Serve = Callable[[Path], str]
VIEWER = ROOT / "viewer"
README = (VIEWER / "README.md").read_text(encoding="utf-8")
CODE = re.findall(r"```ts\n(.*?)```", README, re.DOTALL)
IMPORT = re.compile(r'^import .*? from "snerg-viewer";\n', re.MULTILINE)
BEFORE = """
import { PerspectiveCamera, Scene, WebGLRenderer } from "three";
import { createViewer as makeViewer } from "./index";
%s
window.run = async () => {
  const { signal } = new AbortController();
  const world = new Scene(), camera = new PerspectiveCamera(), renderer = new WebGLRenderer();
  camera.position.set(0, 1, 5);
  %s
  %s
};
"""
OWN_VIEWER = 'const viewer = makeViewer(document.getElementById("here"), { src: "bundle" });'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("readme")
    write_bundle(make_snerg((20, 20, 20)), make_cameras(width=64, height=48), folder / "bundle")
    cameras = folder / "bundle" / "cameras.json"
    cameras.write_text(cameras.read_text().replace("Front", "Left"))
    return folder


@pytest.mark.parametrize("index", range(len(CODE)))
def test_the_code_runs(page: Page, folder: Path, serve: Serve, index: int) -> None:
    code = CODE[index]
    imports = "".join(IMPORT.findall(code)).replace("snerg-viewer", "./index")
    body = IMPORT.sub("", code).replace("frames: 150", "frames: 1").replace("width: 1920, height: 1080", "width: 64, height: 48")
    own = "" if "const viewer" in code or "viewer." not in code else OWN_VIEWER
    esbuild = [str(ROOT / "node_modules" / ".bin" / "esbuild"), "--bundle", "--format=esm", "--splitting", "--log-level=error"]
    texts = [f"--loader:.{suffix}=text" for suffix in ("glsl", "css", "html")]
    script = BEFORE % (imports, own, body)
    out = folder / f"code_{index}"
    subprocess.run([*esbuild, *texts, f"--outdir={out}"], input=script, cwd=VIEWER / "src", text=True, check=True)
    html = f'<!doctype html><div id="here" style="width:64px;height:48px"></div><script type="module" src="code_{index}/stdin.js"></script>'
    (folder / "index.html").write_text(html)
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(serve(folder))
    page.evaluate("window.run()")
    assert errors == []


def test_every_export_is_named() -> None:
    source = re.sub(r"//.*", "", (VIEWER / "src" / "index.ts").read_text(encoding="utf-8"))
    names = {name.split()[-1] for group in re.findall(r"export (?:type )?\{([^}]*)\}", source) for name in group.split(",") if name.strip()}
    missing = sorted(name for name in names if not re.search(rf"\b{name}\b", README))
    assert not missing, f"viewer/README.md does not name {missing}"


@pytest.mark.parametrize("start", ["export interface Viewer {", "export interface ViewerEvents {"])
def test_every_member_of_a_viewer_is_named(start: str) -> None:
    source = (VIEWER / "src" / "viewer" / "interface.ts").read_text(encoding="utf-8")
    body = source[source.index(start) :].split("\n}")[0]
    members = re.findall(r"^  (?:readonly )?(\w+)(?:<.*?>)?[(:?]", body, re.MULTILINE)
    assert len(members) > 4
    missing = [name for name in members if f"`{name}" not in README]
    assert not missing, f"viewer/README.md does not name {missing}"


def test_every_attribute_is_named() -> None:
    source = (VIEWER / "src" / "viewer" / "element.ts").read_text(encoding="utf-8")
    attributes = set(re.findall(r'(?:getAttribute|pair)\("([\w-]+)"\)', source)) | {"width", "height"}
    assert {"src", "camera", "poster", "distance"} <= attributes
    missing = sorted(name for name in attributes if f"`{name}`" not in README)
    assert not missing, f"viewer/README.md does not name {missing}"
