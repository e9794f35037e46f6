"""What is said beforehand against what then happens, on a field whose values are known. Seconds are checked for sense alone."""

from __future__ import annotations

import importlib
import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from scenes import looking, make_frame, make_snerg, random_network
from snerg.core import cli
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.finish import Finishing
from snerg.core.data.load import read_dataset
from snerg.core.errors import SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.ndc import Ndc
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, ViewNetwork
from snerg.core.nerf.sampling import CELLS, Domain, cell_centres, cell_index
from snerg.core.scene.blocks import block_coordinates
from snerg.core.scene.quantize import quantize, quantize_roots
from snerg.core.scene.voxel_grid import VoxelGrid
from snerg.core.training.config import TrainSettings

ROOT = Path(__file__).parents[3]
BOX = Box.axis_aligned([-1, -1, -1], [1, 1, 1])


def cells_of_ball() -> np.ndarray:
    return np.linalg.norm(cell_centres(CELLS), axis=-1) < 0.75


@dataclass(frozen=True, eq=False)
class Ball:
    """A field by arithmetic: a ball with a dense shell, and occupied cells round it."""

    density: float = 300.0
    network: ViewNetwork | None = field(default_factory=random_network)
    cameras: tuple[Camera, ...] = ()
    occupancy: np.ndarray = field(default_factory=cells_of_ball)
    ndc: Ndc | None = None
    view: str = "deferred"
    dataset: str = ""
    params: dict = field(default_factory=dict)
    family: HashModelConfig = HashModelConfig()
    about: dict = field(default_factory=dict)
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        density = np.where(np.linalg.norm(x, axis=-1) < 0.7, self.density, 0).astype(np.float32)
        return density, np.concatenate([np.clip(0.5 + 0.5 * x, 0, 1), np.full((len(x), 4), 0.25)], axis=-1).astype(np.float32)

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        density, values = self.evaluate(points.astype(np.float32))
        return np.where(self.holds(points.astype(np.float32)), density, 0), values[:, :3], values[:, 3:]

    def holds(self, x: np.ndarray) -> np.ndarray:
        return (np.abs(x) <= 1).all(axis=-1) & self.occupancy[cell_index(x.astype(np.float32))]


def around(count: int = 8) -> tuple[Camera, ...]:
    eyes = [(4 * np.cos(a), 4 * np.sin(a), 1.5 * (-1) ** i) for i, a in enumerate(np.linspace(0, 6, count))]
    return tuple(Camera(100, 100, (150.0, 150.0), (50, 50), looking(eye, (0, 0, 0))) for eye in eyes)


@pytest.fixture(scope="module")
def probed_and_told():
    pytest.importorskip("jax")
    from snerg.core.study.field_probe import probe_field

    told = []
    return probe_field(Ball(cameras=around()), progress=lambda *event: told.append(event)), told


@pytest.fixture(scope="module")
def probed(probed_and_told):
    return probed_and_told[0]


@pytest.mark.parametrize("resolution", [100, 180])
def test_what_is_counted_is_what_is_baked(probed, resolution):
    from snerg.core.study.cost_model import estimate

    settings = BakeSettings(resolution=resolution, supersampling=1)
    said, told = estimate(probed, BOX, settings), bake(probed.field, BOX, probed.field.cameras, settings).about["bake"]
    assert said.held == pytest.approx(told["voxels"]["held"], rel=0.1)
    assert said.kept == pytest.approx(told["voxels"]["seen"], rel=0.25) and said.kept < 0.9 * said.held  # the inside is seen by none
    assert said.blocks == pytest.approx(told["blocks"], rel=0.25)
    assert estimate(probed, BOX, replace(settings, visibility=False)).kept == said.held
    assert said.looked == pytest.approx(probed.field.occupancy.sum() * (resolution / CELLS) ** 3, rel=0.1)


