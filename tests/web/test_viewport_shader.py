"""The viewport's shader against the float64 march, on the browser's graphics card: its code and textures are those that Blender gets."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page

from oracle import dense_march, trilinear
from scenes import looking, make_cameras, make_roots, make_snerg, random_network, snerg_from_volume, two_frequencies
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.camera import Camera
from snerg.core.scene.scene import Scene
from snerg.tests.web.conftest import ROOT
from snerg.tests.web.viewport_card import CARD

LEVEL = 1 / 255
DRAW = f"""async ({{ glsl, textures, view, width, height }}) => {{{CARD}"""
DRAW += """
  const bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const program = build(glsl);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  let unit = 0;
  for (const [name, { size, channels, float, data }] of Object.entries(textures)) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_3D, gl.createTexture());
    for (const edge of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_3D, edge, gl.NEAREST);
    const [inner, format] = float ? [gl.RGBA32F, gl.RGBA] : channels === 4 ? [gl.RGBA8, gl.RGBA] : [gl.R8, gl.RED];
    const values = float ? new Float32Array(bytes(data).buffer) : bytes(data);
    gl.texImage3D(gl.TEXTURE_3D, 0, inner, ...size, 0, format, float ? gl.FLOAT : gl.UNSIGNED_BYTE, values);
    gl.uniform1i(gl.getUniformLocation(program, name), unit++);
  }
  gl.bindBuffer(gl.UNIFORM_BUFFER, gl.createBuffer());
  gl.bufferData(gl.UNIFORM_BUFFER, bytes(view), gl.STATIC_DRAW);
  gl.uniformBlockBinding(program, gl.getUniformBlockIndex(program, "Given"), 0);
  gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, gl.getParameter(gl.UNIFORM_BUFFER_BINDING));
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.activeTexture(gl.TEXTURE0 + unit);
  [gl.RGBA32F, gl.R32F].forEach((kind, i) => {
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texStorage2D(gl.TEXTURE_2D, 1, kind, width, height);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + i, gl.TEXTURE_2D, gl.getParameter(gl.TEXTURE_BINDING_2D), 0);
  });
  gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
  gl.viewport(0, 0, width, height);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  return [0, 1].map((i) => {
    const found = new Float32Array(width * height * (i ? 1 : 4));
    gl.readBuffer(gl.COLOR_ATTACHMENT0 + i);
    gl.readPixels(0, 0, width, height, i ? gl.RED : gl.RGBA, gl.FLOAT, found);
    return Array.from(found);
  });
}
"""


def faint_voxels() -> Scene:
    """Single voxels, five apart, in a grid of three blocks, and one beside each border of blocks."""
    values = np.zeros((64, 46, 36, 4), np.uint8)
    values[2::5, 3::5, 1::5] = (25, 25, 25, 25)
    values[29, 7, 30] = values[30, 40, 29] = values[59, 30, 3] = values[60, 29, 33] = (90, 60, 30, 120)
    pose = np.eye(4)
    pose[:3, 3] = -np.array(values.shape[:3]) / 40
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=0.05)


def veil() -> Scene:
    """White behind black fog: what a ray misses when it ends is white."""
    values = np.zeros((160, 30, 30, 4), np.uint8)
    values[:80], values[80:] = (0, 0, 0, 8), (200, 200, 200, 200)
    pose = np.eye(4)
    pose[:3, 3] = -np.array(values.shape[:3]) / 40
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=0.05)


def stray() -> Scene:
    """Features where nothing is opaque, as other programs leave them, beside what is."""
    values = np.zeros((34, 30, 40, 8), np.uint8)
    values[8:26, 8:22, 10:30, :7] = np.random.default_rng(0).integers(0, 30, (18, 14, 20, 7))
    values[12:20, 12:18, 16:24, 7] = 60
    pose = np.eye(4)
    pose[:3, 3] = -np.array(values.shape[:3]) / 30
    return snerg_from_volume(values, two_frequencies(random_network()), grid_to_world=pose, voxel_size=2 / 30)


def sparse() -> Scene:
    """Single voxels in a few of many blocks."""
    values = np.zeros((150, 40, 150, 4), np.uint8)
    for x, y, z in np.random.default_rng(0).integers(0, values.shape[:3], (22, 3)):
        values[x, y, z] = (30, 60, 90, 120)
    pose = np.eye(4)
    pose[:3, 3] = -np.array(values.shape[:3]) / 40
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=0.05)


def fog() -> Scene:
    """Even fog, in which each step more or less shows."""
    values = np.zeros((60, 60, 40, 4), np.uint8)
    values[:] = (12, 9, 4, 12)
    pose = np.eye(4)
    pose[:3, 3] = -np.array(values.shape[:3]) / 40
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=0.05)


AROUND = [looking((0.9, -4.2, 1.1), (0, 0, 0)), looking((-3.1, 2.2, -2.4), (0, 0, 0))]
TURNED = {"angles": (0.2, 0.1, 0.3), "centre": (0.1, 0.2, 0.3)}
SCENES = {
    "network": (make_snerg(shape=(34, 30, 40), near=0.4, **TURNED), make_cameras((0.1, 0.2, 0.3), width=60, height=45)[1:4]),
    "corrected": (make_snerg(shape=(44, 40, 47), diffuse=True, opacity_correction=True), make_cameras(width=60, height=45)[:2]),
    "faint": (faint_voxels(), [Camera(90, 70, (97.0, 97.0), (45, 35), pose) for pose in AROUND]),
    "axes": (
        faint_voxels(),
        [Camera(50, 50, (14.0, 14.0), (25.2, 24.7), looking(e, (0, 0, 0)), "orthographic") for e in ((4.0, 0, 0), (0, 0, 4.0))],
    ),
    "veil": (veil(), [Camera(40, 40, (400.0, 400.0), (20, 20), looking((-14.0, 0.3, 0.2), (0, 0, 0)))]),
    "sparse": (sparse(), [Camera(60, 48, (48.0, 48.0), (30, 24), looking((1.0, -8.0, 2.0), (0, 0, 0)))]),
    "clipped": (
        fog(),
        [
            Camera(40, 32, (20.0, 20.0), (20, 16), looking((0.1, -2.2, 0.3), (0.1, 2, 0.1)), near=n, far=f)
            for n, f in ((1.5, 9.0), (0.0, 2.6))
        ],
    ),
    "thin fog": (make_roots(shape=(34, 30, 40), **TURNED), make_cameras((0.1, 0.2, 0.3), width=60, height=45)[1:4]),
    "stray": (stray(), [Camera(60, 60, (70.0, 70.0), (30, 30), AROUND[0])]),
}


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if find_spec("bpy") is None:
        pytest.skip("the viewport's code is made by Blender's module")
    folder = tmp_path_factory.mktemp("viewport")
    for name, (scene, cameras) in SCENES.items():
        write_scene(scene, folder / name / "scene")
        (folder / name / "cameras.json").write_text(json.dumps([camera.to_json() for camera in cameras]))
    script = [sys.executable, str(ROOT / "tests" / "web" / "viewport_shader.py"), str(folder)]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def drawn(page: Page, folder: Path, camera: Camera, index: int) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied colour and alpha [H, W, 4], and depth [H, W] along the view axis."""
    arrays = dict(np.load(folder / "gpu.npz"))
    textures: dict[str, Any] = {}
    for name, values in arrays.items():
        if not name.startswith("view_"):
            data = base64.b64encode(np.ascontiguousarray(values).tobytes()).decode()
            size = [values.shape[2], values.shape[1], values.shape[0]]
            textures[name] = {"size": size, "channels": values.shape[3], "float": values.dtype == np.float32, "data": data}
    seen = base64.b64encode(arrays[f"view_{index}"].astype(np.float32).tobytes()).decode()
    sizes = {"width": camera.width, "height": camera.height}
    colour, depth = page.evaluate(DRAW, {"glsl": (folder / "shader.glsl").read_text(), "textures": textures, "view": seen, **sizes})
    height, width = camera.height, camera.width
    return np.array(colour).reshape(height, width, 4)[::-1], np.array(depth).reshape(height, width)[::-1]


