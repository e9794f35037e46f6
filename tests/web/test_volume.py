"""SnergVolume in a scene of three.js of its own: depth, transforms and several volumes, against the NumPy marcher."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from scenes import make_cameras, make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.core.geometry.camera import Camera
from snerg.core.rendering.render import render_scene
from snerg.tests.web.conftest import ROOT, picture_of

Serve = Callable[[Path], str]
GREEN = (0.0, 0.5, 0.25)  # linear


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example page, built, with a bundle."""
    folder = tmp_path_factory.mktemp("example")
    source = ROOT / "viewer" / "examples" / "mesh"
    for name in ("index.html", "example.css"):
        shutil.copyfile(source / name, folder / name)
    texts = [f"--loader:.{suffix}=text" for suffix in ("glsl", "css", "html")]
    esbuild = [str(ROOT / "node_modules" / ".bin" / "esbuild"), "--bundle", "--format=esm", "--log-level=error", *texts]
    subprocess.run([*esbuild, str(source / "main.ts"), f"--outfile={folder / 'example.js'}"], check=True)
    return folder


def quad(camera: Camera, depth: float) -> dict:
    """glTF of an unlit rectangle over the left half of a camera's picture, at a depth along its axis."""
    corners = np.array([[-1e-3, -1e-3], [camera.width / 2, -1e-3], [camera.width / 2, camera.height], [-1e-3, camera.height]])
    plane = np.stack([(corners[:, 0] - camera.centre[0]) / camera.focal[0], (camera.centre[1] - corners[:, 1]) / camera.focal[1]], axis=-1)
    if camera.projection == "perspective":
        plane = plane * depth
    local = np.concatenate([plane, np.full((4, 1), -depth)], axis=1)
    world = local @ camera.camera_to_world[:3, :3].T + camera.camera_to_world[:3, 3]
    points = np.stack([world[:, 0], world[:, 2], -world[:, 1]], axis=1).astype("<f4")  # Y up
    data = points.tobytes() + np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes()
    return {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
        "materials": [
            {"pbrMetallicRoughness": {"baseColorFactor": [*GREEN, 1]}, "doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}
        ],
        "buffers": [{"byteLength": len(data), "uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode()}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 12}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }


@pytest.mark.parametrize("index", [0, 2], ids=["perspective", "orthographic"])
def test_a_mesh_half_inside_a_volume(page: Page, example: Path, serve: Serve, index: int) -> None:
    """The march ends at the mesh, in each pixel where it would with a far plane there."""
    scene, camera = make_snerg(shape=(34, 30, 40)), make_cameras()[index]
    centre = scene.box.corners().mean(axis=0) - camera.camera_to_world[:3, 3]
    depth = float(-camera.camera_to_world[:3, 2] @ centre)
    write_bundle(scene, [camera], example / "bundle")
    (example / "model.gltf").write_text(json.dumps(quad(camera, depth)))
    page.goto(serve(example))
    page.evaluate("window.ready")
    shown = picture_of(page)
    colour = np.where(np.array(GREEN) <= 0.0031308, 12.92 * np.array(GREEN), 1.055 * np.array(GREEN) ** (1 / 2.4) - 0.055)
    expected = render_scene(scene, camera).over()
    before = render_scene(scene, replace(camera, far=depth)).over(tuple(colour))
    half = camera.width // 2
    assert np.abs(before[:, :half] - render_scene(scene, camera).over(tuple(colour))[:, :half]).max() > 0.05, "the mesh hides something"
    expected[:, :half] = before[:, :half]
    assert np.abs(shown - expected).max() < 3 / 255 and np.abs(shown - expected).mean() < 0.5 / 255
