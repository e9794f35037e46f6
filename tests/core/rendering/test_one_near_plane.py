"""A camera in the middle of what it sees: every stage of the pipeline sees between the same two planes, which cross the view axis."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from oracle import dense_rays
from scenes import looking, snerg_from_volume
from snerg.core.baking.prune import shares
from snerg.core.baking.ray_samples import _view_samples
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig
from snerg.core.nerf.render import render_field
from snerg.core.nerf.sampling import Domain
from snerg.core.rendering.render import march_rays, render_scene
from snerg.core.scene.scene import Scene
from snerg.core.training.ray_dataset import RayDataset

POSE = looking((0.1, -0.3, 0.2), (0.1, 1.0, 0.4))
WIDE = Camera(20, 16, (7.0, 7.0), (10, 8), POSE, near=0.5, far=1.1)  # 55 degrees to each side: a plane is 1.7 times as far at the edge
CAMERAS = {
    "perspective": WIDE,
    "orthographic": replace(WIDE, focal=(9.0, 9.0), projection="orthographic"),
    "panorama": replace(WIDE, focal=panorama_focal(20, 10), height=10, centre=(10, 5), projection="equirectangular"),
}


def fog(near: float = 0.0) -> Scene:
    """Uneven thin fog 3 world units wide with the camera in it; no ray loses half of its light."""
    draw = np.random.default_rng(0)
    alpha = draw.integers(2, 7, (60, 60, 60, 1))
    values = np.concatenate([draw.integers(0, 256, (60, 60, 60, 3)) % (alpha + 1), alpha], axis=-1).astype(np.uint8)
    pose = np.eye(4)
    pose[:3, 3] = -1.5
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=0.05, near=near)


def planes(camera: Camera) -> tuple[NDArray[Any], NDArray[Any]]:
    """Where each pixel's ray meets both planes, from its pixel alone; of a panorama, spheres."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5 - camera.centre[0], np.arange(camera.height) + 0.5 - camera.centre[1])
    longer = (
        np.sqrt(1 + (x / camera.focal[0]) ** 2 + (y / camera.focal[1]) ** 2) if camera.projection == "perspective" else np.ones(x.shape)
    )
    return camera.near * longer.reshape(-1), camera.far * longer.reshape(-1)


def through(scene: Scene, camera: Camera) -> NDArray[Any]:
    """The light that passes between both planes and behind the scene's own near distance, by the plain float64 march, [N]."""
    near, far = planes(camera)
    return dense_rays(scene, *camera.rays(), np.maximum(near, scene.near), far=far)[1]


@pytest.mark.hard_case(42)
@pytest.mark.parametrize("name", CAMERAS)
def test_rays_of_training_and_pictures_lie_between_the_planes(name: str) -> None:
    """A panorama has none: its near and far are distances."""
    camera = CAMERAS[name]
    near, far = planes(camera)
    _, directions = camera.rays()
    assert np.allclose(camera.clip_distances(directions), (near, far), rtol=1e-9, atol=0)
    domain = Domain.around(np.full(3, -2.0), np.full(3, 2.0))
    pixels = np.zeros((camera.height, camera.width, 3), np.uint8)
    other = replace(camera, near=0.0, far=np.inf)
    rays = RayDataset([pixels, pixels], [other, camera], domain).rays(np.arange(2 * len(near)))
    assert np.allclose(rays[2] / domain.scale, np.concatenate([0 * near, near]), rtol=1e-9, atol=0)
    assert np.allclose(rays[3] / domain.scale, np.concatenate([np.full(len(far), np.inf), far]), rtol=1e-9, atol=0)
    scene = fog()
    assert np.abs(render_scene(scene, camera).alpha.reshape(-1) - (1 - through(scene, camera))).max() < 1e-5


