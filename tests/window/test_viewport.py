"""The viewport's march: NumPy's picture within 2/255, before and behind meshes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from scenes import make_cameras, make_snerg, snerg_from_volume
from snerg.core.export.scene_files import write_scene

from .conftest import OUT

COLOURS = {"red": (255, 0, 0), "green": (0, 255, 0), "green over blue": (0, 255, 0), "blue": (0, 0, 255)}


@pytest.mark.hard_case(74)
@pytest.mark.parametrize("kind", ["network", "diffuse", "corrected", "stray"])
def test_the_picture_is_numpys(blender, kind):
    folder = OUT / f"scene {kind}"
    shutil.rmtree(folder, ignore_errors=True)
    turned = {"angles": (0.2, 0.1, 0.3), "centre": (0.1, 0.2, 0.3)}
    made = make_snerg(diffuse=kind == "diffuse", opacity_correction=kind == "corrected", **turned)
    if kind == "stray":  # features where nothing is opaque, as a lossy codec leaves them
        cells = made.cells.copy()
        cells[..., 3:7][cells[..., -1] == 0] = 20
        made = replace(made, cells=cells)
    write_scene(made, folder)
    cameras = [camera.to_json() for camera in make_cameras((0.1, 0.2, 0.3))]
    (OUT / "cameras.json").write_text(json.dumps(cameras))
    seen = blender.walk("gpu_frames", folder, OUT / "cameras.json")
    assert len(seen["differences"]) == len(cameras)
    for name, most, mean in seen["differences"]:
        assert most < 2 and mean < 0.5, f"{name}: {most:.2f} levels at most, {mean:.3f} in the mean"


def test_meshes_stand_before_and_behind(blender):
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[2:-2, 2:-2, 2:-2] = (0, 255, 0, 255)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    folder = OUT / "block"
    shutil.rmtree(folder, ignore_errors=True)
    write_scene(snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30), folder)
    seen = blender.walk("between_meshes", folder)
    for kind in ("PERSP", "ORTHO"):
        with Image.open(blender.folder("between_meshes") / f"{kind}.png") as opened:
            pixels = np.asarray(opened.convert("RGB")).astype(int)
        for name, (x, y) in seen[kind].items():
            shown = pixels[int(pixels.shape[0] - y), int(x)]
            assert np.abs(shown - COLOURS[name]).max() < 40, f"{kind}: {name} is {shown}"


def test_a_folder_that_is_written_again_is_shown_whole(blender):
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[2:-2, 2:-2, 2:-2] = (0, 255, 0, 255)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    folder = OUT / "rewritten scene"
    shutil.rmtree(folder, ignore_errors=True)
    write_scene(snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30), folder)
    seen = blender.walk("rewritten", folder)
    x, y = (int(value) for value in seen["middle"])
    for count in range(8):
        with Image.open(blender.folder("rewritten") / f"{count}.png") as opened:
            shown = np.asarray(opened.convert("RGB")).astype(int)[y - 60 : y + 60, x]
        assert np.abs(shown - 255 * np.eye(3)[count % 3]).max() < 40, f"Picture {count} shows {shown.min(axis=0)} to {shown.max(axis=0)}"


def test_a_training_is_shown_as_it_grows_and_not_afterwards(blender, photos):
    seen = blender.walk("shown_training", photos)
    assert all(seen[f"shown {count}"] for count in range(3)) and seen["objects"] == 1, seen
    assert seen["ended"] and not seen["left"], f"What is left of the preview: {seen['left']}"
    before, first, last, after = (picture(blender, name) for name in ("before", "shown-0", "shown-2", "after"))
    assert np.abs(first - before).max() > 60, "The viewport shows no training; see shown-0.png"
    assert np.abs(last - first).max() > 20, "The training did not grow; compare shown-0.png and shown-2.png"
    assert np.abs(after - before).max() < 20, "The training is still shown; see after.png"


def test_the_preview_opens_where_it_can_be_seen(blender):
    folder = OUT / "previewed"
    shutil.rmtree(folder, ignore_errors=True)
    write_scene(make_snerg(diffuse=True, fog=False), folder)
    seen = blender.walk("preview_seen", folder)
    assert seen["windows"] == [1, 2, 1, 2, 2], f"Windows at first, rendered, closed, shown again, rendered again: {seen['windows']}"
    assert seen["images"] == [["SNeRG Preview"], [], ["SNeRG Preview"], ["SNeRG Preview"]]
    assert any("another window" in text for text in seen["texts"][0]) and any("no editor" in text for text in seen["texts"][1])


def picture(blender, name):
    """[h, w, 3] levels of the middle of the window, where the training is shown."""
    with Image.open(blender.folder("shown_training") / f"{name}.png") as opened:
        pixels = np.asarray(opened.convert("RGB")).astype(int)
    return pixels[pixels.shape[0] // 3 : pixels.shape[0] // 2, pixels.shape[1] // 3 : pixels.shape[1] // 2]
