"""Writes what Blender's viewport would give the graphics card for scenes and cameras; run by test_viewport_shader.py in a process of its
own, because Blender and a browser do not go together in one.

Usage: viewport_shader.py FOLDER: reads FOLDER/NAME/scene and cameras.json, writes gpu.npz and shader.glsl beside them, and the shader that
lays a picture into the viewport as FOLDER/composite.glsl.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bpy  # noqa: F401 the extension's modules want it first
import numpy as np

from snerg.core.export.scene_files import read_scene
from snerg.core.geometry.camera import Camera
from snerg.core.scene.scene import Scene
from snerg.snerg_addon.viewport import gpu_scene, shader, view


class Recorded:
    """What the extension asks of a shader, as GLSL ES: the card's own language has another frame round the same code."""

    def __init__(self) -> None:
        self.defines: list[str] = []
        self.declared: list[str] = []
        self.body = ""

    def typedef_source(self, text: str) -> None:
        self.declared.append(text)

    def uniform_buf(self, slot: int, kind: str, name: str) -> None:
        self.declared.append(f"layout(std140) uniform Given {{ {kind} {name}; }};")

    def sampler(self, slot: int, kind: str, name: str) -> None:
        self.declared.append(f"uniform sampler{kind[-2:]} {name};")

    def push_constant(self, kind: str, name: str) -> None:
        self.declared.append(f"uniform {kind.lower()} {name};")

    def depth_write(self, kind: str) -> None:
        """GLSL ES declares nothing for it."""

    def fragment_out(self, slot: int, kind: str, name: str) -> None:
        self.declared.append(f"layout(location = {slot}) out {kind.lower()} {name};")

    def define(self, name: str, value: str) -> None:
        self.defines.append(f"#define {name} {value}")

    def fragment_source(self, text: str) -> None:
        self.body = text

    def glsl(self) -> str:
        precision = [f"precision highp {kind};" for kind in ("float", "int", "sampler2D", "sampler3D")]
        return "\n".join(["#version 300 es", *precision, "in vec2 ndc;", *self.defines, *self.declared, self.body])


def main(folder: Path) -> None:
    shader._info = Recorded
    shader.gpu = SimpleNamespace(shader=SimpleNamespace(create_from_info=lambda info: info))
    scenes = sorted(folder.iterdir())
    (folder / "composite.glsl").write_text(shader.composite_shader().glsl())
    for one in scenes:
        scene = read_scene(one / "scene")
        held, arrays = textures(scene)
        features_need_alpha = not scene.cells[..., 3:-1][scene.cells[..., -1] == 0].any()
        (one / "shader.glsl").write_text(shader.march_shader(scene, held.pages, features_need_alpha).glsl())
        cameras = [Camera.from_json(value) for value in json.loads((one / "cameras.json").read_text())]
        arrays |= {f"view_{i}": uniforms(scene, camera) for i, camera in enumerate(cameras)}
        np.savez(one / "gpu.npz", **arrays)


def textures(scene: Scene) -> tuple[Any, dict[str, np.ndarray]]:
    """The textures of a scene [Z, Y, X, C], as GpuScene lays them out; two pages where there are cells for it."""
    held: Any = gpu_scene.GpuScene.__new__(gpu_scene.GpuScene)
    held.scene = scene
    held.page_cells = -(-max(len(scene.cells), 1) // 2)
    held.layout = gpu_scene.layout(held.page_cells, 1)[1]
    held.pages = max(1, -(-len(scene.cells) // held.page_cells))
    arrays, skips = {"indirection": held._indirection()}, gpu_scene.skip_tables(scene.cells)
    for page in range(held.pages):
        rows = slice(page * held.page_cells, (page + 1) * held.page_cells)
        cells = gpu_scene.as_bytes(scene.cells[rows], scene)
        arrays[f"rgba_{page}"] = held._laid_out(np.concatenate([cells[..., :3], cells[..., -1:]], axis=-1))
        arrays[f"skip_{page}"] = held._laid_out(skips[rows, ..., None])
        if scene.network is not None:
            arrays[f"feature_{page}"] = held._laid_out(cells[..., 3:7])
    return held, arrays


def uniforms(scene: Scene, camera: Camera) -> np.ndarray:
    scale = camera.width / 2 / camera.focal[0], camera.height / 2 / camera.focal[1]
    offset = (camera.width / 2 - camera.centre[0]) / camera.focal[0], (camera.centre[1] - camera.height / 2) / camera.focal[1]
    parallel = camera.projection == "orthographic"
    projection = view.Projection(scale, offset, parallel, camera.near, min(camera.far, 1e6), np.eye(4))
    return view.uniforms(scene, scene.box.box_to_world, camera.camera_to_world, projection)


main(Path(sys.argv[1]))