@pytest.mark.hard_case(42)
def test_the_near_distance_of_a_scene_comes_back_and_hides(tmp_path) -> None:
    write_scene(fog(near=0.7), tmp_path / "scene")
    scene = read_scene(tmp_path / "scene")
    camera = replace(WIDE, near=0.0, far=np.inf)
    alpha = render_scene(scene, camera).alpha.reshape(-1)
    assert np.abs(alpha - (1 - through(fog(near=0.7), camera))).max() < 1e-5
    assert alpha.mean() < 0.8 * render_scene(fog(), camera).alpha.mean()


@pytest.mark.hard_case(42)
@pytest.mark.parametrize("near", [0.0, 0.9])
def test_voxels_are_fitted_and_pruned_by_what_pictures_show(near: float) -> None:
    """The shares of each ray's samples add up to its opacity between the planes."""
    scene, camera = fog(near), WIDE
    count = camera.width * camera.height
    image = np.stack([np.arange(count) % 256, np.arange(count) // 256], axis=-1).astype(np.uint8).reshape(camera.height, camera.width, 2)
    image = np.concatenate([image, np.zeros((camera.height, camera.width, 1), np.uint8)], axis=-1)
    views: Any = SimpleNamespace(cameras=(camera,), read=lambda view: image, mask=lambda view: None)
    samples = _view_samples(scene, views, 0, np.arange(count), lambda fraction, text: None)
    alpha = scene.cells.reshape(-1, 4)[:, -1] / np.float32(255)
    found = np.add.reduceat(shares(samples, alpha).sum(axis=1), samples.first[:-1])
    pixel = samples.pixels[:, 0] + 256 * samples.pixels[:, 1].astype(int)
    wanted = 1 - through(scene, camera)
    assert np.abs(found - wanted[pixel]).max() < 2e-3 and len(found) > 0.5 * count and wanted[pixel].max() > 0.1


@pytest.mark.hard_case(42)
def test_a_network_is_fine_tuned_on_what_pictures_show() -> None:
    pytest.importorskip("jax")
    from snerg.core.baking.fine_tune import _march_view

    scene, camera = fog(), WIDE
    image = np.zeros((camera.height, camera.width, 3), np.uint8)
    views: Any = SimpleNamespace(cameras=(camera,), read=lambda view: image, mask=lambda view: None)
    colour, *_ = _march_view(scene, views, 0, np.arange(camera.width * camera.height), (1.0, 1.0, 1.0))
    near, far = planes(camera)
    values, left, _ = dense_rays(scene, *camera.rays(), near, far=far)
    wanted = (values[:, :3] + left[:, None])[left <= 254 / 255]
    assert len(colour) == len(wanted) and np.abs(np.sort(colour.sum(axis=1)) - np.sort(wanted.sum(axis=1))).max() < 1e-4


@pytest.mark.hard_case(42)
def test_a_march_ends_where_it_is_told_to() -> None:
    scene, camera = fog(), WIDE
    near, far = planes(camera)
    origins, directions = camera.rays()
    assert np.abs(march_rays(scene, origins, directions, near=near, far=far).transmittance - through(scene, camera)).max() < 1e-5


class EvenFog(Field):
    """A black field of optical depth 1 a unit of its coordinates, everywhere in its domain."""

    def seen(self, x: NDArray[Any], directions: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        return np.ones(len(x), np.float32), np.zeros((len(x), 3), np.float32)


@pytest.mark.hard_case(42)
@pytest.mark.parametrize("name", CAMERAS)
def test_the_field_is_seen_between_the_planes(name: str) -> None:
    """The light that passes is that of the length between them, to a sample at each end."""
    camera, domain, spacing = CAMERAS[name], Domain.around(np.full(3, -4.0), np.full(3, 4.0)), 0.002
    field = EvenFog(HashModelConfig(HashGrid()), {}, None, domain, None, spacing, view="diffuse")
    near, far = planes(camera)
    wanted = -np.expm1(-(far - near) * domain.scale)
    assert np.abs(render_field(field, camera).alpha.reshape(-1) - wanted).max() < 2 * spacing and wanted.min() > 0.1
