"""Files that version 0.1.0 wrote are read as it read them, and a training that it began goes on."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

from scenes import make_cameras
from snerg.core.artifact import open_scene
from snerg.core.commands.info import info
from snerg.core.commands.train import train_field
from snerg.core.nerf.checkpoint import FILE, read_field
from snerg.core.rendering.render import render_scene

WRITTEN = Path(__file__).parent / "data" / "written_by_0_1"
SETTINGS = {  # of its fields
    "samples": "1024",
    "family.grid.levels": "4",
    "family.grid.coarsest": "8",
    "family.grid.finest": "32",
    "family.grid.log2_size": "10",
    "family.width": "16",
    "view_dependence": "deferred",
}


@pytest.fixture(scope="module")
def expected():
    """What 0.1.0 made of its files: densities and values at points, and a picture."""
    return np.load(WRITTEN / "expected.npz")


@pytest.mark.parametrize("name", ["field", "mlp"])
def test_a_field_evaluates_as_it_did(expected, name):
    density, values = read_field(WRITTEN / name).evaluate(expected["points"])
    np.testing.assert_allclose(density, expected[f"{name}_density"], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(values, expected[f"{name}_values"], rtol=1e-4, atol=1e-5)


def test_a_scene_renders_as_it_did(expected):
    frame = render_scene(open_scene(WRITTEN / "scene"), make_cameras(width=24, height=18)[0])
    np.testing.assert_allclose(frame.colour, expected["scene_colour"], atol=1e-5)
    np.testing.assert_allclose(frame.alpha, expected["scene_alpha"], atol=1e-5)
    assert info(WRITTEN / "scene")["effects"] == {"view_dependence": True, "ndc": False, "fill_holes": False}


def test_a_training_that_was_stopped_goes_on(tmp_path):
    for name in ("dataset", "stopped"):
        shutil.copytree(WRITTEN / name, tmp_path / name)
    arrays = dict(np.load(tmp_path / "stopped" / FILE))
    about = json.loads(arrays["json"].tobytes()) | {"dataset": str((tmp_path / "dataset").resolve())}
    np.savez(tmp_path / "stopped" / FILE, **arrays | {"json": np.frombuffer(json.dumps(about).encode(), np.uint8)})
    result = train_field(tmp_path / "dataset", tmp_path / "stopped", steps=60, values=SETTINGS)
    assert result["resumed"] and result["steps"] == 60
