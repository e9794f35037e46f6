"""Fog so thin that it adds up over a thousand voxels: baked, stored and marched, against float64."""

import json
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from oracle import dense_march
from published_viewer import PublishedViewer
from scenes import looking, make_cameras, make_dataset, make_roots, snerg_from_volume
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.finish import Finishing, finish
from snerg.core.baking.fit_voxels import fit_voxels
from snerg.core.baking.prune import prune
from snerg.core.baking.thin_fog import MAX_GRAIN, fog_grain
from snerg.core.data.load import read_dataset
from snerg.core.errors import SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.reference import read_reference, write_reference
from snerg.core.export.scene_files import codec_of, is_current, read_scene, write_scene
from snerg.core.export.scene_json import scene_json
from snerg.core.export.vdb import blocks
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.model import ViewNetwork
from snerg.core.nerf.sampling import Domain
from snerg.core.rendering.early_termination import premultiplied_excess
from snerg.core.rendering.render import render_scene
from snerg.core.scene.blocks import block_coordinates, fill_aprons, number_blocks, pack_mask
from snerg.core.scene.coarse import coarse_scene
from snerg.core.scene.isosurface import isosurface
from snerg.core.scene.quantize import DITHER_ROOTS_BELOW, quantize_roots
from snerg.core.scene.scene import Scene
from snerg.core.scene.voxel_grid import VoxelGrid
from snerg.core.study.effects import of_scene

LENGTH = 1000  # voxels
VOXEL = 2 / LENGTH
SIDE = 24 * VOXEL  # of the tube of fog, across
BOX = Box.axis_aligned([-1, -SIDE / 2, -SIDE / 2], [1, SIDE / 2, SIDE / 2])


@dataclass(frozen=True, eq=False)
class Fog:
    """A tube of fog with that alpha a voxel, orange, and a solid green wall across it where there is one."""

    alpha: float
    wall: float | None = None  # where along x it begins
    network: ViewNetwork | None = None
    occupancy: None = None
    ndc: None = None
    view: str = "diffuse"
    params: dict = field(default_factory=dict)
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        density = np.full(len(points), -np.log1p(-self.alpha) / VOXEL)
        colour = np.tile(np.float32([0.8, 0.5, 0.2]), (len(points), 1))
        if self.wall is not None:
            inside = np.abs(points[:, 0] - self.wall - 0.02) < 0.02
            density[inside] = 3 / VOXEL
            colour[inside] = 0.1, 0.9, 0.3
        features = np.full((len(points), 4 if self.network is not None else 0), 0.25, np.float32)
        return density.astype(np.float32), colour, features

    def holds(self, x: np.ndarray) -> np.ndarray:
        return np.ones(len(x), bool)


def along(offset: tuple[float, float] = (0.3, -0.2)) -> Camera:
    """Nearly along the tube, parallel rays, 14 by 14 of them, 1.2 voxels apart."""
    eye = np.array([-1.5, offset[0] * VOXEL, offset[1] * VOXEL])
    return Camera(14, 14, (1 / (1.2 * VOXEL),) * 2, (7, 7), looking(eye, eye + np.array([3, 0.002, -0.003])), projection="orthographic")


def levels(scene: Scene, truth: Scene) -> float:
    """Root mean square difference of a scene's march over white and the float64 march of another, in levels of 255."""
    shown = render_scene(scene, along()).over((1, 1, 1))
    return 255 * float(np.sqrt(np.mean((shown - dense_march(truth, along()).over()) ** 2)))


def baked(fog: Fog, **settings: object) -> Scene:
    return bake(fog, BOX, (), BakeSettings(LENGTH, supersampling=1, **settings))


@pytest.mark.hard_case(78)
@pytest.mark.parametrize("alpha", [1e-4, 2e-4, 5e-4])
def test_thin_fog_is_off_by_less_than_half_a_level(alpha: float) -> None:
    exact, scene = baked(Fog(alpha), quantise=False), baked(Fog(alpha))
    assert scene.square_roots and scene.effects["thin_fog"] and scene.about["bake"]["thin_fog"]["grain"] > MAX_GRAIN
    assert np.allclose(exact.cells[..., -1].max(), alpha, rtol=1e-3)
    assert levels(scene, exact) < 0.5


