"""Baking against fields whose values are known, and refining on what came out."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from scenes import looking, make_dataset, random_network
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.fine_tune import RefineSettings, march_training_views, refine
from snerg.core.baking.visibility_rays import MAX_RAYS, RAY_SPACING, ray_grid
from snerg.core.data.load import read_dataset
from snerg.core.errors import Cancelled, SnergError, needs_jax
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.geometry.distortion import Distortion
from snerg.core.geometry.ndc import Ndc
from snerg.core.io.files import folder_bytes
from snerg.core.nerf.field import Field
from snerg.core.nerf.model import HashModelConfig, ViewNetwork, view_residual
from snerg.core.nerf.sampling import Domain
from snerg.core.rendering.render import march_rays, render_scene
from snerg.core.scene.voxel_grid import VoxelGrid


@dataclass(frozen=True, eq=False)
class Ball:
    """A field by arithmetic: a ball of constant density, or of density by `shape`, coloured by place."""

    radius: float = 0.6
    density: float = 400.0
    network: ViewNetwork | None = None
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    occupancy: None = None
    ndc: Ndc | None = None
    view: str = "deferred"
    params: dict = field(default_factory=dict)
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        local = points - self.centre
        density = np.where(np.linalg.norm(local, axis=-1) < self.radius, self.density, 0).astype(np.float32)
        return density, np.clip(0.5 + 0.5 * local, 0, 1).astype(np.float32), np.full((len(points), 4), 0.25, np.float32)

    def holds(self, x: np.ndarray) -> np.ndarray:
        return np.ones(len(x), bool)


BOX = Box.axis_aligned([-1, -1, -1], [1, 1, 1])


def camera_at(eye, size=64, near=0.0) -> Camera:
    return Camera(size, size, (1.2 * size, 1.2 * size), (size / 2, size / 2), looking(eye, (0, 0, 0)), near=near)


def test_the_voxel_grid_covers_the_box_and_one_voxel_more():
    voxel_grid = VoxelGrid.inside(Box.axis_aligned([0, 0, 0], [2, 1, 0.5]), 2 / 64)
    assert voxel_grid.shape == (66, 34, 18)
    assert np.allclose(voxel_grid.voxel_centres(np.array([[1, 1, 1]]) - 0.5), 0)


@pytest.mark.hard_case(6, 39)
@pytest.mark.parametrize("angles", [(0, 0, 0), (0.5, 0.2, 0.3)])
def test_a_baked_ball_is_the_ball(angles):
    from scenes import rotation

    pose = np.eye(4)
    pose[:3, :3] = rotation(angles)
    scene = bake(Ball(), Box(pose, np.array([2.0, 1.6, 1.8])), (), BakeSettings(64, supersampling=8))
    frame = render_scene(scene, camera_at((0, -3.5, 0.5)))
    origins, directions = camera_at((0, -3.5, 0.5)).rays()
    closest = np.linalg.norm(np.cross(origins, directions), axis=-1).reshape(64, 64)
    assert (frame.alpha[closest < 0.55] > 0.99).all() and (frame.alpha[closest > 0.66] < 0.01).all()
    middle = frame.straight()[32, 32]
    assert middle[:3] == pytest.approx([0.5, 0.5 - 0.5 * 0.6, 0.55], abs=0.06)


@pytest.mark.hard_case(18, 52)
def test_fog_keeps_its_optical_depth():
    scene = bake(Ball(radius=0.6, density=0.5), BOX, (), BakeSettings(128, supersampling=4))
    frame = render_scene(scene, camera_at((0, -30, 0), size=9).resized(9, 9))
    assert frame.alpha[4, 4] == pytest.approx(-np.expm1(-0.5 * 1.2), abs=0.02)


@pytest.mark.hard_case(38)
def test_fog_is_as_thick_at_any_resolution():
    """Opacity is stored for a step of one voxel, and a step is one voxel long, across the grid and along it."""

    class Fog(Ball):
        def query(self, points):
            density = np.where(np.abs(points[:, 1]) < 0.5, 1.3, 0).astype(np.float32)
            return density, np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4), np.float32)

    camera = camera_at((0, -3, 0), 8).resized(8, 8)
    slant = -camera.rays()[1] @ camera.camera_to_world[:3, 2]
    closed = -np.expm1(-1.3 / slant).reshape(8, 8)
    for resolution in (20, 40, 110):
        frame = render_scene(bake(Fog(), BOX, (), BakeSettings(resolution, supersampling=8)), camera)
        assert np.abs(frame.alpha - closed)[2:6, 2:6].max() < 0.015, resolution


@dataclass(frozen=True, eq=False)
class Given(Field):
    """A field whose network gives just these two values, everywhere but for a small corner that is empty and colourless."""

    density: float = 400.0
    colour: float = 0.5

    @property
    def _compiled(self):
        def outputs(x):
            corner = (x > 0.5).all(axis=-1)
            return np.where(corner, self.density, 0).astype(np.float32), np.where(corner[:, None], self.colour, 0.5).repeat(3, axis=-1)

        return outputs


@pytest.mark.hard_case(47, 59)
@pytest.mark.parametrize(("values", "named"), [((np.nan, 0.5), "densities"), ((np.inf, 0.5), "densities"), ((400.0, np.nan), "colours")])
def test_a_block_that_is_not_finite_is_an_error(values, named):
    domain = Domain.around(np.full(3, -1.0), np.full(3, 1.0))
    with pytest.raises(SnergError, match=f"{named} that are not finite"):
        bake(Given(HashModelConfig(), {}, None, domain, None, 0.01, (), "", {}, None, "diffuse", *values), BOX, (), BakeSettings(64))


@pytest.mark.hard_case(50)
def test_coordinates_are_exact_to_a_thousandth_of_a_voxel():
    """In a grid as fine as there may be, far from the origin; half precision would be a seventh of a voxel off at 512."""
    from scenes import rotation

    centre = np.array([2e5, -1e5, 3e5])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation((0.4, -0.2, 0.7)), centre
    voxel_grid = VoxelGrid.inside(Box(pose, np.array([2.0, 1.6, 1.8])), 2 / 4096)
    domain = Domain.around(centre - 2, centre + 2)
    voxels = np.random.default_rng(0).integers(0, voxel_grid.shape, (1000, 3))
    found = domain.from_world(voxel_grid.voxel_centres(voxels))
    assert found.dtype == np.float32
    exact = ((voxels + 0.5 - np.array(voxel_grid.shape) / 2) * (2 / 4096)) @ pose[:3, :3].T / 2
    assert np.abs(found - exact).max() < 1e-3 * (2 / 4096) / 2


@pytest.mark.hard_case(44)
def test_a_sheet_of_one_voxel_is_found_wherever_it_lies():
    class Sheet(Ball):
        def query(self, points):
            density = np.where(np.abs(points[:, 0] - self.radius) < 1 / 60, 400.0, 0).astype(np.float32)
            return density, np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4), np.float32)

    for at in np.random.default_rng(0).uniform(-0.9, 0.9, 6):
        scene = bake(Sheet(radius=at), BOX, (), BakeSettings(60, supersampling=8))
        eye = (-4, 0, 0) if at < 0 else (4, 0, 0)
        frame = render_scene(scene, camera_at(eye, 16))
        assert frame.alpha[4:12, 4:12].min() > 0.5


def test_invisible_voxels_are_culled():
    eyes = [(3, 0, 0.2), (-3, 0, 0.1), (0, 3, 0), (0, -3, 0.3), (0.2, 0.1, 3), (0.3, 0, -3)]
    cameras = [camera_at(eye, 96) for eye in eyes]
    whole, seen = bake(Ball(), BOX, (), BakeSettings(90, supersampling=2)), bake(Ball(), BOX, cameras, BakeSettings(90, supersampling=2))
    occupied = [(s.cells[:, 1:-1, 1:-1, 1:-1, -1] > 0).sum() for s in (whole, seen)]
    assert occupied[1] < 0.6 * occupied[0]  # the inside is gone
    for camera in cameras:
        assert np.abs(render_scene(whole, camera).over() - render_scene(seen, camera).over()).max() < 3 / 255


@pytest.mark.hard_case(67)
@pytest.mark.parametrize("pixels", [1, 9, 40])
@pytest.mark.parametrize("kind", ["perspective", "orthographic", "equirectangular", "lens"])
def test_nothing_is_culled_that_lies_between_the_rays_of_small_pictures(pixels, kind):
    """What a camera of few pixels sees, one of many at the same place sees too: no voxel of that may go."""
    eyes = [(2.6, 0, 0.2), (-2.6, 0, 0.1), (0, 2.6, 0), (0, -2.6, 0.3), (0.2, 0.1, 2.6), (0.3, 0, -2.6)]
    cameras = [camera_at(eye, pixels) for eye in eyes]
    if kind == "orthographic":
        cameras = [replace(camera, projection=kind, focal=(pixels / 1.5,) * 2) for camera in cameras]
    elif kind == "equirectangular":
        cameras = [replace(camera, projection=kind, focal=panorama_focal(pixels, pixels)) for camera in cameras]
    elif kind == "lens":
        cameras = [replace(camera, distortion=Distortion("opencv", (0.05, 0.01, 0.002, -0.003))) for camera in cameras]
    resolution = 60
    whole = bake(Ball(), BOX, (), BakeSettings(resolution, supersampling=1))
    seen = bake(Ball(), BOX, cameras, BakeSettings(resolution, supersampling=1))
    counts = seen.about["bake"]["voxels"]
    assert counts["seen"] < 0.8 * counts["held"]  # the inside is gone
    for camera in cameras[::2]:
        large = camera.resized(150, 150)
        assert np.abs(render_scene(whole, large).alpha - render_scene(seen, large).alpha).max() < BakeSettings().visibility_threshold


def test_rays_of_visibility_are_cut_to_the_picture_and_to_what_there_is():
    box = Box.axis_aligned([-1, -1, -1], [1, 1, 1])
    near, far = (ray_grid(camera_at((0, -distance, 0), 100), box, 0.01, None) for distance in (4, 4000))
    assert 0.2 < near.count / far.count < 4 and far.count < MAX_RAYS  # not a picture of 1e11 pixels, of which the box takes few
    assert ray_grid(replace(camera_at((0, -4, 0)), camera_to_world=looking((0, -4, 0), (0, -8, 0))), box, 0.01, None).count == 0
    bent = replace(camera_at((0, -4000, 0), 100), distortion=Distortion("opencv", (0.05, 0.01, 0.002, -0.003)))
    assert ray_grid(bent, box, 0.01, None).count <= MAX_RAYS
    directions = np.concatenate([band[1] for band in ray_grid(camera_at((0, -4, 0), 100), box, 0.01, None).bands()])
    across = np.unique((directions[:, 0] / directions[:, 1] * 5).round(9))  # at depth 5, that of the face behind
    assert np.diff(across).max() <= RAY_SPACING * 0.01 + 1e-8 and across[-1] > 1 - 0.01 and across[0] < 0.01 - 1


@pytest.mark.hard_case(71)
@pytest.mark.parametrize("alpha", [1e-4, 2e-4, 1e-3])
def test_fog_that_adds_up_over_many_blocks_is_kept(alpha):
    """A row of a block is 0.3 % opaque at an opacity of 1e-4 a voxel, a row of a thousand voxels 10 %: it must not be called nothing."""

    class Fog(Ball):
        def query(self, points):
            return np.full(len(points), alpha * 20, np.float32), np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4))

    box = Box.axis_aligned([-25, -0.4, -0.4], [25, 0.4, 0.4])  # 1000 x 16 x 16 voxels of 0.05
    scene = bake(Fog(network=None), box, (), BakeSettings(1000, supersampling=1, network=False))
    assert "warning" not in scene.about["bake"] and scene.about["bake"]["opacity_lost_at_most"] < 0.005
    origins, directions = np.random.default_rng(0).uniform([-30, -0.3, -0.3], [-30, 0.3, 0.3], (400, 3)), np.tile([1.0, 0, 0], (400, 1))
    wanted = -np.expm1(1000 * -alpha)
    assert np.mean(1 - march_rays(scene, origins, directions).transmittance) == pytest.approx(wanted, abs=1.5 / 255)


def test_fog_that_is_left_out_is_not_called_nothing():
    class Fog(Ball):
        def query(self, points):
            return np.full(len(points), 0.006, np.float32), np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4))

    scene = bake(Fog(), BOX, (), BakeSettings(90, supersampling=1, network=False))
    assert "thin fog alone, at most 1.2 % opaque" in scene.about["bake"]["warning"]


@pytest.mark.hard_case(48)
def test_jitter_keeps_the_centroid_and_is_seeded():
    scene = bake(Ball(radius=0.5), BOX, (), BakeSettings(40, supersampling=16))
    again = bake(Ball(radius=0.5), BOX, (), BakeSettings(40, supersampling=16))
    assert np.array_equal(scene.cells, again.cells)
    own = scene.cells[:, 1:-1, 1:-1, 1:-1, -1].astype(np.float64)
    place = np.argwhere(scene.indirection >= 0)
    index = np.indices((30, 30, 30)).reshape(3, -1).T
    voxels = (place[:, None] * 30 + index + 0.5).reshape(-1, 3)
    centroid = (voxels * own.reshape(-1, 1)).sum(axis=0) / own.sum()
    assert np.abs(centroid - np.array(scene.shape) / 2).max() < 0.01


@pytest.mark.hard_case(49)
@pytest.mark.parametrize(("optical", "samples"), [(3.0, 4), (3.0, 16), (1e6, 16)])
def test_half_a_voxel_of_solid_stops_half_the_light(optical, samples):
    """Opacity is averaged, as the reference does: where a checkerboard fills half of each voxel, half is let through, however solid the
    rest; the mean density would stop nearly everything."""
    voxel = 2 / 20

    class Checkerboard(Ball):
        def query(self, points):
            full = np.floor(points / (voxel / 2) + 1e-4).astype(int).sum(axis=-1) % 2 == 1  # as voxels' centres are
            density = np.where(full, optical / voxel, 0).astype(np.float32)
            return density, np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4), np.float32)

    scene = bake(Checkerboard(), BOX, (), BakeSettings(20, supersampling=samples))
    opacity = scene.cells[0, 3:-15, 3:-15, 3:-15, -1] / 255
    mean_opacity, by_mean_density = (1 - np.exp(-optical)) / 2, 1 - np.exp(-optical / 2)
    assert opacity.mean() == pytest.approx(mean_opacity, abs=0.01) and by_mean_density > mean_opacity + 0.25


@pytest.mark.hard_case(57)
def test_an_empty_box_is_a_valid_scene_and_says_so():
    scene = bake(Ball(), Box.axis_aligned([0.7, 0.7, 0.7], [0.9, 0.9, 0.9]), (camera_at((3, 0, 0)),), BakeSettings(32))
    assert len(scene.cells) == 0 and "holds nothing" in scene.about["bake"]["warning"]
    assert not render_scene(scene, camera_at((3, 0, 0), 8)).alpha.any()


@pytest.mark.hard_case(36)
def test_a_floor_on_the_face_of_the_box_survives():
    class Floor(Ball):
        def query(self, points):
            density = np.where(points[:, 2] < -1 + 2 / 64, 400.0, 0).astype(np.float32)
            return density, np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4), np.float32)

    scene = bake(Floor(), BOX, (camera_at((0, 0, 3)),), BakeSettings(64, supersampling=2))
    assert render_scene(scene, camera_at((0, 0, 4), 16)).alpha[6:10, 6:10].min() > 0.7


def test_cancelled_between_batches():
    def stop(fraction: float, what: str) -> None:
        raise Cancelled("Stopped.")

    with pytest.raises(Cancelled):
        bake(Ball(), BOX, (), BakeSettings(32), stop)


@pytest.mark.parametrize("view", ["sample", "tiny"])
def test_view_dependence_in_every_sample_cannot_be_baked(view):
    with pytest.raises(SnergError, match=f"'{view}'.*deferred"):
        bake(Ball(view=view), BOX, (), BakeSettings(32))


def test_opacity_correction_is_on_where_asked_or_forward_facing():
    assert not bake(Ball(), BOX, (), BakeSettings(16)).opacity_correction
    assert bake(Ball(), BOX, (), BakeSettings(16, opacity_correction=True)).opacity_correction
    assert bake(Ball(ndc=Ndc(np.eye(4), (1.0, 1.0), 1.0)), BOX, (), BakeSettings(16)).opacity_correction


def test_a_field_without_features_is_baked():
    class Plain(Ball):
        def query(self, points):
            density, colour, features = super().query(points)
            return density, colour, features[:, :0]

    plain, ball = bake(Plain(view="diffuse"), BOX, (), BakeSettings(32)), bake(Ball(), BOX, (), BakeSettings(32))
    assert np.array_equal(plain.cells, ball.cells)


@pytest.mark.parametrize(
    "settings",
    [{"resolution": 0}, {"resolution": 10**6}, {"supersampling": -1}, {"supersampling": 65}, {"voxel_size": 0.0}, {"alpha_threshold": 0.0}],
)
def test_settings_that_make_no_sense(settings):
    with pytest.raises(SnergError):
        BakeSettings(**settings)


def test_settings_keep_their_names_in_files():
    settings = BakeSettings(96, supersampling=4, opacity_correction=True)
    assert settings.to_json()["samples"] == 4 and settings.to_json()["fill_holes"] is True
    assert BakeSettings.from_json(settings.to_json()) == settings
    with pytest.raises(TypeError):
        BakeSettings.from_json({"voxels": 96})


def test_a_box_without_volume():
    with pytest.raises(SnergError, match="sides"):
        Box.axis_aligned([0, 0, 0], [1, 0, 1])


def test_refining_gains_and_never_loses(tmp_path):
    dataset = read_dataset(make_dataset(tmp_path / "data"))
    ball = Ball(radius=0.9, network=random_network(3))
    scene = bake(ball, BOX, dataset.cameras, BakeSettings(40, supersampling=2))
    better, report = refine(scene, dataset, RefineSettings(batch=256, epochs=8))
    assert report["psnr_after"] > report["psnr_before"] + 0.5
    assert better.network is not None and not np.array_equal(better.network.weights_2, scene.network.weights_2)
    again, _ = refine(scene, dataset, RefineSettings(batch=256, epochs=8))
    assert np.array_equal(again.network.weights_0, better.network.weights_0)


def test_refining_keeps_the_frequencies_of_training_and_validates_on_whole_views(tmp_path):
    dataset = read_dataset(make_dataset(tmp_path / "data"))
    network = random_network(3)
    network = network._replace(weights_0=np.asarray(network.weights_0) * (np.arange(34) % 2 == 0)[:, None].astype(np.float32))
    scene = bake(Ball(radius=0.9, network=network), BOX, dataset.cameras, BakeSettings(40, supersampling=2))
    better, report = refine(scene, dataset, RefineSettings(batch=256, epochs=8))
    assert report["gain_db"] > 0.5 and better.network is not None
    kept = (better.network.weights_0 != 0).any(axis=1)
    assert np.array_equal(kept, np.arange(34) % 2 == 0)
    pixels = march_training_views(scene, dataset, RefineSettings(), lambda f, w: None)
    rays = dataset.cameras[5].rays()[1].astype(np.float32)  # the validation view of twelve
    own = (np.abs(pixels.view_directions[:, None] - rays).max(axis=-1) < 1e-6).any(axis=1)
    assert own[: pixels.validation].all() and not own[pixels.validation :].any() and pixels.validation > 100


@pytest.mark.hard_case(8, 43)
def test_targets_of_refining():
    """Masked pixels are left out; over another background the network, which is defined over white, has the same to make up for."""

    class Views:
        def __init__(self, mask, image):
            self.cameras, self.hidden, self.image = (camera_at((0, -3.5, 0.5), 16),), mask, image

        def read(self, index):
            return self.image

        def mask(self, index):
            return self.hidden

    scene = bake(Ball(radius=0.8, density=1.5, network=random_network(3)), BOX, (), BakeSettings(32))
    frame = render_scene(scene, camera_at((0, -3.5, 0.5), 16))
    mask = np.zeros((16, 16), bool)
    mask[4:9, 5:11] = True
    alpha = frame.alpha[..., None]
    for background in ((1.0, 1.0, 1.0), (0.0, 0.2, 1.0)):
        settings = RefineSettings(background=background)
        opaque = np.rint(frame.over(background) * 255).astype(np.uint8)
        cut_out = np.rint(np.concatenate([np.clip(frame.colour / np.maximum(alpha, 1e-6), 0, 1), alpha], axis=-1) * 255).astype(np.uint8)
        for image in (opaque, cut_out):
            whole = march_training_views(scene, Views(None, image), settings, lambda f, w: None)
            part = march_training_views(scene, Views(mask, image), settings, lambda f, w: None)
            assert len(part.colour) == 30 < len(whole.colour)
            final = whole.colour + view_residual(np, scene.network, whole.colour, whole.features, whole.view_directions)
            assert np.abs(np.clip(final, 0, 1) - np.clip(whole.target, 0, 1)).max() < 0.02


def test_a_missing_optax_is_an_error_that_says_what_to_install():
    with pytest.raises(SnergError, match="pip install optax"), needs_jax():
        raise ImportError("No module named 'optax'")


def test_a_diffuse_scene_is_not_refined(tmp_path):
    scene = bake(Ball(), BOX, (), BakeSettings(32, supersampling=1))
    same, report = refine(scene, read_dataset(make_dataset(tmp_path / "data")))
    assert same is scene and "diffuse" in report["skipped"] and scene.cells.shape[-1] == 4


def test_a_voxel_size_takes_the_place_of_the_resolution():
    box = Box.axis_aligned([-1, -1, -1], [1, 0.5, 0.2])
    by_size, by_count = bake(Ball(), box, (), BakeSettings(voxel_size=0.05)), bake(Ball(), box, (), BakeSettings(40))
    assert by_size.shape == by_count.shape == (42, 32, 26) and np.array_equal(by_size.cells, by_count.cells)
    with pytest.raises(SnergError, match=r"at least 0\.000488"):
        bake(Ball(), box, (), BakeSettings(voxel_size=1e-6))


@pytest.mark.hard_case(57)
def test_a_bake_that_does_not_fit_is_refused_with_what_does(monkeypatch):
    from snerg.core.baking import memory

    def fits(resolution: int) -> None:
        voxel_grid = VoxelGrid.inside(BOX, 2 / resolution)
        memory.check_memory(Ball(), BOX, voxel_grid, 8)

    monkeypatch.setattr(memory, "available_bytes", lambda: 2**30)
    with pytest.raises(SnergError, match=r"2000 voxels.*GB.*choose at most (\d+)") as told:
        fits(2000)
    most = int(str(told.value).split()[-1].rstrip("."))
    fits(most)
    with pytest.raises(SnergError):
        fits(most + 40)
    monkeypatch.setattr(memory, "available_bytes", lambda: 2**20)
    with pytest.raises(SnergError, match="close other programs"):
        fits(2000)


def test_the_estimate_of_blocks_is_near_what_is_baked():
    from snerg.core.baking.memory import count_blocks, occupied_points

    for resolution in (90, 200):
        voxel_grid = VoxelGrid.inside(BOX, 2 / resolution)
        found, baked = (
            count_blocks(occupied_points(Ball(), BOX), voxel_grid),
            len(bake(Ball(), BOX, (), BakeSettings(resolution, supersampling=1)).cells),
        )
        assert 0.9 * baked <= found <= 1.4 * baked


def test_this_machine_says_what_memory_it_has():
    from snerg.core.baking.memory import available_bytes

    free = available_bytes()
    assert free is None or 2**26 < free < 2**45


@pytest.mark.hard_case(52)
def test_opacity_that_adds_up_is_kept_and_the_rest_is_reported():
    """100 voxels just under a threshold of 0.005 are 39% opaque, at any voxel size; nothing of a ray's light is lost untold."""

    class Fog(Ball):
        def query(self, points):
            density = np.full(len(points), self.density, np.float32)
            return density, np.full((len(points), 3), 0.5, np.float32), np.zeros((len(points), 4), np.float32)

    camera = camera_at((0, -3, 0), 8).resized(8, 8)
    for opacity in (0.0045, 0.0009, 0.00005):  # of a voxel
        scene = bake(Fog(density=opacity * 50), BOX, (), BakeSettings(100, supersampling=1))
        closed = -np.expm1(-opacity * 100)
        got = render_scene(scene, camera).alpha[4, 4]
        assert got == pytest.approx(closed, abs=0.02 if opacity > 0.0005 else scene.about["bake"]["opacity_lost_at_most"])
        if opacity < 0.0005:
            assert len(scene.cells) == 0 and closed <= scene.about["bake"]["opacity_lost_at_most"] < 1.2 * closed