@dataclass(frozen=True, eq=False)
class Textured(Ball):
    """A ball with colours and features that differ from voxel to voxel."""

    def evaluate(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        phase = np.asarray(x, np.float64) @ np.linspace(12, 79, 21).reshape(3, 7)
        noise = np.modf(np.sin(phase) * 43758.5)[0]
        return super().evaluate(x)[0], (0.5 + 0.05 * noise).astype(np.float32)


def test_bytes_of_some_blocks_are_those_of_all(tmp_path):
    from snerg.core.study.voxel_bytes import kept_voxel_bytes

    ball = Textured(density=3000.0)
    scene = bake(ball, BOX, (), BakeSettings(resolution=128, supersampling=1))
    write_scene(scene, tmp_path / "scene")
    blocks, grid = block_coordinates(scene.indirection), VoxelGrid.inside(BOX, 2 / 128)
    stored = sum(path.stat().st_size for path in (tmp_path / "scene").glob("[rf]*.png"))
    whole = stored / scene.about["bake"]["voxels"]["held"]
    assert 4 < whole < 9 and kept_voxel_bytes(ball, grid, blocks, quantize) == pytest.approx(whole, rel=0.1)
    assert kept_voxel_bytes(ball, grid, blocks[:0], quantize) == 8.0


@pytest.mark.parametrize("density, voxels, faint", [(300.0, 1024, False), (0.3, 1024, True), (0.06, 128, True), (0.3, 128, False)])
def test_faint_voxels_count_where_they_are_the_scene(density, voxels, faint):
    """Each voxel of such fog is below what a bake of objects keeps."""
    pytest.importorskip("jax")
    from snerg.core.study.field_probe import occupied_or_bordering, random_points

    ball = Ball(density=density)
    points, _ = random_points(ball, np.random.default_rng(0))
    held, _, found = occupied_or_bordering(ball, points, 2 / voxels)
    apart = np.abs(np.linalg.norm(points, axis=-1) - 0.7) > 4 / voxels
    assert found == faint and (held == (np.linalg.norm(points, axis=-1) < 0.7))[apart].all()


def test_bytes_of_faint_voxels_are_those_of_fog():
    from snerg.core.study.voxel_bytes import kept_voxel_bytes

    fog, grid = Textured(density=0.06, network=None), VoxelGrid.inside(BOX, 2 / 1024)
    blocks = np.array([[17, 17, 17]])
    assert kept_voxel_bytes(fog, grid, blocks, quantize_roots) == 4.0, "a bake of objects drops them: bytes as in memory"
    assert 0.5 < kept_voxel_bytes(fog, grid, blocks, quantize_roots, faint=True) < 2


def test_a_probe_says_what_it_does(probed_and_told):
    fractions, texts = zip(*probed_and_told[1], strict=True)
    assert list(fractions) == sorted(set(fractions)) and len(set(texts)) == len(texts) >= 5 and fractions[-1] < 1


def test_a_smaller_box_takes_less(probed):
    from snerg.core.study.cost_model import estimate

    whole = estimate(probed, BOX, BakeSettings(voxel_size=0.01))
    half = estimate(probed, Box.axis_aligned([-1, -1, -1], [0, 1, 1]), BakeSettings(voxel_size=0.01))
    assert half.held == pytest.approx(whole.held / 2, rel=0.1) and 0.4 < half.megabytes / whole.megabytes < 0.6
    assert 0.4 < half.blocks / whole.blocks < 0.75 and half.peak_megabytes < whole.peak_megabytes and half.bake < whole.bake
    away = estimate(probed, Box.axis_aligned([3, 3, 3], [4, 4, 4]), BakeSettings(voxel_size=0.01))
    assert away.kept == away.blocks == 0 and away.megabytes == 0


def test_what_is_left_out_is_not_counted(probed):
    from snerg.core.study.cost_model import estimate

    whole = estimate(probed, BOX, BakeSettings(resolution=200, supersampling=4))
    matte = estimate(probed, BOX, BakeSettings(resolution=200, supersampling=4, network=False))
    assert matte.megabytes == pytest.approx(whole.megabytes / 2) and matte.peak_megabytes < whole.peak_megabytes
    floats = estimate(probed, BOX, BakeSettings(resolution=200, supersampling=4, quantise=False))
    assert floats.peak_megabytes > whole.peak_megabytes
    assert estimate(probed, BOX, BakeSettings(resolution=200, supersampling=8)).bake > whole.bake
    assert 0.2 < estimate(probed, BOX, size=(400, 400)).preview / estimate(probed, BOX).preview < 0.4
    trained = replace(probed, field=replace(probed.field, dataset="photos"))
    refined, unrefined = (estimate(trained, BOX, finishing=Finishing(refine=refine)) for refine in (True, False))
    assert refined.peak_megabytes > unrefined.peak_megabytes and refined.seconds.keys() - unrefined.seconds.keys() == {"refine"}


def test_finishing_is_estimated_where_there_are_images(probed):
    from snerg.core.study.cost_model import estimate

    captured = replace(probed, field=replace(probed.field, dataset="captured"))
    stages = [
        (Finishing(), {"refine"}),
        (Finishing(fit=True), {"fit"}),
        (Finishing(prune=0.01), {"prune", "refine"}),
        (Finishing(refine=False), set()),
    ]
    plain = estimate(probed, BOX)
    for finishing, names in stages:
        found = estimate(captured, BOX, finishing=finishing)
        assert set(found.seconds) - set(plain.seconds) == names and found.bake == pytest.approx(plain.bake)
        assert found.finishing == pytest.approx(sum(found.seconds[name] for name in names))
        assert found.peak_megabytes >= plain.peak_megabytes
    assert estimate(captured, BOX, finishing=Finishing(fit=True)).finishing > estimate(captured, BOX).finishing
    assert not estimate(probed, BOX, finishing=Finishing(fit=True)).finishing


def test_a_codec_changes_the_bytes_alone(probed):
    from snerg.core.study.cost_model import estimate

    codecs = [CodecSettings(name, half_features=half) for name in ("png", "webp", "jxl") for half in (False, True)]
    found = [estimate(probed, BOX, codec=codec) for codec in codecs]
    png, png_half, webp, webp_half, jxl, jxl_half = (one.megabytes for one in found)
    assert jxl_half < webp_half < png_half < jxl < webp < png
    assert {(one.preview, one.peak_megabytes, one.bake) for one in found} == {(found[0].preview, found[0].peak_megabytes, found[0].bake)}
    diffuse = BakeSettings(network=False)
    assert estimate(probed, BOX, diffuse, codec=codecs[3]).megabytes == estimate(probed, BOX, diffuse, codec=codecs[2]).megabytes


def test_it_can_be_asked_while_a_box_is_dragged(probed):
    from snerg.core.study.cost_model import estimate

    took = []
    for side in (2, 1.9, 1, 0.5, 0.2, 0.05, 0.02):  # however small: then a cell of the field meets thousands of blocks
        for corner in ([-1, -1, -1], [0.6, 0, 0]):
            began = time.perf_counter()
            estimate(probed, Box.axis_aligned(corner, np.array(corner) + side))
            took.append(time.perf_counter() - began)
    assert np.median(took) < 0.1 and max(took) < 0.5  # half of it is what is wanted; the machine may be busy


def test_a_look_at_a_field_is_kept_as_long_as_the_field_is_the_same(probed, tmp_path):
    from snerg.core.study.cost_model import estimate
    from snerg.core.study.field_probe_file import check_field_probe, read_field_probe, stamp, write_field_probe

    folder, path = tmp_path / "field", tmp_path / "survey.npz"
    folder.mkdir()
    source = folder / "field.npz"
    source.write_bytes(b"a field")

    def read():
        return read_field_probe(path, stamp(folder), lambda: probed.field)

    check_field_probe(path)
    assert read() is None
    write_field_probe(path, probed, stamp(folder))
    check_field_probe(path)
    again = read()
    for box in (BOX, Box.axis_aligned([-1, -1, -1], [0, 1, 1])):
        assert estimate(again, box).to_json() == estimate(probed, box).to_json()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert read() is None
    path.write_bytes(whole)
    source.write_bytes(b"trained for longer")
    assert read() is None
    with pytest.raises(SnergError, match=r"field.npz is there already"):
        check_field_probe(source)


def test_a_folder_of_checkpoints_is_another_when_a_newer_one_is_there(tmp_path):
    from snerg.core.study.field_probe_file import stamp

    (tmp_path / "checkpoint_100").write_bytes(b"early")
    first = stamp(tmp_path)
    (tmp_path / "checkpoint_2000").write_bytes(b"much later")
    assert stamp(tmp_path) not in (first, stamp(tmp_path / "checkpoint_100")) and stamp(tmp_path) == stamp(tmp_path / "checkpoint_2000")


def test_a_length_is_none_in_device_coordinates(probed):
    from snerg.core.study.cost_model import estimate

    forward = replace(probed, field=replace(probed.field, ndc=make_frame()))
    with pytest.raises(SnergError, match="device coordinates"):
        estimate(forward, BOX, BakeSettings(voxel_size=0.1))


def test_a_training_is_so_many_steps(dataset):
    pytest.importorskip("jax")
    from snerg.core.study.training_cost import training

    data, small = read_dataset(dataset), HashModelConfig(HashGrid(2, 4, 8, 2, 8), 8)
    timed = training(data, TrainSettings(small, seconds=60.0))
    assert timed["seconds"] == 60 and timed["steps"] == pytest.approx(60 / timed["step_seconds"], rel=0.02)
    counted = training(data, TrainSettings(small, seconds=None, steps=100))
    assert counted["steps"] == 100 and counted["seconds"] > 0 and counted["peak_megabytes"] > 500


def test_an_empty_field_is_refused():
    pytest.importorskip("jax")
    from snerg.core.study.field_probe import probe_field

    with pytest.raises(SnergError, match="holds nothing"):
        probe_field(Ball(occupancy=np.zeros(CELLS**3, bool)))


def test_the_command(dataset, tmp_path, capsys):
    pytest.importorskip("jax")
    assert cli.main(["estimate", str(dataset), "--minutes", "1", "--json"]) == 0
    value = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert value["kind"] == "dataset" and value["seconds"] == 60 and value["steps"] > 0
    write_scene(make_snerg((31, 30, 33), diffuse=True), tmp_path / "scene")
    assert cli.main(["estimate", str(tmp_path / "scene")]) == 2
    assert "baked already" in capsys.readouterr().err
    assert cli.main(["estimate", str(dataset), "--codec", "jpeg"]) == 2
    assert "JPEG 90 is not estimated" in capsys.readouterr().err


def test_coefficients_are_found_again_from_what_they_estimate(probed, monkeypatch):
    from snerg.core.study.coefficients import Coefficients

    monkeypatch.syspath_prepend(ROOT / "bench")
    fit = importlib.import_module("fit")
    true = Coefficients(occupancy_start=0.3, prefilter_factor=1.4, preview_factor=0.6, process_bytes=500e6, cell_copies=2.0)
    measurements = []
    for resolution, samples in ((64, 1), (128, 4), (256, 2), (256, 0)):
        made = fit.Measurement(probed, BakeSettings(resolution=resolution, supersampling=samples), 0.0, 0.0, 0.0, None).estimate(true)
        seconds = made.seconds["start"] + made.seconds["occupancy"], made.seconds["prefilter"]
        settings = BakeSettings(resolution=resolution, supersampling=samples)
        measurements.append(fit.Measurement(probed, settings, *seconds, made.preview, made.peak_megabytes))
    found, counts = fit.fit(measurements)
    assert counts["preview_factor"] == 4 and counts["prefilter_factor"] == 3 and "ray_overhead" not in counts
    for name in vars(true):
        assert getattr(found, name) == pytest.approx(getattr(true, name), rel=1e-3), name
    assert f"`cell_copies` | {Coefficients().cell_copies:.3g} | 2 (4 rows)" in fit.fit_table(found, counts)