@pytest.mark.hard_case(78)
@pytest.mark.parametrize("alpha", [1e-4, 5e-4, 0.03])
def test_the_grain_is_that_of_its_closed_form(alpha: float) -> None:
    """Of even fog in rows of known lengths: 1002 voxels along the tube and 26 across; of 12 levels and more none."""
    grid = VoxelGrid.inside(BOX, VOXEL)
    indirection = number_blocks(np.ones(grid.blocks, bool))
    inside = np.ones((len(block_coordinates(indirection)), 30, 30, 30), np.uint8)
    grid.zero_outside(inside, block_coordinates(indirection))
    found = fog_grain(Fog(alpha), grid, pack_mask(inside.astype(bool)), indirection, 0)
    part = 255 * alpha % 1
    rows = [part * (1 - part) * np.sum((1 - alpha) ** (2 * np.arange(n))) for n in grid.shape]
    held = np.array([26 / 30 * 26 / 30, 26 / 30, 26 / 30])  # the share of random rows of blocks that lie in the grid
    assert grid.shape == (1002, 26, 26)
    assert found == pytest.approx(2 / 3 * np.sqrt((held * rows).sum() / held.sum()), rel=0.1)
    assert fog_grain(Fog(12.5 / 255), grid, pack_mask(inside.astype(bool)), indirection, 0) == 0


@pytest.mark.hard_case(78)
def test_fog_before_and_behind_a_solid() -> None:
    fog = Fog(5e-4, wall=0.2)
    assert levels(baked(fog), baked(fog, quantise=False)) < 0.6


def test_a_scene_without_fog_carries_nothing_of_it() -> None:
    """Even levels, the format's version and keys as before; a wall at the end of a tube of nothing."""
    scene = baked(Fog(1e-12, wall=0.9))
    written = scene_json(scene)
    assert not scene.square_roots and set(scene.effects) == {"view_dependence", "ndc", "fill_holes"}
    assert written["version"] == 3 and "square_roots" not in written and "thin_fog" not in json.dumps(written)
    assert all(effect.decision.effect != "Thin fog" for effect in of_scene(scene))


@pytest.mark.hard_case(78)
@pytest.mark.parametrize("alpha", [1e-6, 3e-5, 4e-4, 0.02, 0.2])
def test_squares_have_the_values_mean(alpha: float) -> None:
    """Also of colours, whose straight value stays; where alpha is not dithered it is the nearest."""
    draw, count = np.random.default_rng(0), 400_000
    values = np.tile(np.float32([0.8 * alpha, 0.1 * alpha, 0.0, alpha]), (count, 1))
    stored = quantize_roots(values, draw.random(values.shape, np.float32)).astype(np.float64)
    got, error = (stored / 255) ** 2, 2 * 255 * np.sqrt(alpha) + 1
    assert (stored[:, :3] <= stored[:, 3:]).all()
    if alpha < (DITHER_ROOTS_BELOW / 255) ** 2:
        assert np.abs(got.mean(axis=0) - values[0]).max() < 4.5 * 0.5 * error / 255**2 / np.sqrt(count)
    assert np.abs(stored[:, 3] - 255 * np.sqrt(alpha)).max() <= 1