def test_supersampling_is_used_where_it_helps():
    """A pattern finer than a voxel needs several; a smooth one does not, and blurring it is no better."""

    class Rods(Ball):
        def query(self, points):
            inside = np.linalg.norm(points[:, :2] * 16 - np.round(points[:, :2] * 16), axis=-1) < 0.25
            return np.where(inside, 30.0, 0).astype(np.float32), *super().query(points)[1:]

    fine, smooth = (bake(field, BOX, (), BakeSettings(20)).about["bake"] for field in (Rods(), Ball(radius=5.0, density=3.0)))
    assert fine["samples"] > 1 and smooth["samples"] == 1
    errors = {line["samples"]: line["error"] for line in fine["samples_measured"]}
    assert errors[fine["samples"]] < 0.9 * errors[1]


def test_ablations():
    ball, cameras = Ball(network=random_network(3)), (camera_at((3, 0, 0)),)
    plain = bake(ball, BOX, cameras, BakeSettings(40, supersampling=2))
    whole = bake(ball, BOX, cameras, BakeSettings(40, supersampling=2, visibility=False))
    assert (whole.cells[..., -1] > 0).sum() > 1.3 * (plain.cells[..., -1] > 0).sum()
    exact = bake(ball, BOX, cameras, BakeSettings(40, supersampling=2, quantise=False))
    assert exact.cells.dtype == np.float32 and np.abs(exact.cells - plain.cells / np.float32(255)).max() < 1.01 / 255
    diffuse = bake(ball, BOX, cameras, BakeSettings(40, supersampling=2, network=False))
    assert diffuse.network is None and np.array_equal(diffuse.cells, plain.cells[..., [0, 1, 2, 7]])


