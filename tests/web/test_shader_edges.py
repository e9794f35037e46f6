"""What a page must not pass over: single faint voxels anywhere, borders of blocks, the last light, clip planes, rays along axes."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from oracle import dense_march
from scenes import looking, make_cameras, make_snerg, snerg_from_volume
from snerg.core.export.bundle import write_bundle
from snerg.core.geometry.camera import Camera
from snerg.core.scene.scene import Scene
from snerg.tests.core.rendering import test_thin_sheets as thin
from snerg.tests.web.conftest import opened, picture

Serve = Callable[[Path], str]
LEVEL = 1 / 255
MIDDLE = (0.0, 0.0, 0.0)


def scene_of(values: np.ndarray, **settings: object) -> Scene:
    """A diffuse scene of voxels a 20th long, its middle at the origin."""
    pose = np.eye(4)
    pose[:3, 3] = -np.array(values.shape[:3]) / 40
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=0.05, **settings)


def check(page: Page, folder: Path, serve: Serve, scene: Scene, cameras: list[Camera], most: float = 1.6 * LEVEL) -> None:
    """The page's pictures over black are those of the float64 march, in every pixel."""
    write_bundle(scene, cameras, folder)
    address = serve(folder)
    for index, camera in enumerate(cameras):
        assert opened(page, f"{address}?camera={index}&width={camera.width}&height={camera.height}&background=black") is None
        truth = dense_march(scene, camera)
        assert truth.colour.max() > 20 * LEVEL, "there is something to see"
        difference = np.abs(picture(page) - truth.over(MIDDLE))
        assert difference.max() < most, f"{camera.name or index}: {difference.max() / LEVEL:.1f} levels"


