"""Forward-facing scenes, laid out in normalised device coordinates: field, bake and march against the world itself."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from oracle import dense_march
from scenes import make_forward, make_forward_cameras, make_frame
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.nerf.field import Field
from snerg.core.nerf.model import HashModelConfig
from snerg.core.nerf.render import render_field
from snerg.core.nerf.sampling import Domain
from snerg.core.rendering.render import MarchSettings, render_scene

FRAME = make_frame()
NAMES = [camera.name for camera in make_forward_cameras(FRAME)]


@pytest.mark.hard_case(9, 33, 34)
@pytest.mark.parametrize("diffuse", [False, True])
@pytest.mark.parametrize("index", range(len(NAMES)), ids=NAMES)
def test_equals_the_dense_march(diffuse, index):
    scene = make_forward(diffuse)
    camera = make_forward_cameras(FRAME)[index]
    got, truth = render_scene(scene, camera), dense_march(scene, camera)
    assert got.alpha.max() > 0.5
    assert np.abs(1 - got.alpha - truth.transmittance).max() < 1e-4
    assert np.abs(got.over() - truth.over()).max() < 1e-4
    seen = (got.alpha > 0.01) & (truth.depth < 50 * FRAME.near)
    assert np.abs(got.depth[seen] / truth.depth[seen] - 1).max() < 1e-2


@pytest.mark.hard_case(33)
def test_skipping_changes_nothing():
    scene = make_forward()
    for camera in make_forward_cameras(FRAME):
        with_skip, without = render_scene(scene, camera), render_scene(scene, camera, MarchSettings(skip=False))
        assert np.abs(with_skip.colour - without.colour).max() < 1e-6


@pytest.mark.hard_case(9)
def test_rays_that_look_back_see_nothing():
    camera = make_forward_cameras(FRAME)[5]
    frame = render_scene(make_forward(), camera)
    back = (camera.rays()[1] @ FRAME.camera_to_world[:3, 2] >= 0).reshape(frame.alpha.shape)
    assert 0.1 < back.mean() < 0.9 and not frame.alpha[back].any() and np.isfinite(frame.colour).all()


@pytest.mark.hard_case(6)
def test_far_from_the_origin_and_at_any_size_is_the_same_picture():
    near = render_scene(make_forward(), make_forward_cameras(FRAME)[1])
    for scale, position in ((1.0, (1e6, -2e6, 1e6)), (1e4, (0.5, -1.0, 2.0))):
        far = render_scene(make_forward(scale=scale, position=position), make_forward_cameras(make_frame(scale, position))[1])
        assert np.abs(near.over() - far.over()).max() < 1 / 255


@dataclass(frozen=True, eq=False)
class Planes(Field):
    """Two chequered planes of the world: one with a window at a depth of 1.5 near, one behind it at 6 near."""

    def evaluate(self, x):
        front, back = (1 - 2 / depth for depth in (1.5, 6.0))
        world = self.ndc.to_world(self.domain.to_world(x))
        u, v, w = across(world, self.ndc).T
        window = np.abs(u) < 0.2
        solid = ((np.abs(x[:, 2] - front - 0.04) < 0.04) & ~window) | (np.abs(x[:, 2] - back - 0.04) < 0.04)
        return np.where(solid, 3000, 0).astype(np.float32), cheques(u, v, w)


def across(points, frame):
    """[N, 3] right, up and ahead of the frame's camera, in units of near."""
    return (points - frame.camera_to_world[:3, 3]) @ frame.camera_to_world[:3, :3] * [1, 1, -1] / frame.near


def cheques(u, v, w):
    dark = (np.floor(u) + np.floor(v)) % 2 > 0
    colour = np.where(dark[:, None], [0.8, 0.3, 0.1], [0.1, 0.4, 0.9]) * np.where(w > 3, 0.6, 1.0)[:, None]
    return colour.astype(np.float32)


def seen_in_the_world(camera, frame):
    """Colour over white [H, W, 3], distance [H, W], and where to look: away from edges and from the borders of the picture that
    the frame has. By intersecting planes, without NDC."""
    origins, directions = camera.rays()
    start, along = across(origins, frame), directions @ frame.camera_to_world[:3, :3] * [1, 1, -1]
    colour, distance = np.ones((len(origins), 3)), np.full(len(origins), np.inf)
    clear = np.ones(len(origins), bool)
    for depth in (6.0, 1.5):
        t = (depth - start[:, 2]) / along[:, 2]
        u, v, w = (start + t[:, None] * along).T
        window = (np.abs(u) < 0.2) & (depth < 3)
        inside = (np.abs(u) * frame.focal[0] < 0.97 * depth) & (np.abs(v) * frame.focal[1] < 0.97 * depth)
        colour[~window] = cheques(u, v, w)[~window]
        distance[~window] = t[~window] * frame.near
        edge = np.minimum(np.abs(u - np.rint(u)), np.abs(v - np.rint(v))) < 0.03 * depth
        if depth < 3:
            edge |= np.abs(np.abs(u) - 0.2) < 0.06
        clear = np.where(window, clear & ~edge, ~edge & inside)
    shape = camera.height, camera.width
    return colour.reshape(*shape, 3), distance.reshape(shape), clear.reshape(shape)