def test_files_memory_and_time_follow_the_light(tmp_path):
    """A ray ends with its light: an opaque scene takes few samples and stores a shell; the same shape as fog takes and stores all of it."""
    cameras = tuple(camera_at(eye) for eye in ((4, 0, 0.5), (-4, 0, 0.5), (0, 4, 0), (0, -4, 0), (0.1, 0, 4), (0.1, 0, -4)))
    solid, fog = (bake(Ball(0.9, d), BOX, cameras, BakeSettings(160, supersampling=1)) for d in (4000.0, 0.5))
    clear, hard = fog.about["bake"]["light"], solid.about["bake"]["light"]
    assert hard["passes"] < 0.1 < 0.3 < clear["passes"] and hard["rays"] == pytest.approx(clear["rays"], rel=0.15)
    assert hard["voxels"] < 16 and clear["voxels"] > 40
    origins, directions = cameras[0].rays()
    samples = [march_rays(scene, origins, directions).samples for scene in (solid, fog)]
    assert 4 * samples[0] < samples[1]
    for name, scene in (("solid", solid), ("fog", fog)):
        write_scene(scene, tmp_path / name)
    assert 2 * folder_bytes(tmp_path / "solid") < folder_bytes(tmp_path / "fog") and len(solid.cells) < len(fog.cells)


