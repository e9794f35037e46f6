"""The reference layout: the published viewer's images of our exports, round trips, and damaged folders."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from published_viewer import PublishedViewer
from scenes import empty_snerg, looking, make_forward, make_frame, make_snerg, rotation, snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.reference import read_indices, read_reference, write_reference
from snerg.core.export.reference_axes import reorient, viewer_axes
from snerg.core.export.reference_params import SNERG_KEY, read_params
from snerg.core.geometry.camera import Camera, focal_from_angle
from snerg.core.geometry.ndc import Ndc
from snerg.core.io.images import read_image
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene

FOV = 35.0


def centred_camera(pose: np.ndarray, width: int, height: int, near: float = 0.0, fov: float = FOV) -> Camera:
    focal = focal_from_angle(np.radians(fov), height, "test")
    return Camera(width, height, (focal, focal), (width / 2, height / 2), pose, near=near)


def camera_in_viewer(params: dict, camera_to_world: np.ndarray) -> np.ndarray:
    """The pose in the viewer's world of a camera with this pose in ours; M takes the viewer's directions to the network's axes."""
    ours = params[SNERG_KEY]
    axes = np.array(ours["view_rotation"]).T @ np.array(params["worldspace_T_opengl"])[:3, :3]
    size = np.array(ours["shape"]) * ours["voxel_size"]
    grid = np.array(ours["grid_to_world"])
    centre = grid[:3, 3] + grid[:3, :3] @ (size / 2)
    pose = np.eye(4)
    pose[:3, :3] = axes.T @ camera_to_world[:3, :3]
    pose[:3, 3] = axes.T @ (camera_to_world[:3, 3] - centre) * params["voxel_size"] / ours["voxel_size"]
    return pose


PLACES = {
    "upright": {},
    "oriented": {"angles": (0.2, -0.3, 0.9), "centre": (0.4, -0.2, 0.1)},
    "on its side": {"angles": (np.pi / 2, 0.1, 0.2), "centre": (0.0, 5.0, -3.0)},
    "upside down": {"angles": (np.pi, 0.1, 0.4)},
    "large and far": {"angles": (0.0, 0.0, 2.0), "centre": (1e4, -2e4, 5e3), "size": 300.0},
}


@pytest.mark.parametrize("diffuse", [False, True], ids=["network", "diffuse"])
@pytest.mark.parametrize("place", PLACES)
def test_the_published_viewer_shows_what_the_marcher_shows(tmp_path, place, diffuse):
    settings = {"size": 2.0, "centre": (0, 0, 0)} | PLACES[place]
    scene = make_snerg(fog=False, diffuse=diffuse, **settings)
    write_reference(scene, tmp_path / "out")
    viewer = PublishedViewer(tmp_path / "out")
    size, centre = settings["size"], np.array(settings["centre"])
    for eye in ((0.4, -1.6, 0.5), (-1.3, 0.9, -0.6)):
        camera = centred_camera(looking(tuple(centre + np.array(eye) * size), tuple(centre)), 128, 96)
        ours = render_scene(scene, camera).over()
        theirs = viewer.show(camera_in_viewer(viewer.params, camera.camera_to_world), (128, 96), FOV)
        difference = np.abs(ours - theirs) * 255
        assert ours.std() > 0.1
        # Behind empty blocks the viewer's samples are shifted, and it drops faint voxels: the sheet and the rims differ.
        assert difference.mean() < 2
        assert (difference.max(axis=-1) < 8).mean() > 0.88


FACING = np.diag([-1, 1, -1, 1])  # a forward-facing viewer's world to the frame's axes


def forward_camera(frame: Ndc, to_viewer: np.ndarray) -> Camera:
    """The camera in our world with the pose of a camera in the viewer's."""
    pose = FACING @ to_viewer
    pose[:3, 3] *= frame.near
    return centred_camera(frame.camera_to_world @ pose, 128, 96)


