"""Decisions are measured: each says what it saw, the settings override it, and what cannot be is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scenes import looking
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import SnergError
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.io.images import write_png
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig
from snerg.core.nerf.sampling import CELLS, Domain, cell_index
from snerg.core.training import decisions, view_dependence_test
from snerg.core.training.config import TrainSettings
from snerg.core.training.trainer import train


def camera(eye: tuple[float, float, float], target: tuple[float, float, float], projection: str = "perspective") -> Camera:
    return Camera(60, 40, (50.0, 50.0), (30.0, 20.0), looking(eye, target), projection)


def facing(spread: float = 0.5, projection: str = "perspective") -> list[Camera]:
    """Nine cameras on a wall, looking along +y."""
    return [camera((x, 0, z), (x, 10, z), projection) for x in (-spread, 0, spread) for z in (-spread, 0, spread)]


def around() -> list[Camera]:
    return [camera((4 * np.cos(a), 4 * np.sin(a), 1), (0, 0, 0)) for a in np.linspace(0, 6, 9)]


def bounds(near: float, far: float) -> np.ndarray:
    return np.tile([near, far], (9, 1)).astype(np.float64)


def test_alpha_is_used_where_there_is_any():
    pixels = np.full((1000, 4), 255, np.uint8)
    assert not decisions.transparency("auto", pixels, False).chosen
    pixels[:5, 3] = 10
    decision = decisions.transparency("auto", pixels, True)
    assert decision.chosen and decision.measured == pytest.approx(0.005) and "0.50 %" in decision.text()
    off = decisions.transparency("off", pixels, True)
    assert not off.chosen and off.overridden and "as the settings say" in off.text()
    with pytest.raises(SnergError, match="transparency"):
        decisions.transparency("on", pixels, False)


@pytest.mark.parametrize(
    ("cameras", "depths", "alpha", "chosen"),
    [
        (facing(), bounds(2, 20), False, True),
        (facing(), bounds(2, 3), False, False),  # not deep
        (facing(), None, False, False),  # nobody knows
        (facing(), bounds(2, 20), True, False),  # cut out
        (facing(projection="orthographic"), bounds(2, 20), False, False),
        (around(), bounds(2, 20), False, False),
    ],
)
def test_forward_facing_captures_are_told_from_others(cameras, depths, alpha, chosen):
    decision, ndc = decisions.forward_facing("auto", cameras, None, depths, alpha)
    assert decision.chosen is chosen and (ndc is not None) is chosen and decision.evidence


def test_points_tell_the_depth_where_bounds_do_not():
    draw = np.random.default_rng(0)
    points = np.stack([draw.uniform(-1, 1, 500), draw.uniform(2, 20, 500), draw.uniform(-1, 1, 500)], axis=-1)
    decision, ndc = decisions.forward_facing("auto", facing(), points, None, False)
    assert decision.chosen and ndc is not None and 1.7 < ndc.near < 2.1
    behind, none = decisions.forward_facing("auto", facing(), points - [0, 4, 0], None, False)
    assert not behind.chosen and none is None and "no plane" in behind.evidence


def test_settings_override_what_is_measured_but_not_what_is_possible():
    decision, ndc = decisions.forward_facing("off", facing(), None, bounds(2, 20), False)
    assert decision.overridden and not decision.chosen and ndc is None
    decision, ndc = decisions.forward_facing("on", facing(), None, bounds(2, 3), False)
    assert decision.overridden and decision.chosen and ndc is not None
    with pytest.raises(SnergError, match="surround"):
        decisions.forward_facing("on", around(), None, bounds(2, 20), False)


def test_the_domain_in_device_coordinates_holds_what_the_cameras_see():
    cameras = facing()
    _, ndc = decisions.forward_facing("auto", cameras, None, bounds(2, 1e6), False)
    assert ndc is not None
    domain, alive = decisions.seen_in_ndc(ndc, cameras)
    assert domain.world_box().corners()[:, 2].max() <= 1 + 1e-9
    draw = np.random.default_rng(1)
    for one in cameras:
        pixels = np.stack([draw.integers(0, one.width, 300), draw.integers(0, one.height, 300)], axis=-1)
        point, direction, _, far = ndc.rays(*one.rays(pixels), one.near)
        for share in (0.0, 0.3, 0.9):
            x = domain.from_world(point + share * far[:, None] * direction)
            inside = (np.abs(point[:, :2] + share * far[:, None] * direction[:, :2]) < decisions.WIDEST).all(axis=-1)
            assert alive[cell_index(x[inside])].all()
    assert not alive.all()


def test_disparity_is_for_rays_that_go_far():
    domain = Domain(np.zeros(3), 1.0, np.full(3, -1.0), np.full(3, 1.0))
    along = np.tile([1.0, 0, 0], (20, 1))
    inside = np.tile([-0.9, 0, 0], (20, 1))
    near = np.full(20, 0.05)
    assert decisions.disparity("auto", domain, inside, along, near, False).chosen
    assert not decisions.disparity("auto", domain, inside - [3, 0, 0], along, near, False).chosen
    assert not decisions.disparity("auto", domain, inside, along, near, True).chosen
    forced = decisions.disparity("linear", domain, inside, along, near, False)
    assert forced.overridden and not forced.chosen and forced.measured > decisions.RANGE
    assert not decisions.disparity("auto", domain, inside + np.array([0, 9, 0]), along, near, False).chosen


def test_the_size_of_a_pixel_is_that_at_the_middle_of_the_box(tmp_path):
    """A camera 4 from the middle of a box of 3: a pixel there is 4 / focal, and half the box is 1.5."""
    cameras = [camera((4, 0, 0), (0, 0, 0)), camera((0, 0, 4), (0, 0, 0))]
    for index in range(2):
        write_png(tmp_path / f"r_{index}.png", np.zeros((cameras[0].height, cameras[0].width, 4), np.uint8))
    write_transforms(tmp_path / "transforms.json", cameras, [f"r_{i}.png" for i in range(2)])
    views = replace(read_dataset(tmp_path), box=Box.axis_aligned([-1.5, -1, -1], [1.5, 1, 1]))
    assert decisions.pixel_size(views) == pytest.approx(4 / cameras[0].focal[0] / 1.5)


def test_how_much_of_the_way_may_hold_something():
    domain = Domain(np.zeros(3), 1.0, np.full(3, -1.0), np.full(3, 1.0))
    alive = np.zeros((CELLS,) * 3, bool)
    alive[: CELLS // 4] = True
    rays = np.tile([-3.0, 0.1, 0.1], (10, 1)), np.tile([1.0, 0, 0], (10, 1)), np.zeros(10)
    share = decisions.share_filled(domain, alive.reshape(-1), *rays)
    assert share == pytest.approx(0.25, abs=0.02)
    packed = decisions.sampling(TrainSettings(), domain, alive.reshape(-1), *rays)
    assert not packed.chosen and packed.measured == share and "25 %" in packed.evidence


def test_evenly_spaced_samples_are_enough_where_rays_have_a_short_way():
    """Rays go 2 through a cube and 0.2 through a slab, 256 and 26 times the final spacing."""
    cube = Domain(np.zeros(3), 1.0, np.full(3, -1.0), np.full(3, 1.0))
    slab = Domain(np.zeros(3), 1.0, np.array([-0.1, -1, -1]), np.array([0.1, 1, 1]))
    rays = np.tile([-3.0, 0.1, 0.1], (10, 1)), np.tile([1.0, 0, 0], (10, 1)), np.zeros(10)
    settings, alive = TrainSettings(sampler="hierarchical", coarse=64), np.ones(CELLS**3, bool)
    for domain, needed in ((cube, 256), (slab, 25.6)):
        decision = decisions.sampling(settings, domain, alive, *rays)
        assert decision.chosen is (needed > 64) and decision.measured == pytest.approx(needed) and not decision.overridden
    assert decisions.sampling(replace(settings, hierarchy="on"), slab, alive, *rays).chosen
    forced = decisions.sampling(replace(settings, hierarchy="off"), cube, alive, *rays)
    assert forced.overridden and not forced.chosen


def test_a_gain_must_exceed_its_doubt():
    draw = np.random.default_rng(0)
    errors = draw.exponential(0.01, 4000)
    assert view_dependence_test.judged(errors, errors * 0.95, 3).chosen == "deferred"
    assert view_dependence_test.judged(errors, errors * 0.999, 3).chosen == "diffuse"
    assert view_dependence_test.judged(errors, errors, 0).chosen == "diffuse"
    noisy = errors * draw.choice([0.02, 1.9], 4000)
    assert view_dependence_test.judged(errors, noisy, 3).chosen == "diffuse"  # 4 % better, but by chance
    assert view_dependence_test.judged(np.zeros(10), np.zeros(10), 3).chosen == "diffuse"


def test_few_views_are_set_aside_and_none_of_few():
    assert (
        not view_dependence_test.set_aside(11).any()
        and view_dependence_test.set_aside(12).sum() == 2
        and view_dependence_test.set_aside(100).sum() == 4
    )


def balls(folder: Path, gloss: float, size: int = 64) -> Path:
    """A scene in closed form: a checked ball on a plate, with a highlight of strength `gloss` or truly matte."""
    draw = np.random.default_rng(3)
    light = np.array([0.5, -0.4, 0.77])
    cameras = []
    for index in range(24):
        a, up = draw.uniform(0, 2 * np.pi), draw.uniform(0.2, 1.1)
        eye = 3.5 * np.array([np.cos(a) * np.cos(up), np.sin(a) * np.cos(up), np.sin(up)])
        one = Camera(size, size, (1.5 * size,) * 2, (size / 2,) * 2, looking(tuple(eye), (0, 0, 0)), name=str(index))
        origin, direction = one.rays()
        along = -(origin * direction).sum(axis=-1)
        square = along**2 - (origin**2).sum(axis=-1) + 0.49
        reach = along - np.sqrt(np.maximum(square, 0))
        plate = (-0.6 - origin[:, 2]) / direction[:, 2]
        flat = origin + plate[:, None] * direction
        ball = (square > 0) & (reach < np.where(np.hypot(*flat.T[:2]) < 1, plate, np.inf))
        point = np.where(ball[:, None], origin + reach[:, None] * direction, flat)
        normal = np.where(ball[:, None], point / 0.7, [0, 0, 1])
        base = np.where(np.floor(3 * point).sum(axis=-1) % 2 > 0, 0.65, 0.3)[:, None] * np.where(
            ball[:, None], [1, 0.5, 0.4], [0.8, 0.9, 1]
        )
        mirrored = direction - 2 * (direction * normal).sum(axis=-1, keepdims=True) * normal
        shine = gloss * ((mirrored @ light).clip(0, 1) ** 6)[:, None]
        colour = (base * (0.3 + 0.7 * (normal @ light).clip(0, 1))[:, None] + shine).clip(0, 1)
        alpha = ball | (np.hypot(*flat.T[:2]) < 1)
        pixels = np.concatenate([colour, alpha[:, None]], axis=-1) * 255
        write_png(folder / "train" / f"{index}.png", np.rint(pixels).astype(np.uint8).reshape(size, size, 4))
        cameras.append(one)
    box = Box.axis_aligned(np.full(3, -1.1), np.full(3, 1.1))
    write_transforms(folder / "transforms_train.json", cameras, [f"./train/{i}" for i in range(len(cameras))], box)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("gloss", "view"), [(0.0, "diffuse"), (0.5, "deferred")])
def test_a_matte_scene_trains_a_diffuse_field_and_a_shiny_one_does_not(tmp_path, gloss, view):
    family = HashModelConfig(HashGrid(levels=6, coarsest=8, finest=128, features=4, log2_size=15))
    settings = TrainSettings(family=family, samples=8192, spacing=2 / 128, seconds=None, steps=1500)
    field = train(read_dataset(balls(tmp_path / "scene", gloss)), settings, tmp_path / "field")
    (decision,) = [d for d in field.about["decisions"] if d["effect"] == view_dependence_test.EFFECT]
    assert field.view == decision["chosen"] == view, decision["evidence"]
    assert (field.network is None) is (view == "diffuse")


def test_the_real_captures(data):
    """LLFF's fern calls for device coordinates; the fox and Lego, seen from around, do not."""
    for name, wanted in (("fern", True), ("fox", False), ("lego400", False)):
        views = read_dataset(data / name)
        decision, _ = decisions.forward_facing("auto", views.cameras, views.points, views.bounds, name == "lego400")
        assert decision.chosen is wanted, decision.text()
