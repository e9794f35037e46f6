"""Photographs that EXIF turns stand upright behind their cameras. The walk is in backgrounds.py; pictures: build/window."""

from __future__ import annotations

import json

import numpy as np
import pytest
from captures import ring
from PIL import Image

from snerg.core.data.readers.transforms_camera import intrinsics_json

CORNERS = {(0, 0): (220, 0, 0), (0, 1): (0, 200, 0), (1, 0): (0, 0, 220), (1, 1): (60, 60, 60)}  # colours by (row, column) of a quarter
STORED = {5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_90, 7: Image.Transpose.TRANSVERSE, 8: Image.Transpose.ROTATE_270}


@pytest.mark.parametrize("orientation", [5, 6])
def test_a_photograph_that_exif_turns_stands_upright(blender, orientation):
    folder = blender.folder("turned-photos")
    (folder / "images").mkdir(parents=True, exist_ok=True)
    upright = np.zeros((240, 180, 3), np.uint8)
    for (row, column), colour in CORNERS.items():
        upright[row * 120 : (row + 1) * 120, column * 90 : (column + 1) * 90] = colour
    exif = Image.Exif()
    exif[0x0112] = orientation
    frames = []
    for camera in ring(4):
        Image.fromarray(upright).transpose(STORED[orientation]).save(folder / "images" / f"{camera.name}.png", exif=exif)
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": camera.camera_to_world.tolist()})
    lens = {**intrinsics_json(ring(1)[0]), "w": 180, "h": 240, "fl_x": 200, "fl_y": 200, "cx": 90, "cy": 120, "sharpen": 1}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    seen = blender.walk("turned", folder)
    said = " ".join(seen["dataset"])
    assert "1 note on the dataset" in said and "sharpen has no effect" in said
    with Image.open(blender.folder("turned") / "seen.png") as opened:
        pixels = np.asarray(opened.convert("RGB").resize((180, 240)), int)
    for row, column in CORNERS:
        patch = pixels[row * 120 + 20 : row * 120 + 40, column * 90 + 20 : column * 90 + 40].mean(axis=(0, 1))
        nearest = min(CORNERS, key=lambda corner: np.abs(patch - CORNERS[corner]).sum())
        assert nearest == (row, column), f"The quarter {row, column} shows the colour of {nearest}; look at seen.png"