@pytest.mark.hard_case(9, 10)
@pytest.mark.parametrize("diffuse", [False, True], ids=["network", "diffuse"])
@pytest.mark.parametrize("angles", [(0, 0, 0), (0, np.pi / 2, 0), (np.pi / 2, np.pi, 0)])
def test_forward_facing_scenes_in_the_published_viewer(tmp_path, angles, diffuse):
    frame = make_frame()
    scene = make_snerg((44, 40, 57), diffuse, fog=False, angles=angles, size=1.4, ndc=frame)
    write_reference(scene, tmp_path / "out")
    viewer = PublishedViewer(tmp_path / "out")
    for eye in ((0.0, 0.0, -0.3), (0.12, -0.05, -0.25)):
        to_viewer = looking(eye, (0, 0, 0))
        to_viewer[:3, :3] = to_viewer[:3, :3] @ rotation((0, 0, np.arctan2(to_viewer[0, 1], to_viewer[1, 1])))  # y up, not z
        ours = render_scene(scene, forward_camera(frame, to_viewer)).over()
        assert ours.std() > 0.1
        exact = np.abs(ours - viewer.show(to_viewer, (128, 96), FOV, fault=False)) * 255
        assert exact.mean() < 3 and (exact.max(axis=-1) < 8).mean() > 0.88  # shifted samples behind empty blocks, as above
        assert np.abs(ours - viewer.show(to_viewer, (128, 96), FOV)).mean() * 255 < 20  # the viewer's perspective is slightly wrong


@pytest.mark.parametrize("diffuse", [False, True])
def test_forward_facing_round_trip_is_exact(tmp_path, diffuse):
    scene = make_snerg((44, 40, 57), diffuse, angles=(0, np.pi / 2, 0), size=1.4, ndc=make_frame(), near=0.2, opacity_correction=True)
    write_reference(scene, tmp_path / "out")
    back = read_reference(tmp_path / "out")
    same(back, Scene(**(vars(scene) | {"view_rotation": back.view_rotation})))
    assert np.allclose(back.view_rotation, scene.view_rotation, rtol=0, atol=1e-15)
    assert back.ndc is not None and back.ndc.to_json() == Ndc.from_json(make_frame().to_json()).to_json()


@pytest.mark.parametrize("published", [True, False])
def test_forward_facing_scenes_of_other_tools(tmp_path, published):
    """Without our key the frame looks along y with near at 1, and shows the same image from the same place."""
    frame = make_frame()
    scene = replace(make_snerg((44, 40, 60), size=1.4, ndc=frame), view_rotation=frame.camera_to_world[:3, :3].T)
    write_reference(scene, tmp_path / "out")
    path = tmp_path / "out" / "scene_params.json"
    params = json.loads(path.read_text())
    del params[SNERG_KEY]
    if published:
        params["worldspace_T_opengl"] = np.diag([1, 1, -1, 1]).tolist()
    path.write_text(json.dumps(params))
    back = read_reference(tmp_path / "out")
    assert back.ndc is not None and back.ndc.near == 1 and np.allclose(back.ndc.focal, frame.focal)
    to_viewer = np.diag([-1.0, 1, -1, 1])
    to_viewer[2, 3] = -0.2
    there, here = (render_scene(s, forward_camera(s.ndc, to_viewer)).over() for s in (back, scene))
    assert np.abs(there - here).max() < 1 / 255