@pytest.mark.hard_case(18, 31, 33, 34, 35, 36, 37, 41, 42, 43, 53)
@pytest.mark.parametrize("name", SCENES)
def test_the_viewport_shows_what_is_marched(page: Page, given: Path, name: str) -> None:
    """In every pixel, but where a ray's last light decides on the network, to a level and a half."""
    scene, cameras = SCENES[name]
    for index, camera in enumerate(cameras):
        colour, _ = drawn(page, given / name, camera, index)
        truth = dense_march(scene, camera)
        wanted = np.concatenate([truth.colour, 1 - truth.transmittance[..., None]], axis=-1)
        error = np.abs(np.clip(colour, 0, 1) - np.clip(wanted, 0, 1)).max(axis=-1)
        assert wanted.max() > 20 * LEVEL and error.mean() < 0.3 * LEVEL, camera.name
        assert np.mean(error < 1.5 * LEVEL) >= (0.998 if scene.network is not None else 1.0), (
            f"{camera.name}: {error.max() / LEVEL:.1f} levels"
        )


def test_inputs_without_weights_are_not_in_the_code(given: Path) -> None:
    whole, half = ((given / name / "shader.glsl").read_text() for name in ("network", "stray"))
    for function in ("sin", "cos"):
        assert all(f"{function}(({scale}.0 * direction).x)" in whole for scale in (2, 4, 8))
        assert f"{function}((2.0 * direction).x)" in half and f"{function}((4.0" not in half and f"{function}((8.0" not in half


@pytest.mark.parametrize("index", [0, 1], ids=["perspective", "parallel"])
def test_the_viewports_depth_is_where_half_of_the_light_is_gone(page: Page, given: Path, index: int) -> None:
    """Along the view axis, in world units; of a ray that keeps more, where it enters."""
    scene, cameras = SCENES["network"]
    camera = cameras[index]
    _, depth = drawn(page, given / "network", camera, index)
    origins, directions = camera.rays()
    local, along = ((v @ scene.grid_to_world[:3, :3]) for v in (origins - scene.grid_to_world[:3, 3], directions))
    local, size, cosines = local / scene.voxel_size, np.array(scene.shape), directions @ -camera.camera_to_world[:3, 2]
    checked = 0
    for row in np.random.default_rng(0).permutation(len(origins))[:200]:
        walls = np.stack([-local[row] / along[row], (size - local[row]) / along[row]])
        start, leave = max(walls.min(axis=0).max(), scene.near / scene.voxel_size), walls.max(axis=0).min()
        if start >= leave:
            continue
        light, k, half = 1.0, 0, start
        while start + k + 0.5 < leave and light >= 0.5:
            light *= 1 - trilinear(scene, (local[row] + (start + k + 0.5) * along[row])[None])[0, -1]
            half = start + k + 0.5 if light < 0.5 else start
            k += 1
        if abs(light - 0.5) > 0.02:
            checked += 1
            assert depth.reshape(-1)[row] == pytest.approx(half * scene.voxel_size * cosines[row], abs=1e-3)
    assert checked > 40