@pytest.mark.hard_case(47, 59)
def test_weights_that_are_not_finite_are_named():
    with pytest.raises(SnergError, match="table_3"):
        bake(Ball(params={"table_3": np.array([0.0, np.nan])}), BOX, (), BakeSettings(32))
    bad = random_network()._replace(bias_1=np.full(16, np.nan, np.float32))
    with pytest.raises(SnergError, match=r"view\.bias_1"):
        bake(Ball(network=bad), BOX, (), BakeSettings(32))


@pytest.mark.hard_case(6)
def test_far_from_the_origin_the_bake_is_the_same():
    from scenes import rotation

    baked = []
    for at in (np.zeros(3), np.array([2e5, -1e5, 3e5])):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation((0.4, -0.2, 0.7)), at
        ball = Ball(centre=at, domain=Domain.around(at - 1, at + 1))
        baked.append(bake(ball, Box(pose, np.array([2.0, 1.6, 1.8])), (), BakeSettings(64, supersampling=2)))
    assert np.array_equal(baked[0].indirection, baked[1].indirection)
    assert (baked[0].cells != baked[1].cells).mean() < 1e-3


def test_blocks_are_looked_at_wherever_an_occupied_cell_reaches():
    """Against points, close together, of every occupied cell; in a box turned and shifted against the cells."""
    from scenes import rotation
    from snerg.core.baking.occupied_voxels import candidate_blocks

    draw = np.random.default_rng(0)
    occupied = np.zeros((128,) * 3, bool)
    occupied[tuple(draw.integers(20, 100, (40, 3)).T)] = True
    ball = Ball()
    object.__setattr__(ball, "occupancy", occupied.reshape(-1))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation((0.4, -0.2, 0.7)), (0.1, 0.0, -0.1)
    for resolution in (100, 1500):
        voxel_grid = VoxelGrid.inside(Box(pose, np.array([1.0, 1.2, 0.9])), 1.2 / resolution)
        found = candidate_blocks(ball, voxel_grid)
        points = ((np.argwhere(occupied)[:, None] + draw.random((40, 300, 3))) / 64 - 1).reshape(-1, 3)
        voxels = (points - voxel_grid.grid_to_world[:3, 3]) @ voxel_grid.grid_to_world[:3, :3] / voxel_grid.voxel_size
        voxels = voxels[((voxels >= 0) & (voxels < voxel_grid.shape)).all(axis=-1)]
        assert len(voxels) and found[tuple((voxels // 30).astype(int).T)].all() and found.mean() < 0.7