@pytest.mark.slow
@pytest.mark.hard_case(33, 34, 37)
def test_single_voxels_at_every_place_in_a_coarse_voxel_are_seen(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Faint ones, five voxels apart: at each place of the four along each axis, also beside the borders of coarse voxels and blocks."""
    values = np.zeros((64, 46, 36, 4), np.uint8)
    values[2::5, 3::5, 1::5] = (25, 25, 25, 25)
    around = [looking((0.9, -4.2, 1.1), MIDDLE), looking((-3.1, 2.2, -2.4), MIDDLE)]
    cameras = [Camera(140, 110, (150.0, 150.0), (70, 55), pose) for pose in around]
    cameras.append(Camera(140, 110, (38.0, 38.0), (70.3, 55.2), looking((0.4, -4, 0.2), MIDDLE), "orthographic"))
    check(page, tmp_path / "web", serve, scene_of(values), cameras)


@pytest.mark.slow
@pytest.mark.hard_case(33, 34)
def test_voxels_just_behind_a_blocks_border_are_seen(page: Page, tmp_path: Path, serve: Serve) -> None:
    """One on each side of each border of blocks, of which most are empty."""
    values = np.zeros((150, 40, 150, 4), np.uint8)
    draw = np.random.default_rng(0)
    for x, z in ((29, 30), (30, 75), (59, 119), (60, 15), (89, 60), (90, 140), (119, 29), (120, 90), (149, 59), (0, 0)):
        values[x, draw.integers(4, 36), z] = (90, 60, 30, 120)
    for x, y, z in draw.integers(0, values.shape[:3], (150, 3)):  # most cells hold few, far apart
        values[x, y, z] = (30, 60, 90, 120)
    cameras = [Camera(150, 120, (120.0, 120.0), (75, 60), looking(eye, MIDDLE)) for eye in ((1.0, -8.0, 2.0), (7.0, 3.0, -3.0))]
    check(page, tmp_path / "web", serve, scene_of(values), cameras)


@pytest.mark.hard_case(33)
@pytest.mark.parametrize("phase", [0.25, 0.5])
def test_a_thin_sheet_stops_as_much_light_wherever_it_is(page: Page, tmp_path: Path, serve: Serve, phase: float) -> None:
    """By the closed form of the marcher's test: samples keep their phase behind what is skipped. Red is stored as opaque as alpha."""
    camera = replace(thin.camera(phase), height=thin.COUNT, centre=(thin.COUNT / 2, thin.COUNT / 2))  # a page wants some height
    write_bundle(thin.sheets(), [camera], tmp_path / "web")
    assert opened(page, f"{serve(tmp_path / 'web')}?width={camera.width}&height={camera.height}&background=black&ui=none") is None
    middle = picture(page)[thin.COUNT // 2]
    assert np.abs(middle[:, 0] - thin.stopped(phase)).max() < 1.6 * LEVEL


@pytest.mark.hard_case(18, 35)
def test_a_ray_ends_with_its_light_and_not_before(page: Page, tmp_path: Path, serve: Serve) -> None:
    """White fog behind black fog: all that is missed is white. A quarter of a level may be."""
    values = np.zeros((160, 30, 30, 4), np.uint8)
    values[:80] = (0, 0, 0, 8)
    values[80:] = (200, 200, 200, 200)
    values[:, :8] = (0, 0, 0, 6)
    values[80:, :8] = (160, 160, 160, 160)
    camera = Camera(60, 60, (400.0, 400.0), (30, 30), looking((-14.0, 0.3, 0.2), MIDDLE))
    check(page, tmp_path / "web", serve, scene_of(values), [camera])


@pytest.mark.slow
@pytest.mark.hard_case(36, 42)
def test_clip_planes_cut_across_the_view(page: Page, tmp_path: Path, serve: Serve) -> None:
    """In fog, where each step more or less shows; wide, so that a sphere is another cut; the scene's own near plane is one."""
    values = np.zeros((60, 60, 40, 4), np.uint8)
    values[:] = (12, 9, 4, 12)
    pose = looking((0.1, -2.2, 0.3), (0.1, 2.0, 0.1))
    whole = Camera(120, 100, (60.0, 60.0), (60, 50), pose)
    flat = Camera(120, 100, (35.0, 35.0), (60, 50), pose, "orthographic")
    cameras = [replace(whole, near=1.5), replace(whole, far=2.6), replace(flat, near=1.5, far=2.6)]
    check(page, tmp_path / "clipped", serve, scene_of(values), cameras, 2.6 * LEVEL)
    check(page, tmp_path / "near", serve, scene_of(values, near=1.7), [whole], 2.6 * LEVEL)


@pytest.mark.hard_case(31, 32, 36)
def test_rays_along_the_axes_are_seen(page: Page, tmp_path: Path, serve: Serve) -> None:
    """A parallel camera along each axis: all but one component of each direction is 0."""
    values = np.zeros((60, 30, 45, 4), np.uint8)
    draw = np.random.default_rng(1)
    values[..., 3] = draw.integers(0, 12, values.shape[:3])
    values[..., :3] = values[..., 3:] // 2
    values[20:24, 10:14, 5:9] = (200, 90, 90, 200)
    eyes = [(4.0, 0, 0), (0, -4.0, 0), (0, 0, -4.0)]
    cameras = [Camera(90, 90, (27.0, 27.0), (45.2, 44.7), looking(eye, MIDDLE), "orthographic") for eye in eyes]
    check(page, tmp_path / "web", serve, scene_of(values), cameras, 2.6 * LEVEL)


@pytest.mark.slow
@pytest.mark.hard_case(43, 53)
@pytest.mark.parametrize("diffuse", [True, False], ids=["corrected", "network"])
def test_opacity_correction_and_the_network_over_black(page: Page, tmp_path: Path, serve: Serve, diffuse: bool) -> None:
    """Fog and surfaces, below, at and above the opacity from which a ray is opaque; light where nothing is would show on black alone."""
    scene = make_snerg((40, 45, 50), diffuse=diffuse, opacity_correction=diffuse)
    write_bundle(scene, make_cameras(), tmp_path / "web")
    address = serve(tmp_path / "web")
    for index in (0, 2):
        camera = make_cameras()[index]
        assert opened(page, f"{address}?camera={index}&width={camera.width}&height={camera.height}&background=black") is None
        difference = np.abs(picture(page) - dense_march(scene, camera).over(MIDDLE))
        assert difference.mean() < 0.5 * LEVEL and np.mean(difference.max(axis=-1) < 2 * LEVEL) > 0.999


SHADERS = """
window.shaders = [];
const source = WebGL2RenderingContext.prototype.shaderSource;
WebGL2RenderingContext.prototype.shaderSource = function (shader, text) {
  window.shaders.push([this.getShaderParameter(shader, this.SHADER_TYPE) === this.FRAGMENT_SHADER, text]);
  return source.call(this, shader, text);
};
"""


@pytest.mark.hard_case(41)
def test_every_shader_of_the_page_computes_in_high_precision(page: Page, tmp_path: Path, serve: Serve) -> None:
    """Of all that the page gives the card. In medium precision, which phones take at its word, a place past 1024 voxels is known to one
    voxel. Where nothing is said, whole numbers of a fragment shader are medium, and what textures give is low."""
    page.add_init_script(SHADERS)
    write_bundle(make_snerg((34, 30, 40)), make_cameras(), tmp_path / "web")
    assert opened(page, serve(tmp_path / "web") + "?width=80&height=60#quality=full") is None
    picture(page)
    page.evaluate("document.querySelector('snerg-viewer').viewer.pick([[40, 30]])")
    shaders = page.evaluate("window.shaders")
    assert sum(fragment for fragment, _ in shaders) >= 3, "the march, the copy, and what hides them"
    for fragment, text in shaders:
        code = re.sub(r"//[^\n]*|/\*.*?\*/", "", text, flags=re.DOTALL)
        stated = set(re.findall(r"precision\s+highp\s+(\w+)\s*;", code))
        assert not re.search(r"\b(mediump|lowp)\b", code), text
        used = set(re.findall(r"\buniform\s+([iu]?sampler\w+)", code))  # with `highp` between, it is said there
        if fragment:
            used |= {"float"} | ({"int"} if re.search(r"\b([iu]vec\d|int|uint)\b", code) else set())
        assert used <= stated, f"{used - stated} in:\n{text}"
