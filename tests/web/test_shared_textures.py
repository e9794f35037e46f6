"""Several volumes of one scene share its textures: read once, freed with the last, and read again after a lost graphics context."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page

from snerg.core.export.bundle import write_bundle
from snerg.tests.web.conftest import ROOT, picture_of
from snerg.tests.web.test_several_volumes import Standing, cases, compare, put_together, small

Serve = Callable[[Path], str]
CAMERA = cases()["before and behind"][0]
LEFT = Standing(small(), (0.4, -0.3, 1.0), 1.0, (-1.0, 0.3, 0.2))
RIGHT = Standing(LEFT.scene, (2.0, 0.5, -1.0), 0.7, (1.4, -0.8, 0.1))

PAGE = """
import { Color, Matrix4, Scene, WebGLRenderer } from "three";
import { readCameras, ServerFiles, SnergScene, SnergVolume, threeCamera } from "./index";

const renderer = new WebGLRenderer({ canvas: document.getElementById("canvas") });
const world = new Scene();
world.background = new Color("white");
const volumes = {};
let camera, scene;
Object.assign(window, {
  events: [],
  async open() {
    const list = await readCameras(new ServerFiles("web"), "cameras.json");
    camera = threeCamera(list.cameras[0], { far: 100 });
    renderer.setSize(list.cameras[0].width, list.cameras[0].height);
    scene = await SnergScene.load("web/scene");
  },
  add(name, matrix) {
    const volume = new SnergVolume(scene);
    volume.applyMatrix4(new Matrix4().set(...matrix.flat()));
    for (const kind of ["change", "error"]) volume.addEventListener(kind, () => events.push(`${name} ${kind}`));
    volumes[name] = volume;
    world.add(volume);
    return volume.load(renderer).then(() => "whole", (error) => error.name);
  },
  drop(name) {
    world.remove(volumes[name]);
    volumes[name].dispose();
    delete volumes[name];
  },
  draw() {
    renderer.render(world, camera);
    return [renderer.info.memory.textures, ...Object.values(volumes).map((volume) => volume.graphicsBytes)];
  },
  async lose() {
    const lost = renderer.getContext().getExtension("WEBGL_lose_context");
    lost.loseContext();
    await new Promise((resolve) => setTimeout(resolve, 50));
    lost.restoreContext();
  },
});
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory, serve: Serve) -> str:
    folder = tmp_path_factory.mktemp("shared")
    esbuild = [str(ROOT / "node_modules" / ".bin" / "esbuild"), "--bundle", "--format=iife", "--log-level=error"]
    texts = [f"--loader:.{suffix}=text" for suffix in ("glsl", "css", "html")]
    subprocess.run([*esbuild, *texts, f"--outfile={folder / 'page.js'}"], input=PAGE, cwd=ROOT / "viewer/src", text=True, check=True)
    (folder / "index.html").write_text(
        '<!doctype html><body style="margin:0"><canvas id="canvas" style="display:block"></canvas><script src="page.js"></script>'
    )
    write_bundle(LEFT.scene, [CAMERA], folder / "web")
    return serve(folder)


def begin(page: Page, address: str) -> list[str]:
    """Open the page; the list grows with each file of colours that it fetches."""
    fetched: list[str] = []
    page.on("request", lambda request: fetched.append(request.url) if "rgba_" in request.url else None)
    page.goto(address)
    page.evaluate("open()")
    return fetched


def add(page: Page, **volumes: Standing) -> list[str]:
    matrices = {name: volume.matrix.tolist() for name, volume in volumes.items()}
    return page.evaluate("all => Promise.all(Object.entries(all).map(([name, matrix]) => add(name, matrix)))", matrices)


def shows(page: Page, *volumes: Standing) -> list[int]:
    """Compare the picture with that of volumes; the number of textures, and what each volume tells of its bytes."""
    told = page.evaluate("draw()")
    compare(picture_of(page), put_together(CAMERA, volumes, []))
    return told


def test_a_second_volume_brings_no_texture(page: Page, address: str) -> None:
    fetched = begin(page, address)
    assert add(page, left=LEFT) == ["whole"]
    files = len(fetched)
    textures, size = shows(page, LEFT)
    assert files > 0 and size > 1e6
    assert add(page, right=RIGHT) == ["whole"] and shows(page, LEFT, RIGHT) == [textures, size, size]
    page.evaluate("drop('left')")
    assert shows(page, RIGHT) == [textures, size], "the other goes on"
    assert add(page, left=LEFT) == ["whole"] and shows(page, RIGHT, LEFT) == [textures, size, size]
    assert len(fetched) == files, "the scene was read once"
    page.evaluate("drop('left'); drop('right')")
    assert shows(page)[0] <= textures - 4, "all of colours, features, distances and blocks are gone"
    assert add(page, left=LEFT) == ["whole"] and shows(page, LEFT) == [textures, size]
    assert len(fetched) == 2 * files


def test_one_that_leaves_while_both_are_loading(page: Page, address: str) -> None:
    fetched = begin(page, address)
    page.route("**/rgba_003.png", lambda route: None)  # not answered for now
    page.evaluate("matrices => { window.both = Promise.all(matrices.map((matrix, i) => add(i, matrix))); }", [
        LEFT.matrix.tolist(), RIGHT.matrix.tolist()
    ])  # fmt: skip
    page.wait_for_timeout(200)
    page.evaluate("drop(0)")
    page.unroute("**/rgba_003.png")
    assert page.evaluate("both") == ["AbortError", "whole"]
    shows(page, RIGHT)
    assert len(fetched) == len(set(fetched))


def test_a_lost_context_restores_both(page: Page, address: str) -> None:
    begin(page, address)
    assert add(page, left=LEFT, right=RIGHT) == ["whole", "whole"]
    before = shows(page, LEFT, RIGHT)
    page.evaluate("events.length = 0")
    page.evaluate("lose()")
    page.wait_for_function("events.length >= 2")
    assert sorted(page.evaluate("events")) == ["left change", "right change"]
    assert shows(page, LEFT, RIGHT)[1:] == before[1:]
