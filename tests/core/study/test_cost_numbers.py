"""The cost model's arithmetic on a probe whose numbers are chosen: each stage, memory and file against sums that are written out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from scenes import looking, random_network
from snerg.core.baking.bake import BakeSettings
from snerg.core.baking.finish import Finishing
from snerg.core.export.codecs import CodecSettings
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.model import ViewNetwork
from snerg.core.nerf.sampling import CELLS, Domain
from snerg.core.study.coefficients import Coefficients

pytest.importorskip("jax")
from snerg.core.study.cost_model import Estimate, estimate, over_png, ray_slowdown
from snerg.core.study.field_probe import FieldProbe, Rates, visibility_rays

BOX = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
HALF_BOX = Box.axis_aligned([-1, -1, -1], [0, 1, 1])
RATES = Rates(
    compile=3.0,
    block_voxel=2e-8,
    query=1e-6,
    visibility_view=0.02,
    visibility_ray=4e-6,
    sample=2e-6,
    kept_voxel=5e-7,
    preview_view=0.05,
    preview_ray=3e-6,
    acceleration_block=1e-4,
    preview_samples=8.0,
    preview_growth=0.4,
    visibility_samples=5.0,
    visibility_growth=0.3,
)
TABLE = Coefficients(
    occupancy_start=0.3,
    prefilter_factor=1.5,
    preview_factor=0.6,
    ray_overhead=6.0,
    sample_growth=0.1,
    process_bytes=500e6,
    refine_bytes=70e6,
    cell_copies=2.0,
    refine_seconds=2.5,
    refine_pixels=1e6,
    recorded_ray=2.0,
    fitted_ray=5.0,
    fit_seconds=7.0,
    fit_copies=6.0,
    fit_pixel_bytes=60.0,
)


@dataclass(frozen=True, eq=False)
class Known:
    """What the model asks of a field."""

    cameras: tuple[Camera, ...] = ()
    network: ViewNetwork | None = field(default_factory=random_network)
    dataset: str = "captured"
    occupancy: np.ndarray | None = None
    ndc: None = None
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))


def cameras(count: int = 3) -> tuple[Camera, ...]:
    poses = [looking((4 * np.cos(a), 4 * np.sin(a), 1.0), (0, 0, 0)) for a in range(count)]
    return tuple(Camera(100, 80, (150.0, 150.0), (50, 40), pose) for pose in poses)


@pytest.fixture(scope="module")
def probe() -> FieldProbe:
    """800 points, one for each of 100 voxels of side 0.1 in each octant; a half is held, a quarter seen; of finer voxels less."""
    draw = np.random.default_rng(0)
    points = draw.uniform(-1, 1, (800, 3))
    points = np.abs(points) * np.repeat(np.array(list(np.ndindex(2, 2, 2))) * 2 - 1, 100, axis=0)
    order = np.tile(np.arange(100), 8)
    shares = {0.1: (0.5, 0.25), 0.05: (0.4, 0.2), 0.025: (0.3, 0.1)}
    voxels = np.array(list(shares))
    held, kept = (np.stack([order < 100 * pair[i] for pair in shares.values()]) for i in (0, 1))
    occupancy = np.zeros((CELLS,) * 3, bool)
    occupancy[np.ix_(*[[61, 97]] * 3)] = True  # a cell in each block of a grid of 42 voxels
    known = Known(cameras(), occupancy=occupancy.reshape(-1))
    centres = np.array([[x, y, z] for x in (-0.8, -0.4, 0.4, 0.8) for y in (-0.5, 0.5) for z in (0.1,)])
    return FieldProbe(
        field=known,
        coarse=known,
        points=points,
        share=0.01,
        inside=order < 80,
        voxels=voxels,
        held=held,
        kept=kept,
        samples=(1, 2, 16),
        kept_bytes=np.array([2.5, 2.0, 1.0]),
        filled=(centres, 0.05),
        pilot=0.08,
        rates=RATES,
        seconds=1.0,
    )


def said(probe: FieldProbe, **settings: object) -> Estimate:
    return estimate(probe, BOX, BakeSettings(**{"voxel_size": 0.05, "supersampling": 2, **settings}), coefficients=TABLE)


def test_voxels_are_points_times_their_share(probe: FieldProbe) -> None:
    """A point stands for 0.01 of volume: 80 voxels of side 0.05; the share in a smaller box leans on the whole field's by eight points."""
    whole = said(probe)
    assert (whole.looked, whole.held, whole.kept) == pytest.approx((640 * 80, 320 * 80, 160 * 80), abs=1)
    fine = said(probe, voxel_size=0.025)
    assert (fine.looked, fine.held, fine.kept) == pytest.approx((640 * 640, 240 * 640, 80 * 640), abs=1)
    between = said(probe, voxel_size=0.1 / np.sqrt(2))  # half way by logarithm
    assert between.held == pytest.approx(800 * 0.45 * 0.01 / (0.1 / np.sqrt(2)) ** 3, abs=1)
    half = estimate(probe, HALF_BOX, BakeSettings(voxel_size=0.05, supersampling=2), coefficients=TABLE)
    assert half.held == pytest.approx(whole.held / 2, rel=0.01)
    corner = Box.axis_aligned([-1, -1, -1], [-0.5, -0.5, -0.5])
    inside = corner.contains(probe.points)
    share = (probe.held[1][inside].sum() + 8 * 0.4) / (inside.sum() + 8)
    small = estimate(probe, corner, BakeSettings(voxel_size=0.05), coefficients=TABLE)
    assert small.held == pytest.approx(inside.sum() * share * 80, abs=1)
    assert said(probe, visibility=False).kept == whole.held > whole.kept
    alone = replace(probe, field=replace(probe.field, cameras=()))
    assert said(alone).kept == whole.held


