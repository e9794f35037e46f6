"""What a capture, a field and a scene say of the effects that they call for: as training and baking measured it, and nothing guessed."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from captures import FISHEYE, LENS, facing, ring, write_llff, write_ngp
from PIL import Image

from scenes import make_forward, make_snerg
from snerg.core import cli
from snerg.core.data.load import read_dataset
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import write_scene
from snerg.core.nerf.checkpoint import write_field
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, ViewNetwork, init_params
from snerg.core.nerf.sampling import Domain
from snerg.core.scene.scene import Scene
from snerg.core.study.effects import UNKNOWN, Effect, of_dataset, of_field, of_scene
from snerg.core.training.decisions import Decision, transparency
from snerg.core.training.ray_dataset import RayDataset
from snerg.core.units import file_size

GRID = HashModelConfig(HashGrid(levels=2, coarsest=4, finest=8, features=2, log2_size=8), width=8)


def by_name(effects: list[Effect]) -> dict[str, Decision]:
    assert len({effect.decision.effect for effect in effects}) == len(effects)
    assert all(effect.decision.evidence for effect in effects)
    return {effect.decision.effect: effect.decision for effect in effects}


def field(view: str = "deferred", **about: object) -> Field:
    params = init_params(GRID, view, False, np.random.default_rng(0))
    network = ViewNetwork(*params["view"]) if view == "deferred" else None
    domain = Domain.around(np.full(3, -1.0), np.full(3, 1.0))
    return Field(GRID, params["field"], network, domain, None, 0.01, tuple(ring(4)), "", dict(about), view=view)


def baked(snerg: Scene, seen: int | None = 60, **about: object) -> Scene:
    told = {
        "settings": {"visibility_threshold": 0.01},
        "seconds": {"occupancy": 1.0, "visibility": 2.0, "prefilter": 4.0},
        "voxels": {"held": 80, "seen": seen},
        "light": {"rays": 1000, "passes": 0.04, "voxels": 9.6},
        "samples": 2,
        "samples_measured": [{"samples": n, "error": e} for n, e in ((1, 0.02), (2, 0.01), (4, 0.0099))],
    }
    return replace(snerg, about={"bake": told, **about})


def test_a_capture_is_asked_what_training_asks(dataset):
    data = read_dataset(dataset)
    found = by_name(of_dataset(data))
    pool = RayDataset((data.read(i) for i in range(len(data.views))), data.cameras, Domain.around(np.zeros(3), np.ones(3)))
    assert found["Alpha"] == transparency("auto", pool.pixels, pool.alpha) and found["Alpha"].chosen
    for name in ("Backdrop", "NDC", "Equation 9", "Distortion", "Several intrinsics"):
        assert found[name].chosen is False, name
    for name in ("View dependence", "Transparency", "Visibility culling", "Samples a voxel", "Refining", "Lossy codec"):
        assert found[name].chosen == UNKNOWN and found[name].measured is None, name


def test_opaque_pictures_before_white_have_a_backdrop(dataset, tmp_path):
    shutil.copytree(dataset, tmp_path / "white")
    for path in (tmp_path / "white").rglob("*.png"):
        image = Image.open(path)
        Image.alpha_composite(Image.new("RGBA", image.size, "white"), image).convert("RGB").save(path)
    found = by_name(of_dataset(read_dataset(tmp_path / "white")))
    assert not found["Alpha"].chosen and found["Backdrop"].chosen and found["Backdrop"].measured > 0.5


def test_a_capture_that_looks_one_way(tmp_path):
    cameras = facing()
    found = by_name(of_dataset(read_dataset(write_llff(tmp_path, cameras, np.tile([2.0, 30.0], (len(cameras), 1))))))
    assert found["NDC"].chosen is True and found["Equation 9"].chosen == UNKNOWN


@pytest.mark.parametrize("lens", [LENS, FISHEYE])
def test_lenses_are_told_in_pixels(tmp_path, lens):
    cameras = ring(lens=lens)
    found = by_name(of_dataset(read_dataset(write_ngp(tmp_path, cameras))))
    camera = cameras[0]
    straight = replace(camera, distortion=None)
    corners = np.array([(0, 0), (camera.width - 1, 0), (0, camera.height - 1), (camera.width - 1, camera.height - 1)])
    origins, directions = camera.rays(corners)
    moved = np.linalg.norm(straight.project(origins + directions)[0] - corners - 0.5, axis=-1).max()
    assert found["Distortion"].chosen is True and moved < found["Distortion"].measured < 2 * moved


def test_a_field_says_what_its_training_decided():
    gain = Decision("View dependence", "deferred", "40 steps with it gain +1.20 dB.", 1.2, 0.1)
    alpha = Decision("Alpha", False, "The images have no alpha channel.", 0.0, 0.001)
    found = by_name(of_field(field(decisions=[gain.to_json(), alpha.to_json()], settings={"seed": 0})))
    assert found["View dependence"] == gain and found["Alpha"] == alpha
    assert found["Refining"].chosen == UNKNOWN and found["Visibility culling"].threshold == 0.01
    assert by_name(of_field(field("diffuse")))["Refining"].chosen is False


def test_a_field_that_was_imported_guesses_nothing():
    found = by_name(of_field(replace(field(), cameras=())))
    assert found["View dependence"].chosen == "deferred" and found["View dependence"].measured is None
    assert found["Alpha"].chosen == UNKNOWN and found["Visibility culling"].chosen is False and "Distortion" not in found


def test_a_matte_and_a_glossy_scene():
    matte, glossy = (of_scene(baked(make_snerg((31, 30, 33), diffuse=diffuse)), CodecSettings()) for diffuse in (True, False))
    assert by_name(matte)["View dependence"].chosen is False and by_name(matte)["Refining"].chosen is False
    assert by_name(glossy)["View dependence"].chosen is True and by_name(glossy)["Refining"].chosen == UNKNOWN
    snerg = make_snerg((31, 30, 33))
    assert file_size(snerg.cells.nbytes // 2) in glossy[0].costs


def test_a_scene_says_what_its_bake_measured():
    refined = {"psnr_before": 30.0, "psnr_after": 30.5, "gain_db": 0.5, "seconds": {"march": 3.0, "fit": 2.0}}
    trained = {"decisions": [Decision("View dependence", "deferred", "It gains.", 1.0, 0.1).to_json()]}
    effects = {e.decision.effect: e for e in of_scene(baked(make_snerg((31, 30, 33)), refine=refined, trained=trained))}
    cull, samples, refine = effects["Visibility culling"], effects["Samples a voxel"], effects["Refining"]
    assert cull.decision.measured == pytest.approx(0.25) and cull.costs.startswith("2 s of the bake") and "1.3 times" in cull.saves
    clear = effects["Transparency"].decision
    assert clear.chosen is False and clear.measured == 0.04 and "is 4 %" in clear.evidence and "10 voxels" in clear.evidence
    assert samples.decision.chosen == "2" and samples.decision.measured == pytest.approx(0.01) and "2 s of that" in samples.saves
    assert refine.decision.measured == 0.5 and refine.costs.startswith("5 s after")
    matte = baked(make_snerg((31, 30, 33), diffuse=True), fit=refined)
    fitted = {e.decision.effect: e for e in of_scene(matte)}["Refining"]
    assert fitted.decision.measured == 0.5 and "Voxels" in fitted.decision.evidence
    assert effects["View dependence"].decision.measured == 1.0 and "It gains." in effects["View dependence"].decision.evidence
    kept = {e.decision.effect: e for e in of_scene(baked(make_snerg((31, 30, 33)), seen=None))}
    assert kept["Visibility culling"].decision.chosen is False


def test_equation_9_is_told_with_what_decided_it():
    snerg = make_forward()
    snerg.about["bake"] = {"holes": {"with": 0.02, "without": 0.03}}
    found = by_name(of_scene(snerg))["Equation 9"]
    assert found.chosen is True and (found.measured, found.threshold) == (0.02, 0.03) and "0.02000" in found.evidence
    assert by_name(of_scene(make_forward()))["Equation 9"].chosen is True
    told = by_name(of_scene(replace(make_snerg((31, 30, 33)), opacity_correction=True, about={"bake": {"settings": {"fill_holes": True}}})))
    assert told["Equation 9"].overridden and by_name(of_scene(make_snerg((31, 30, 33))))["Equation 9"].chosen is False


def test_a_scene_that_says_nothing_of_its_bake():
    found = by_name(of_scene(make_snerg((31, 30, 33))))
    assert found["Visibility culling"].chosen == found["Samples a voxel"].chosen == found["Transparency"].chosen == UNKNOWN


def test_the_command_prints_a_table(dataset, tmp_path, capsys):
    write_scene(baked(make_snerg((31, 30, 33), fog=False)), tmp_path / "scene", codec=CodecSettings("jpeg", 80))
    assert cli.main(["effects", str(tmp_path / "scene")]) == 0
    out = capsys.readouterr().out
    assert "View dependence: yes." in out and "Lossy codec: jpeg, as the settings say." in out and "costs:" in out
    write_field(field(), tmp_path / "field")
    for path, kind in ((dataset, "dataset"), (tmp_path / "field", "field")):
        assert cli.main(["effects", str(path), "--json"]) == 0
        value = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert value["kind"] == kind and {"effect", "chosen", "evidence", "measured", "threshold", "costs", "saves"} <= set(
            value["effects"][0]
        )
    assert cli.main(["effects", str(tmp_path / "nothing")]) == 2


@pytest.mark.parametrize(
    ("name", "yes", "no"),
    [
        ("lego400", ("Alpha",), ("NDC", "Distortion", "Several intrinsics", "Backdrop")),
        ("fern", ("NDC",), ("Alpha", "Distortion")),
        ("fox", ("Distortion",), ("Alpha", "NDC")),
    ],
)
def test_real_captures(data, name, yes, no):
    found = by_name(of_dataset(read_dataset(data / name)))
    assert all(found[effect].chosen is True for effect in yes) and all(found[effect].chosen is False for effect in no)
