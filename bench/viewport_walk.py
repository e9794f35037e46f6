"""Runs inside Blender's window: the viewport's side of bench/viewport.py. See tests/window/drive.py, which starts it.

Whoever asks for a frame writes FOLDER/ask.json with its camera; FOLDER/answer.json then holds its times, with the same number.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path
from typing import Any

import gpu
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests" / "window"))
import drive


def part(name: str) -> Any:
    """A module of the installed extension."""
    return importlib.import_module(f"bl_ext.user_default.snerg_addon.{name}")


def frames(window: drive.Window, folder: str) -> drive.Walk:
    """Answer until asked for no camera: {"number", "whole", "draft", "draft_size"}, milliseconds of a redraw at rest and in motion."""
    scene = part("core.export.scene_files").read_scene(Path(folder))
    held = part("snerg_addon.viewport.gpu_scene").GpuScene(scene)
    window.seen["renderer"] = gpu.platform.renderer_get()
    window.seen["version"] = gpu.platform.version_get()
    window.write()
    done = -1
    while True:
        yield
        ask = read(window.folder / "ask.json")
        if ask is None or ask["number"] == done:
            continue
        if ask["camera"] is None:
            break
        done = ask["number"]
        write(window.folder / "answer.json", {"number": done, **frame(scene, held, ask)})


def frame(scene: Any, held: Any, ask: dict[str, Any]) -> dict[str, Any]:
    """The times of a camera's frame, drawn by the functions with which the viewport draws; ask's picture: a file for its pixels."""
    draw, view, gpu_scene = (part(f"snerg_addon.viewport.{name}") for name in ("draw", "view", "gpu_scene"))
    camera = part("core.geometry.camera").Camera.from_json(ask["camera"])
    width, height = camera.width, camera.height
    projection = view.Projection.from_matrix(window_matrix(camera))
    screen = gpu.types.GPUOffScreen(width, height)
    picture = draw.Picture(gpu_scene.Target(width, height))

    def one(still: bool) -> float:
        """Milliseconds of one redraw. still: all of the picture, as after the last band; else what a moving view shows."""
        began = time.perf_counter()
        seen = view.uniforms(scene, scene.box.box_to_world, camera.camera_to_world, projection)
        seen_in = view.screen_part(scene, scene.box.box_to_world, camera.camera_to_world, projection, (width, height))
        with screen.bind():
            if still:
                picture.part, picture.rows = seen_in, seen_in.height
                gpu_scene.march(held, seen, picture.full, seen_in)
            else:
                picture.key = b""
                draw.work(held, seen, picture, seen_in)
            gpu.state.viewport_set(0, 0, width, height)
            draw.show(picture, projection)
            gpu.state.active_framebuffer_get().read_color(0, 0, 1, 1, 4, 0, "FLOAT")
        return 1000 * (time.perf_counter() - began)

    one(True)
    whole = one(True)
    if ask["picture"]:
        np.save(ask["picture"], picture.full.pixels()[0])
    picture.pixel = whole / 1000 / picture.part.pixels
    one(False)
    picture.pixel = whole / 1000 / picture.part.pixels
    draft = one(False)
    screen.free()
    return {"whole": whole, "draft": draft, "draft_size": picture.draft.size if picture.draft else (width, height)}


def window_matrix(camera: Any) -> np.ndarray:
    """[4, 4], the projection of a perspective camera as Blender has it."""
    near, far = 0.01, 1000.0
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[1, 1] = 2 * camera.focal[0] / camera.width, 2 * camera.focal[1] / camera.height
    matrix[0, 2], matrix[1, 2] = 1 - 2 * camera.centre[0] / camera.width, 2 * camera.centre[1] / camera.height - 1
    matrix[2, 2:], matrix[3, 2] = (-(far + near) / (far - near), -2 * far * near / (far - near)), -1
    return matrix


def read(path: Path) -> Any:
    """A JSON file; None where there is none yet."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        return None


def write(path: Path, value: Any) -> None:
    """A JSON file, whole or not at all."""
    part_of_it = path.with_suffix(".part")
    part_of_it.write_text(json.dumps(value))
    part_of_it.replace(path)


if __name__ == "__main__":
    drive.main(sys.modules[__name__])