def test_a_turned_forward_facing_box_is_refused(tmp_path):
    with pytest.raises(SnergError, match="box is turned"):
        write_reference(make_forward(), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_viewer_opens_at_blenders_front_view(tmp_path):
    """From (0, 1, -4) it sees +x on the right and +z at the top; for a box in the world's axes, M is that of the published Lego."""
    write_reference(make_snerg(), tmp_path / "out")
    params = json.loads((tmp_path / "out" / "scene_params.json").read_text())
    axes = np.array(params[SNERG_KEY]["view_rotation"]).T @ np.array(params["worldspace_T_opengl"])[:3, :3]
    assert np.allclose(axes, [[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    for name, cells in zip("xyz", (-(-74 // 30) * 30, 95, 65), strict=True):
        assert params["grid_" + {"x": "width", "y": "height", "z": "depth"}[name]] == cells


@pytest.mark.parametrize("angles", [(np.pi / 2, 0, 0), (np.pi, 0, 0), (0, -np.pi / 2, 0.3), (0.3, 0.2, 3.0), (0, 0, 0.7)])
def test_any_box_is_shown_the_right_way_up(angles):
    axes = rotation(angles) @ viewer_axes(rotation(angles))
    assert np.linalg.det(axes) == pytest.approx(1)
    assert axes[2, 1] > 0.9  # the viewer's y is nearly the world's z


def same(a: Scene, b: Scene) -> None:
    assert np.array_equal(a.grid_to_world, b.grid_to_world) and np.array_equal(a.view_rotation, b.view_rotation)
    assert (a.voxel_size, a.shape, a.near, a.about, a.effects) == (b.voxel_size, b.shape, b.near, b.about, b.effects)
    assert np.array_equal(a.indirection, b.indirection) and np.array_equal(a.cells, b.cells)
    assert (a.network is None) == (b.network is None)
    for x, y in zip(a.network or (), b.network or (), strict=True):
        assert np.array_equal(x, y)


@pytest.mark.hard_case(6)
@pytest.mark.parametrize("diffuse", [False, True])
@pytest.mark.parametrize("place", PLACES)
def test_round_trip_is_exact(tmp_path, place, diffuse):
    scene = make_snerg(diffuse=diffuse, near=0.2, **PLACES[place])
    write_reference(scene, tmp_path / "out")
    back = read_reference(tmp_path / "out")
    assert np.allclose(back.view_rotation, scene.view_rotation, rtol=0, atol=1e-15)
    same(back, Scene(**(vars(scene) | {"view_rotation": back.view_rotation})))


@pytest.mark.hard_case(57)
def test_an_empty_scene_round_trips(tmp_path):
    write_reference(empty_snerg(), tmp_path / "out")
    back = read_reference(tmp_path / "out")
    assert (back.indirection == -1).all() and len(back.cells) == 0
    viewer = PublishedViewer(tmp_path / "out")
    assert (viewer.show(looking((0, -4, 1), (0, 0, 0)), (16, 12), FOV) == 1).all()


def test_without_our_key_the_matrix_places_a_scene(tmp_path):
    scene = Scene(**(vars(make_snerg(centre=(0.5, 0.2, -0.1))) | {"view_rotation": np.eye(3)}))
    write_reference(scene, tmp_path / "out")
    change(tmp_path / "out", lambda params: params.pop(SNERG_KEY))
    back = read_reference(tmp_path / "out")
    camera = centred_camera(looking((2.6, -3.0, 1.5), (0.5, 0.2, -0.1)), 96, 72)
    assert np.abs(render_scene(back, camera).over() - render_scene(scene, camera).over()).mean() < 1e-3


def test_reorienting_changes_no_image():
    scene = make_snerg((31, 30, 47), fog=True)
    camera = centred_camera(looking((2.2, -3.0, 1.9), (0, 0, 0)), 80, 60)
    picture = render_scene(scene, camera).over()
    for angles in ((0, 0, np.pi / 2), (np.pi / 2, 0, 0), (np.pi, 0, np.pi / 2)):
        turned = reorient(scene, np.rint(rotation(angles)).astype(int))
        # A reversed axis is longer by its padding, which shifts the samples of rays that enter there; other rays agree.
        assert np.abs(render_scene(turned, camera).over() - picture).mean() < 0.02
        assert (turned.indirection >= 0).sum() == (scene.indirection >= 0).sum()


def test_records_the_camera(tmp_path):
    camera = Camera(640, 480, (500.0, 500.0), (320, 240), looking((0, -3, 0), (0, 0, 0)))
    write_reference(make_snerg((20, 20, 20)), tmp_path / "out", camera)
    params = json.loads((tmp_path / "out" / "scene_params.json").read_text())
    assert (params["input_width"], params["input_height"], params["input_focal"]) == (640, 480, 500)


def test_index_is_packed_as_the_reference_packs(tmp_path):
    """Blocks in x, y, z order with z fastest; cell i at (i % bx, i // bx % by, ...)."""
    values = np.full((61, 95, 40, 4), 9, np.uint8)
    write_reference(snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.02), tmp_path / "out")
    params = json.loads((tmp_path / "out" / "scene_params.json").read_text())
    viewer = PublishedViewer(tmp_path / "out")
    bx, by = params["atlas_blocks_x"], params["atlas_blocks_y"]
    number = viewer.index @ [1, bx, bx * by]
    assert np.array_equal(number.reshape(-1), np.arange(number.size))


@pytest.mark.hard_case(54)
@pytest.mark.parametrize(("blocks", "fits"), [(1, True), (254, True), (255, False), (256, False)])
def test_more_blocks_than_the_viewer_holds_are_refused(tmp_path, blocks, fits):
    values = np.zeros((30 * blocks, 4, 4, 4), np.uint8)
    values[-2:] = 200
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.001)
    if not fits:
        with pytest.raises(SnergError, match="lower resolution"):
            write_reference(scene, tmp_path / "out")
        assert not list(tmp_path.iterdir())
        return
    write_reference(scene, tmp_path / "out")
    same(read_reference(tmp_path / "out"), scene)


def change(folder, edit) -> None:
    path = folder / "scene_params.json"
    params = json.loads(path.read_text())
    edit(params)
    path.write_text(json.dumps(params))


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene") / "out"
    write_reference(make_snerg((40, 33, 30)), folder)
    return folder


def set_to(key, value):
    return lambda params: params.update({key: value})


MIRROR = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
DAMAGE = {
    "no voxel size": (lambda p: p.pop("voxel_size"), "not a scene"),
    "no grid width": (lambda p: p.pop("grid_width"), "grid_width"),
    "no weights": (lambda p: p.pop("1_weights"), "1_weights"),
    "NaN weights": (lambda p: p["1_weights"][3].__setitem__(2, float("nan")), "1_weights"),
    "short bias": (lambda p: p["2_bias"].pop(), "2_bias"),
    "a frame without focal length": (lambda p: p.update(ndc=True, input_focal=0.0), "input_focal is 0"),
    "a mirrored viewer": (lambda p: p.update(ndc=True, worldspace_T_opengl=np.diag([-1, 1, 1, 1]).tolist()), "mirrors"),
    "another format": (set_to("format", "jpeg"), "jpeg"),
    "another block size": (set_to("block_size", 32), "32"),
    "infinite voxels": (set_to("voxel_size", float("inf")), "voxel_size"),
    "negative voxels": (set_to("voxel_size", -1), "voxel_size"),
    "text for a number": (set_to("min_x", "left"), "left"),
    "half a voxel": (set_to("grid_width", 40.5), "grid_width"),
    "enormous": (set_to("grid_width", 10**9), "grid_width"),
    "enormous atlas": (set_to("atlas_blocks_x", 10**6), "atlas_blocks_x"),
    "atlas of another size": (set_to("atlas_height", 31), "atlas_height"),
    "missing slices": (set_to("num_slices", 1), "num_slices"),
    "mirrored": (set_to("worldspace_T_opengl", MIRROR), "mirrors"),
    "scaled": (set_to("worldspace_T_opengl", (2 * np.eye(4)).tolist()), "scales"),
    "no matrix": (set_to("worldspace_T_opengl", [[1, 0], [0, 1]]), "4 x 4"),
    "our key damaged": (lambda p: p[SNERG_KEY].pop("shape"), SNERG_KEY),
    "our key of another grid": (lambda p: p[SNERG_KEY].update(shape=[400, 4, 4]), SNERG_KEY),
    "our key not a turn": (lambda p: p[SNERG_KEY].update(viewer_axes=[[1, 1, 0], [0, 1, 0], [0, 0, 1]]), SNERG_KEY),
}


@pytest.mark.hard_case(59, 62)
@pytest.mark.parametrize("what", DAMAGE)
def test_damaged_numbers_are_named(tmp_path, written, what):
    edit, message = DAMAGE[what]
    folder = shutil.copytree(written, tmp_path / "copy")
    change(folder, edit)
    with pytest.raises(SnergError, match=message):
        read_reference(folder)


def test_damaged_images_are_named(tmp_path, written):
    for name in ("rgba_003.png", "feature_000.png", "atlas_indices.png"):
        for damage in ("missing", "cut", "resized"):
            folder = shutil.copytree(written, tmp_path / f"{name}-{damage}")
            path = folder / name
            if damage == "missing":
                path.unlink()
            elif damage == "cut":
                path.write_bytes(path.read_bytes()[:48])
            else:
                Image.open(path).resize((17, 9)).save(path)
            with pytest.raises(SnergError, match=name.split(".")[0]):
                read_reference(folder)


def test_indices_outside_the_atlas_are_refused(tmp_path, written):
    folder = shutil.copytree(written, tmp_path / "copy")
    pixels = np.array(Image.open(folder / "atlas_indices.png"))
    pixels[0, 0] = 9, 0, 0
    Image.fromarray(pixels).save(folder / "atlas_indices.png")
    with pytest.raises(SnergError, match="outside the atlas"):
        read_reference(folder)


def test_no_scene(tmp_path):
    with pytest.raises(SnergError, match="does not exist"):
        read_reference(tmp_path)


def test_marcher_reproduces_the_published_viewer_on_a_ball(tmp_path):
    """A shaded ball with features: the published viewer's image against the marcher's, which reads the same files."""
    n = 64
    point = (np.stack(np.meshgrid(*[np.arange(n) + 0.5] * 3, indexing="ij"), axis=-1) - n / 2) / (n / 2)
    alpha = np.clip((0.45 - np.linalg.norm(point, axis=-1)) * n / 2, 0, 1)[..., None]
    features = 0.5 + 0.5 * np.sin(6 * point @ np.random.default_rng(3).normal(size=(3, 4)))
    values = np.concatenate([np.clip(0.5 + point, 0, 1) * alpha, features * alpha, alpha], axis=-1)
    scene = make_snerg()
    ball = snerg_from_volume((values * 255).astype(np.uint8), scene.network, grid_to_world=np.eye(4), voxel_size=2 / n)
    write_reference(ball, tmp_path / "ball")
    viewer = PublishedViewer(tmp_path / "ball")
    change(tmp_path / "ball", lambda params: params.pop(SNERG_KEY))
    back = read_reference(tmp_path / "ball")
    axes = np.array(viewer.params["worldspace_T_opengl"])[:3, :3]
    for eye in ((1.6, 0.9, 2.2), (-2.0, 1.4, -1.2)):
        pose = looking(eye, (0, 0, 0))
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3], camera_to_world[:3, 3] = axes @ pose[:3, :3], axes @ pose[:3, 3] + ball.box.box_to_world[:3, 3]
        theirs = viewer.show(pose, (320, 180), FOV)
        difference = np.abs(render_scene(back, centred_camera(camera_to_world, 320, 180)).over() - theirs) * 255
        assert difference.mean() < 1
        assert (difference.max(axis=-1) < 4.5).mean() > 0.985


def test_marcher_reproduces_the_published_viewers_pictures(data):
    """The viewer's own canvas, and our reimplementation of it, against the marcher."""
    folder = data / "reference"
    scene = read_reference(folder / "sphere64")
    viewer = PublishedViewer(folder / "sphere64")
    for path in sorted((folder / "views").glob("*.json")):
        view = json.loads(path.read_text())
        truth = read_image(folder / "views" / view["image"])[..., :3].astype(np.float64)
        pose = np.array(view["camera_to_world"])
        fov = view["vertical_fov_degrees"]
        camera = centred_camera(pose, view["width"], view["height"], view["near"], fov)
        difference = np.abs(render_scene(scene, camera).over() * 255 - truth)
        assert difference.mean() < 1
        assert (difference.max(axis=-1) <= 4.5).mean() > 0.99
        restated = viewer.show(pose, (view["width"], view["height"]), fov, view["near"])
        assert np.abs(restated * 255 - truth).mean() < 1


def test_reads_the_numbers_of_the_published_lego(data):
    folder = data / "reference" / "lego-index"
    params = read_params(folder)
    places, indirection = read_indices(folder, params)
    assert params.shape == (561, 581, 1000) and params.atlas == (64, 64, 1)
    assert indirection.shape == (19, 20, 34) and len(places) == (indirection >= 0).sum() == 3703
    with pytest.raises(SnergError, match="rgba_000"):
        read_reference(folder)


UNREAD = [["format"], ["ndc"], ["atlas_blocks_x", "atlas_blocks_y", "atlas_blocks_z"], ["input_height", "input_width", "input_focal"]]


@pytest.mark.parametrize(
    "absent", [*UNREAD, [key for keys in UNREAD for key in keys]], ids=lambda keys: keys[0] if len(keys) < 8 else "all"
)
def test_keys_that_the_viewer_does_not_read_are_derived(tmp_path, written, absent):
    path = written / "scene_params.json"
    whole = read_reference(written)
    params = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in params.items() if key not in absent}))
    same(read_reference(written), whole)


def test_a_frame_without_numbers_is_the_published_viewers(tmp_path):
    write_reference(make_snerg((44, 40, 60), size=1.4, ndc=make_frame()), tmp_path / "out")
    path = tmp_path / "out" / "scene_params.json"
    params = {k: v for k, v in json.loads(path.read_text()).items() if not k.startswith("input_") and k != SNERG_KEY}
    path.write_text(json.dumps(params))
    ndc = read_reference(tmp_path / "out").ndc
    assert ndc is not None and ndc.focal == pytest.approx((2 * 755.644059435 / 1006, 2 * 755.644059435 / 756))


@pytest.mark.parametrize("width", [0, 100, -128, 2**40])
def test_an_atlas_that_is_no_multiple_of_a_cell_is_refused(tmp_path, written, width):
    path = written / "scene_params.json"
    params = {k: v for k, v in json.loads(path.read_text()).items() if not k.startswith("atlas_blocks")}
    path.write_text(json.dumps(params | {"atlas_width": width}))
    with pytest.raises(SnergError, match="atlas_width"):
        read_reference(written)