def test_the_samples_of_the_nearest_size_by_ratio(probe: FieldProbe) -> None:
    for voxel, samples in ((0.2, 1), (0.08, 1), (0.07, 2), (0.0354, 2), (0.0353, 16), (0.01, 16)):
        assert said(probe, voxel_size=voxel, supersampling=0).samples == samples
    assert said(probe, supersampling=5).samples == 5


def test_seconds_are_the_sum_of_their_parts(probe: FieldProbe) -> None:
    from snerg.core.baking.occupied_voxels import candidate_blocks
    from snerg.core.scene.voxel_grid import VoxelGrid

    found = said(probe)
    grid = VoxelGrid.inside(BOX, 0.05)
    candidates = int(candidate_blocks(probe.coarse, grid).sum())
    assert candidates == 8
    assert found.seconds["start"] == 3.0
    assert found.seconds["occupancy"] == pytest.approx(0.3 + 2e-8 * 8 * 27000 + 1e-6 * 51200)
    assert found.seconds["samples"] == 0
    assert found.seconds["prefilter"] == pytest.approx(1.5 * 12800 * (5e-7 + 2 * 2e-6))
    slow = (6 + 5.0 * (0.08 / 0.1) ** 0.4) / 11
    assert found.seconds["visibility"] == pytest.approx(3 * 0.02 + 4e-6 * slow * visibility_rays(probe.field, grid))
    assert said(probe, visibility=False).seconds["visibility"] == 0
    tried = said(probe, supersampling=0)  # 1 to 4 samples of the field's 2: 7 in all, at eight corners, and the field itself
    assert tried.seconds["samples"] == pytest.approx(2e-6 * 1000 * 8 * (4 + 8 * (1 + 2 + 4)))
    many = said(probe, voxel_size=0.025, supersampling=0)  # 16, and no more
    assert many.seconds["samples"] == pytest.approx(2e-6 * 1000 * 8 * (4 + 8 * (1 + 2 + 4 + 8 + 16)))
    assert found.bake == pytest.approx(sum(found.seconds[n] for n in ("start", "occupancy", "visibility", "samples", "prefilter")))
    assert found.finishing == pytest.approx(found.seconds["refine"]) and "prune" not in found.seconds


def test_a_ray_grows_by_its_samples_alone(probe: FieldProbe) -> None:
    assert ray_slowdown(8.0, 0.4, 1.0, TABLE) == 1
    assert ray_slowdown(8.0, 0.4, 2.0, TABLE) == pytest.approx((6 + 8 * 2**0.5) / 14)
    assert ray_slowdown(8.0, 0.4, 0.5, TABLE) == pytest.approx((6 + 8 * 2**-0.5) / 14)
    finer = 0.08 / 0.05
    ray = 3e-6 * (6 + 8 * finer**0.5) / 14
    found = said(probe)
    assert found.preview == pytest.approx(0.05 + 0.6 * 800 * 800 * ray) and found.tables == pytest.approx(1e-4 * found.blocks)
    small = estimate(probe, BOX, BakeSettings(voxel_size=0.05, supersampling=2), size=(40, 30), coefficients=TABLE)
    assert small.preview == pytest.approx(0.05 + 0.6 * 40 * 30 * ray)