def test_golden_roots() -> None:
    """2.5 squares lie between those of 1 and 2, halfway; thick values take the nearer square; nothing has no colour."""
    square = 1 / 255**2
    assert quantize_roots(np.float32([[2.5, 2.5]]) * np.float32(square), np.float32([[0.4, 0.4]])).tolist() == [[2, 2]]
    assert quantize_roots(np.float32([[2.5, 2.5]]) * np.float32(square), np.float32([[0.4, 0.6]])).tolist() == [[1, 1]]
    assert quantize_roots(np.float32([[10.0, 20.0]]) * np.float32(square), np.float32([[0.1, 0.99]])).tolist() == [[3, 4]]  # 8 of 16
    thick = np.float32([[200**2 + 200, 210**2 + 211]]) * np.float32(square)
    assert quantize_roots(thick, np.float32([[0.0, 0.0]])).tolist() == [[200, 211]]
    assert quantize_roots(np.float32([[1.0, 1.0], [0.0, 0.0]]), np.zeros((2, 2), np.float32)).tolist() == [[255, 255], [0, 0]]
    assert quantize_roots(np.float32([[0.4, 0.4]]) * np.float32(square), np.float32([[0.0, 0.5]])).tolist() == [[0, 0]]


@pytest.mark.hard_case(34, 78)
@pytest.mark.parametrize("diffuse", [False, True], ids=["network", "diffuse"])
def test_roots_are_marched_as_float64_marches_their_squares(diffuse: bool) -> None:
    scene = make_roots((44, 40, 57), diffuse=diffuse, opacity_correction=diffuse, angles=(0.2, 0.3, 0.5))
    for camera in make_cameras(width=40, height=30)[:3]:
        frame, truth = render_scene(scene, camera), dense_march(scene, camera)
        decides = np.abs(truth.transmittance - 254 / 255) < 1e-5  # the network sets in there
        assert np.abs(frame.over((1, 1, 1)) - truth.over())[~decides].max() < 2e-4, camera.name
        assert np.abs(1 - frame.alpha - truth.transmittance).max() < 2e-4


def test_bounds_surfaces_and_volumes_know_the_squares() -> None:
    scene = make_roots((34, 30, 40))
    scene.cells[..., 0] = np.where(scene.cells[..., -1] > 0, np.minimum(scene.cells[..., -1].astype(int) + 9, 255), 0)  # above alpha
    even = replace(scene, cells=(scene.cells / np.float32(255)) ** 2, square_roots=False)
    assert premultiplied_excess(scene) == pytest.approx(premultiplied_excess(even), rel=1e-5) and premultiplied_excess(scene) > 1.5
    assert [len(part) for part in isosurface(scene)] == [len(part) for part in isosurface(even)]
    assert np.allclose(isosurface(scene)[0], isosurface(even)[0], atol=1e-5)
    for (_, density, colour), (_, density_even, colour_even) in zip(blocks(scene), blocks(even), strict=True):
        assert np.allclose(density, density_even, rtol=1e-4, atol=1e-6) and np.allclose(colour, colour_even, atol=1e-4)


def test_the_coarse_scene_is_as_thick() -> None:
    """Of fog of 4e-4, whose root is not whole, each coarse voxel within half a root of 1 - (1 - a)^4; it stays a scene of roots."""
    roots = np.random.default_rng(0).choice([5, 6], (120, 60, 60, 4)).astype(np.uint8)
    roots[..., :3] = np.minimum(roots[..., :3], roots[..., 3:])
    coarse = coarse_scene(snerg_from_volume(roots, None, grid_to_world=np.eye(4), voxel_size=0.01, square_roots=True))
    alpha = ((roots[..., 3] / 255.0) ** 2).reshape(30, 4, 15, 4, 15, 4).mean(axis=(1, 3, 5))
    assert coarse.square_roots
    assert np.abs(coarse.cells[0, 1:31, 1:16, 1:16, 3] - 255 * np.sqrt(1 - (1 - alpha) ** 4)).max() <= 0.501


@pytest.mark.parametrize("codec", ["png", "webp"])
def test_a_scene_of_roots_is_stored_as_it_is(tmp_path, codec: str) -> None:
    scene = make_roots((34, 30, 40))
    write_scene(scene, tmp_path / "scene", codec=CodecSettings(codec))
    back, value = read_scene(tmp_path / "scene"), json.loads((tmp_path / "scene" / "scene.json").read_text())
    assert back.square_roots and np.array_equal(back.cells, scene.cells) and is_current(tmp_path / "scene")
    assert value["version"] == 4 and value["square_roots"] is True and value["effects"]["thin_fog"] is True


