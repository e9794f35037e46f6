"""Values that come in as JSON or arrays and could be what they seem, but are not: each is refused by the sentence that names it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scenes import make_cameras, make_snerg, random_network
from snerg.core.commands.info import page_cameras
from snerg.core.errors import SnergError
from snerg.core.export.bundle import cameras_json
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.nerf.checkpoint import read_field, write_field
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, MlpModelConfig, init_field
from snerg.core.nerf.sampling import CELLS, Domain
from snerg.core.study.plan import Configuration
from snerg.core.study.sweep import read_row
from snerg.core.training.log import read_log

Edit = Callable[[Any], object]


def put(*path: Any) -> Edit:
    """An edit: the last of `path` at the place that the others name."""
    *places, last, value = path

    def edit(whole: Any) -> None:
        for place in places:
            whole = whole[place]
        whole[last] = value

    return edit


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("scenes") / "scene"
    write_scene(make_snerg((14, 12, 15)), folder)
    return folder


@pytest.mark.parametrize(
    ("named", "edit"),
    [
        ("near", put("near", float("nan"))),
        ("near", put("near", -1)),
        ("fill_holes", put("fill_holes", "false")),
        ("fill_holes", put("fill_holes", float("nan"))),
        ("effects", put("effects", ["ndc"])),
        ("ndc", put("effects", "ndc", "no")),
        ("network_transmittance", put("network_transmittance", "most")),
        ("network_transmittance", put("network_transmittance", -1)),
        ("network_transmittance", put("network_transmittance", float("nan"))),
        ("view_rotation", put("view_rotation", [[1, 0], [0, 1]])),
        ("view_rotation", put("view_rotation", 0, 0, float("nan"))),
        ("view_rotation", put("view_rotation", (2 * np.eye(3)).tolist())),
        ("view_rotation", put("view_rotation", (-np.eye(3)).tolist())),
        ("grid_to_world", put("grid_to_world", 0, 1, 0.5)),
        ("grid_to_world", put("grid_to_world", 0, 3, float("inf"))),
        ("voxel_size", put("voxel_size", True)),
        ("weights_0", put("network", "weights_0", 0, 0, 1e30)),
        ("bias_2", put("network", "bias_2", [1.0])),
        ("shape", put("shape", [14.5, 12, 15])),
        ("macroblocks", put("shape", [100_000] * 3)),
        ("cells", put("cells", -1)),
        ("atlas", put("atlas_blocks", [64, 64, 64])),
        ("decision", put("about", "trained", {"decisions": [{"effect": "NDC"}]})),
        ("held", put("about", "bake", {"voxels": {"held": "many"}})),
        ("gain_db", put("about", "refine", {"gain_db": None})),
        ("gain_db", put("about", "fit", {"gain_db": None})),
        ("about", put("about", 5)),
        ("JSON", put("about", "anything", float("nan"))),
    ],
)
def test_a_scene(scene, tmp_path, named, edit):
    value = json.loads((scene / "scene.json").read_text())
    edit(value)
    for name in ("indirection.png", *(path.name for path in scene.glob("*_*.png"))):
        (tmp_path / name).write_bytes((scene / name).read_bytes())
    (tmp_path / "scene.json").write_text(json.dumps(value))
    with pytest.raises(SnergError, match=rf"(?s){tmp_path}.*{named}") as caught:
        read_scene(tmp_path)
    assert len(str(caught.value)) < 1000


FAMILIES = {"hash": HashModelConfig(HashGrid(2, 4, 8, 2, 8), 8), "mlp": MlpModelConfig(8, 3, 2, 3)}


def write(folder: Path, family: Any, view: str) -> Field:
    params = init_field(family, view, np.random.default_rng(0))
    network = random_network() if "view" in params else None
    domain = Domain.around(-np.ones(3), np.ones(3))
    field = Field(family, params["field"], network, domain, np.ones(CELLS**3, bool), 0.01, make_cameras()[:1], about={}, view=view)
    write_field(field, folder)
    return field


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("view", ["deferred", "diffuse", "sample", "tiny"])
def test_every_kind_of_field_fits_its_schema(family, view, tmp_path):
    field, back = write(tmp_path, FAMILIES[family], view), read_field(tmp_path)
    assert back.family == field.family and back.view == view and (back.network is None) == (field.network is None)


@pytest.mark.parametrize(
    ("named", "edit"),
    [
        ("occupancy", lambda arrays, about: put("occupancy", np.ones(CELLS**3 - 1, bool))(arrays)),
        ("occupancy", lambda arrays, about: put("occupancy", np.ones(CELLS**3))(arrays)),
        ("weights_0", lambda arrays, about: put("params.weights_0", np.ones((3, 8), np.float32))(arrays)),
        ("bias_0", lambda arrays, about: arrays.pop("params.bias_0")),
        ("table_0", lambda arrays, about: put("params.table_0", 0, np.nan)(arrays)),
        ("weights_2", lambda arrays, about: put("view.weights_2", np.ones((16, 4), np.float32))(arrays)),
        ("corners", lambda arrays, about: put("domain.low", np.full(3, 2.0))(arrays)),
        ("centre", lambda arrays, about: put("domain.centre", np.full(3, np.inf))(arrays)),
        ("scale", lambda arrays, about: put("scale", 0)(about)),
        ("spacing", lambda arrays, about: put("spacing", float("nan"))(about)),
        ("levels", lambda arrays, about: put("family", "grid", "levels", 10**6)(about)),
        ("width", lambda arrays, about: put("family", "width", "wide")(about)),
        ("view", lambda arrays, about: put("view", [])(about)),
        ("decisions", lambda arrays, about: put("about", "decisions", 3)(about)),
        ("decision", lambda arrays, about: put("about", "decisions", [{"effect": 1, "chosen": True, "evidence": []}])(about)),
        ("holdout", lambda arrays, about: put("about", "dataset_options", {"holdout": "8"})(about)),
        ("settings", lambda arrays, about: put("about", "settings", [])(about)),
        ("near plane", lambda arrays, about: put("cameras", 0, "near", float("nan"))(about)),
    ],
)
def test_a_field(tmp_path, named, edit):
    write(tmp_path, FAMILIES["hash"], "deferred")
    arrays = dict(np.load(tmp_path / "field.npz"))
    about = json.loads(arrays["json"].tobytes())
    edit(arrays, about)
    np.savez(tmp_path / "field.npz", **arrays | {"json": np.frombuffer(json.dumps(about).encode(), np.uint8)})
    with pytest.raises(SnergError, match=named):
        read_field(tmp_path)


@pytest.mark.parametrize(
    "edit",
    [
        put("psnr", None),
        put("psnr_pooled", "x"),
        put("ms", float("nan")),
        put("seconds", []),
        put("config", "page", 3),
        put("config", "bake", "resolution", "x"),
    ],
)
def test_a_row_of_a_study(tmp_path, edit):
    row: dict[str, Any] = {
        "key": "row",
        "config": Configuration().to_json(),
        "psnr": 30.0,
        "psnr_pooled": 29.0,
        "ms": 5.0,
        "megabytes": 1.0,
        "seconds": {"bake": 1.0},
    }
    path = tmp_path / "row.json"
    path.write_text(json.dumps(row))
    assert read_row(path) == row
    edit(row)
    path.write_text(json.dumps(row))
    with pytest.raises(SnergError, match=r"row\.json"):
        read_row(path)


def test_a_row_of_a_study_whose_psnr_was_pooled(tmp_path):
    row = {"key": "row", "config": None, "psnr": 29.0, "ms": 5.0, "megabytes": 1.0, "psnr_of_views": [28.0, 32.0]}
    path = tmp_path / "row.json"
    path.write_text(json.dumps(row))
    assert read_row(path) == row | {"psnr": 30.0, "psnr_pooled": 29.0}


@pytest.mark.parametrize(
    "edit", [put("cameras", 5), put("cameras", [{}]), put("cameras", 0, "width", 10**9), put("cameras", 0, "name", None)]
)
def test_the_cameras_of_a_page(tmp_path, edit):
    value, path = cameras_json(make_cameras()), tmp_path / "cameras.json"
    path.write_text(json.dumps(value))
    assert [camera.name for camera in page_cameras(path)] == [camera.name for camera in make_cameras()]
    edit(value)
    path.write_text(json.dumps(value))
    with pytest.raises(SnergError):
        page_cameras(path)


def test_lines_of_a_log_that_hold_no_numbers_are_left_out(tmp_path):
    good = {"step": 1, "psnr": 20.0}
    bad = [{"step": True}, {"step": 2, "psnr": "high"}, {"step": 2, "psnr": float("nan")}, {"step": -1}, {"step": 10**400}, ["step"], 5]
    (tmp_path / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in [good, *bad]))
    assert read_log(tmp_path) == [good]