def test_finishing_takes_its_rays_and_its_fixed_time(probe: FieldProbe) -> None:
    finer = 0.08 / 0.05
    ray, pixels, views = 3e-6 * (6 + 8 * finer**0.5) / 14, 3 * 8000, 3 * 0.05
    settings = BakeSettings(voxel_size=0.05, supersampling=2)
    done = estimate(probe, BOX, settings, Finishing(fit=True, prune=0.01), coefficients=TABLE).seconds
    assert done["prune"] == pytest.approx(views + 2.0 * ray * pixels)
    assert done["fit"] == pytest.approx(7.0 + views + (2.0 * pixels + 5.0 * 2 * pixels) * ray)
    refined = estimate(probe, BOX, settings, Finishing(), coefficients=TABLE).seconds
    assert refined["refine"] == pytest.approx(2.5 + views + 1e6 * ray)
    large = replace(probe, field=replace(probe.field, cameras=tuple(replace(c, width=4000, height=3000) for c in cameras())))
    many = estimate(large, BOX, settings, Finishing(fit=True, prune=0.01), coefficients=TABLE).seconds
    assert many["prune"] == pytest.approx(views + 2.0 * ray * 4e6)
    assert many["fit"] == pytest.approx(7.0 + views + (2.0 * 8e6 + 5.0 * 2.5e6 / 0.4) * ray)
    imported = replace(probe, field=replace(probe.field, dataset=""))
    assert not estimate(imported, BOX, settings, Finishing(fit=True), coefficients=TABLE).finishing


def test_bytes_are_those_of_kept_voxels_and_memory_those_of_the_greatest_stage(probe: FieldProbe) -> None:
    found = said(probe)
    assert found.megabytes == pytest.approx(12800 * 2.0 / 1e6)
    between = estimate(probe, BOX, BakeSettings(voxel_size=0.05**0.5 * 0.1**0.5), coefficients=TABLE)
    assert 1e6 * between.megabytes / between.kept == pytest.approx(2.25, rel=1e-3)
    atlas = found.blocks * 32**3 * 8
    assert found.blocks > 0 and found.peak_megabytes == pytest.approx((500e6 + 2.0 * atlas + 70e6) / 1e6)
    settings = BakeSettings(voxel_size=0.05, supersampling=2)
    fitted = estimate(probe, BOX, settings, Finishing(fit=True), coefficients=TABLE)
    fit = 2 * atlas + 8 * found.blocks * 32**3 + 6 * 4 * 8 * 12800 + 60 * 3 * 8000
    assert fitted.peak_megabytes == pytest.approx((500e6 + max(2.0 * atlas, fit)) / 1e6)
    diffuse = said(probe, network=False)
    assert diffuse.megabytes == pytest.approx(found.megabytes / 2)
    assert diffuse.peak_megabytes == pytest.approx((500e6 + 2.0 * atlas / 2) / 1e6), "a diffuse scene is not refined"
    floats = said(probe, quantise=False)
    assert floats.megabytes == pytest.approx(4 * atlas / 1e6) and floats.peak_megabytes == pytest.approx((570e6 + 8.0 * atlas) / 1e6)
    away = estimate(probe, Box.axis_aligned([3, 3, 3], [4, 4, 4]), BakeSettings(voxel_size=0.05), coefficients=TABLE)
    assert (away.blocks, away.kept, away.megabytes, away.tables) == (0, 0, 0, 0)


def test_golden_ratios_of_codecs() -> None:
    half = {name: CodecSettings(name, half_features=True) for name in ("png", "webp", "jxl")}
    assert [over_png(CodecSettings(name), 4) for name in ("png", "webp", "jxl", "jpeg")] == [1.0, 0.8, 0.72, 1.0]
    assert [over_png(CodecSettings(name), 8) for name in ("png", "webp", "jxl", "jpeg")] == pytest.approx([1.0, 0.87, 0.78, 1.0])
    assert [over_png(half[name], 8) for name in half] == pytest.approx([0.585, 0.485, 0.445])
    assert [over_png(half[name], 4) for name in half] == [1.0, 0.8, 0.72]