@pytest.mark.parametrize(("key", "wrong"), [("square_roots", 1), ("square_roots", None), ("version", 5)])
def test_a_damaged_flag_and_a_later_version_are_named(tmp_path, key: str, wrong: object) -> None:
    write_scene(make_roots((34, 30, 40)), tmp_path / "scene")
    path = tmp_path / "scene" / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: wrong}))
    with pytest.raises(SnergError, match=key):
        read_scene(tmp_path / "scene")


def test_floats_are_no_roots() -> None:
    scene = make_roots((34, 30, 40))
    with pytest.raises(SnergError, match="square roots"):
        replace(scene, cells=scene.cells.astype(np.float32) / 255)


def test_features_stay_whole_and_that_is_said(tmp_path) -> None:
    said: list[str] = []
    scene = make_roots((34, 30, 40))
    write_scene(scene, tmp_path / "scene", lambda fraction, text: said.append(text), CodecSettings("png", half_features=True))
    assert np.array_equal(read_scene(tmp_path / "scene").cells, scene.cells) and not codec_of(tmp_path / "scene").half_features
    assert "Features are stored at the whole resolution: half of it holds none of thin fog." in said


def test_the_published_layout_has_even_levels_and_that_is_said(tmp_path) -> None:
    """Their mean is that of the squares, in voxels of any root; the published viewer shows what is solid."""
    said: list[str] = []
    scene = make_roots((74, 65, 95), diffuse=True)
    write_reference(scene, tmp_path / "out", None, lambda fraction, text: said.append(text))
    back = read_reference(tmp_path / "out")
    assert not back.square_roots and sum("grainy or missing" in text for text in said) == 1
    own = (slice(None), *(slice(1, -1),) * 3)
    values, got = (scene.cells[own] / 255.0) ** 2, back.cells[own] / 255.0
    for root in (3, 10, 20):
        here = scene.cells[own][..., -1] == root
        assert got[here][:, -1].mean() == pytest.approx(values[here][:, -1].mean(), abs=4.5 * 0.5 / 255 / np.sqrt(here.sum()))
    again = back.cells.copy()
    for _ in fill_aprons(again, back.indirection):
        pass
    assert np.array_equal(again, back.cells), "aprons are their neighbours' voxels"
    assert PublishedViewer(tmp_path / "out").params


def test_fog_is_neither_fitted_nor_pruned_and_that_is_said(tmp_path) -> None:
    """The network is fine-tuned as in any scene."""
    said: list[str] = []
    data = read_dataset(make_dataset(tmp_path / "data", train=6, test=1, size=24), "train")
    scene = make_roots((40, 36, 44))
    done, _ = finish(scene, data, Finishing(fit=True, prune=0.5), (1.0, 1.0, 1.0), lambda fraction, text: said.append(text))
    assert any("neither fitted nor pruned" in text for text in said)
    assert np.array_equal(done.cells, scene.cells) and done.square_roots and "gain_db" in done.about["refine"]
    assert "thin fog" in fit_voxels(scene, data)[1]["skipped"]
    even = replace(scene, cells=(scene.cells / np.float32(255)) ** 2, square_roots=False)
    kept, wanted = (prune(one, data, 1e-3)[1] for one in (scene, even))
    assert kept["voxels_after"] == pytest.approx(wanted["voxels_after"], rel=2e-3), "shares are of real alpha"


def test_the_effect_is_told() -> None:
    scene = replace(make_roots((34, 30, 40)), about={"bake": {"thin_fog": {"grain": 4.2}}})
    effect = next(effect for effect in of_scene(scene) if effect.decision.effect == "Thin fog")
    assert effect.decision.chosen is True and effect.decision.measured == 4.2 and "4.2 of 255" in effect.decision.evidence