@pytest.fixture(scope="module")
def planes():
    field = Planes(HashModelConfig(), {}, None, Domain.around(np.full(3, -1.0), np.full(3, 1.0)), None, 2 / 512, ndc=FRAME)
    cameras, fine = make_forward_cameras(FRAME)[:2], make_forward_cameras(FRAME, 96, 72)[:2]
    return field, bake(field, field.domain.world_box(), fine, BakeSettings(128, supersampling=2)), cameras


@pytest.mark.parametrize("index", [0, 1])
@pytest.mark.parametrize("kind", ["field", "march", "oracle"])
def test_planes_of_the_world_are_where_they_are(planes, index, kind):
    field, scene, cameras = planes
    colour, distance, clear = seen_in_the_world(cameras[index], FRAME)
    got = {"field": lambda c: render_field(field, c), "march": lambda c: render_scene(scene, c), "oracle": lambda c: dense_march(scene, c)}
    frame = got[kind](cameras[index])
    assert clear.mean() > 0.3 and (distance[clear] > 4).any() and (distance[clear] < 3).any()
    assert np.abs(frame.over() - colour)[clear].max() < 0.03
    assert np.abs(frame.depth / distance - 1)[clear].max() < 0.06  # a voxel is a 25th of the distance to the plane behind


def test_invisible_voxels_are_culled(planes):
    field, seen, cameras = planes
    whole = bake(field, field.domain.world_box(), (), BakeSettings(128, supersampling=2))
    filled = [(s.cells[:, 1:-1, 1:-1, 1:-1, -1] > 0).sum() for s in (whole, seen)]
    assert filled[1] < 0.8 * filled[0]  # behind the front plane, but for its window
    whole = replace(whole, opacity_correction=seen.opacity_correction)  # it is measured where there are cameras
    for camera in cameras:
        assert np.abs(render_scene(whole, camera).over() - render_scene(seen, camera).over()).max() < 1e-3


def test_near_is_of_the_world(planes):
    _, scene, cameras = planes
    frame = render_scene(replace(scene, near=3 * FRAME.near), cameras[0])
    assert frame.depth[np.isfinite(frame.depth)].min() > 5 * FRAME.near


@dataclass(frozen=True, eq=False)
class Veil(Field):
    """A sheet across the view, in device coordinates: `thickness`, and density on [-1, 1]."""

    thickness: float = 0.01
    density: float = 3000.0

    def evaluate(self, x):
        inside = np.abs(x[:, 2] - 1 / 64) < self.thickness / 2  # about the centres of voxels, where a bake looks
        return np.where(inside, self.density, 0).astype(np.float32), np.full((len(x), 3), [0.2, 0.5, 0.7], np.float32)


@pytest.mark.hard_case(53)
@pytest.mark.parametrize(("thickness", "density", "wanted"), [(0.012, 3000.0, True), (0.5, 1.5, False)], ids=["a thin wall", "fog"])
def test_equation_9_is_taken_where_it_brings_rays_nearer_to_the_field(thickness, density, wanted):
    """A wall a third of a voxel thick lets light through once it is baked; fog lets it through as it should."""
    domain = Domain.around(np.full(3, -1.0), np.full(3, 1.0))
    field = Veil(HashModelConfig(), {}, None, domain, None, 2 / 512, ndc=FRAME, thickness=thickness, density=density)
    box, cameras = field.domain.world_box(), make_forward_cameras(FRAME)[:2]
    scene = bake(field, box, cameras, BakeSettings(64, supersampling=8))
    errors = scene.about["bake"]["holes"]
    assert scene.opacity_correction is wanted and (errors["with"] < errors["without"]) is wanted
    truth = render_field(field, cameras[0]).over()
    distance = {
        fill: np.abs(render_scene(replace(scene, opacity_correction=fill), cameras[0]).over() - truth).mean() for fill in (True, False)
    }
    assert distance[wanted] < 0.7 * distance[not wanted]
    assert bake(field, box, (), BakeSettings(64, supersampling=8)).opacity_correction  # without cameras, as in the paper
    assert bake(field, box, cameras, BakeSettings(64, supersampling=8, opacity_correction=not wanted)).opacity_correction is not wanted
