"""Composite with this render: meshes and baked objects in one frame, by depth, with soft edges and no fringe; proxies for shadows."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix
from stage import add_camera

from scenes import snerg_from_volume
from snerg.core.export.scene_files import write_scene
from snerg.core.geometry.camera import Camera
from snerg.core.io.images import read_image
from snerg.core.rendering.render import render_scene
from snerg.core.scene.scene import Scene
from snerg.snerg_addon.bridge import camera_from_blender
from snerg.snerg_addon.capture import evaluated
from snerg.snerg_addon.composite import BAKED, MERGE, MESHES, tree_holder, tree_in_use, tree_of
from snerg.snerg_addon.depth_merge import GROUP
from snerg.snerg_addon.scene_object import make

RED, GREEN, BLUE = 0, 1, 2  # the block, the cube and the world have one channel each, so that a pixel tells how much of each it shows
HALF = 0.25  # of the cube's side


def block() -> Scene:
    """An opaque red box with edges of 26/30 unit round the world's origin."""
    values = np.zeros((30, 30, 30, 4), np.uint8)
    values[2:-2, 2:-2, 2:-2] = (255, 0, 0, 255)
    pose = np.eye(4)
    pose[:3, 3] = -0.5
    return snerg_from_volume(values, None, grid_to_world=pose, voxel_size=1 / 30)


def add_cube(place: Matrix) -> bpy.types.Object:
    """A cube that glows green."""
    corners = [(x, y, z) for x in (-HALF, HALF) for y in (-HALF, HALF) for z in (-HALF, HALF)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return add_mesh(place, (0, 1, 0, 1), corners, faces)


def add_mesh(place: Matrix, colour: tuple, corners: list[tuple], faces: list[tuple] | None = None) -> bpy.types.Object:
    """A mesh that glows evenly."""
    mesh = bpy.data.meshes.new("Cube")
    mesh.from_pydata(corners, [], faces or [tuple(range(len(corners)))])
    material = bpy.data.materials.new("Glow")
    if bpy.app.version < (5, 0):
        material.use_nodes = True
    nodes = material.node_tree.nodes
    nodes.clear()
    glow, out = nodes.new("ShaderNodeEmission"), nodes.new("ShaderNodeOutputMaterial")
    glow.inputs["Color"].default_value = colour
    material.node_tree.links.new(glow.outputs[0], out.inputs["Surface"])
    mesh.materials.append(material)
    cube = bpy.data.objects.new("Cube", mesh)
    bpy.context.scene.collection.objects.link(cube)
    cube.matrix_world = place
    return cube


def remove_nodes() -> None:
    """Take back what earlier tests left in the scene, which is one for all tests."""
    scene = bpy.context.scene
    if "compositor_effects" in scene.bl_rna.properties:
        scene.compositor_effects.clear()
    elif "compositing_node_group" in scene.bl_rna.properties:
        scene.compositing_node_group = None
    elif scene.node_tree:
        scene.node_tree.nodes.clear()
        scene.use_nodes = False
    for group in list(bpy.data.node_groups):
        bpy.data.node_groups.remove(group)
    scene.render.film_transparent = scene.view_layers[0].use_pass_environment = scene.view_layers[0].use_pass_z = False
    for other in list(bpy.data.scenes)[1:]:
        bpy.data.scenes.remove(other)


@pytest.fixture
def stage(scene, tmp_path):
    """A scene of Cycles with a blue world, the block, and a cube half inside it, seen from a corner."""
    remove_nodes()
    scene.render.resolution_x, scene.render.resolution_y = 64, 48
    scene.cycles.samples, scene.cycles.pixel_filter_type = 16, "BOX"
    scene.view_settings.view_transform, scene.render.dither_intensity = "Standard", 0.0
    world = bpy.data.worlds.new("Blue")
    nodes = world.node_tree.nodes if bpy.app.version >= (5, 0) else None
    if nodes is None:
        world.use_nodes = True
        nodes = world.node_tree.nodes
    background = next((node for node in nodes if node.type == "BACKGROUND"), None)
    background.inputs["Color"].default_value, background.inputs["Strength"].default_value = (0, 0, 1, 1), 1
    old, scene.world = scene.world.name, world
    scene.camera = add_camera("Camera")
    scene.camera.matrix_world = Matrix.LocRotScale((1.1, -1.5, 1.4), Euler((0.92, 0, 0.63)), (1, 1, 1))
    write_scene(block(), tmp_path / "block")
    thing = make(block(), tmp_path / "block", scene.collection)
    cube = add_cube(Matrix.LocRotScale((0.3, -0.35, 0.3), Euler((0.3, 0.5, 0.2)), (1, 1, 1)))
    yield scene, thing, cube
    scene = bpy.context.scene  # undo makes it another
    scene.world = bpy.data.worlds[old]
    remove_nodes()
    settings, scene.render.use_compositing = scene.render.image_settings, True
    settings.file_format, settings.color_mode, settings.color_depth = "PNG", "RGBA", "8"


def rendered(scene, tmp_path: Path) -> np.ndarray:
    """F12's picture [H, W, 4], linear and premultiplied."""
    settings = scene.render.image_settings
    settings.file_format, settings.color_mode, settings.color_depth = "OPEN_EXR", "RGBA", "32"
    scene.render.filepath = str(tmp_path / "frame.exr")
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(scene.render.filepath)
    pixels = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)[::-1]
    bpy.data.images.remove(image)
    return pixels


def covered(camera: Camera, cube: bpy.types.Object, finer: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """The truth, from finer x finer rays a pixel: how much of each pixel, [H, W], shows the cube, and the block."""
    fine = Camera(
        width=camera.width * finer,
        height=camera.height * finer,
        focal=(camera.focal[0] * finer, camera.focal[1] * finer),
        centre=(camera.centre[0] * finer, camera.centre[1] * finer),
        camera_to_world=camera.camera_to_world,
    )
    frame = render_scene(block(), fine)
    there = np.linalg.inv(np.array(cube.matrix_world, np.float64))
    origins, directions = (rays.reshape(-1, 3) @ there[:3, :3].T for rays in fine.rays())
    with np.errstate(divide="ignore"):
        ends = np.stack([(side - origins - there[:3, 3]) / directions for side in (-HALF, HALF)])
    enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
    depth = np.where(enter < leave, enter, np.inf).reshape(fine.height, fine.width)
    green = depth < np.where(frame.alpha > 0.5, frame.depth, np.inf)
    red = ~green & (frame.alpha > 0.5)

    def share(values: np.ndarray) -> np.ndarray:
        return values.reshape(camera.height, finer, camera.width, finer).mean(axis=(1, 3))

    return share(green), share(red)


@pytest.mark.hard_case(76)
def test_a_mesh_half_inside_a_baked_block_is_right_to_the_pixel(stage, tmp_path):
    scene, _, cube = stage
    assert bpy.ops.snerg.composite() == {"FINISHED"}
    got = rendered(scene, tmp_path)
    green, red = covered(camera_from_blender(scene.camera, scene, evaluated(scene)), cube)
    error = np.abs(got[..., :3] - np.stack([red, green, 1 - red - green], axis=-1)).max(axis=-1)
    whole = (np.maximum(red, green) == 1) | (red + green == 0)
    assert 0.5 < whole.mean() < 0.95 and error[whole].max() < 0.2 and error.max() < 0.3  # 16 samples a pixel, and a voxel's soft edge
    far = whole & ~near(~whole)
    assert far.mean() > 0.5 and error[far].max() < 1e-3
    assert error.mean() < 0.01
    assert np.abs(got[..., :3].sum(axis=-1) - 1).max() < 1e-3 and (got[..., 3] == 1).all()  # no fringe: nothing is lost or counted twice


def near(marked: np.ndarray) -> np.ndarray:
    """The marked pixels of a picture and those round them."""
    padded = np.pad(marked, 1)
    height, width = marked.shape
    return np.any([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


@pytest.mark.hard_case(76)
def test_where_two_surfaces_cross_the_edge_is_soft(stage, tmp_path):
    """The crossing has no silhouette in either render: only the depths tell where within a pixel it runs."""
    scene, _, cube = stage
    cube.matrix_world = Matrix.LocRotScale((0.1, -0.1, 0.4), Euler((0.5, 0.6, 0.2)), (1, 1, 1))
    bpy.ops.snerg.composite()
    got = rendered(scene, tmp_path)
    green, red = covered(camera_from_blender(scene.camera, scene, evaluated(scene)), cube)
    scene.render.use_compositing = False
    alone = rendered(scene, tmp_path)
    crossing = (alone[..., 3] == 1) & (green > 0) & (red > 0) & (green + red == 1)
    error = np.abs(got[..., GREEN] - green)
    assert crossing.sum() > 15 and error[crossing].max() < 0.4 and error[crossing].mean() < 0.1
    assert np.abs(got[..., :3].sum(axis=-1) - 1).max() < 1e-3


def test_a_mesh_in_front_hides_and_one_behind_shows_at_the_edges(stage, tmp_path):
    scene, thing, cube = stage
    bpy.ops.snerg.composite()
    scene.camera.matrix_world = Matrix.Translation((0, 0, 4))
    for height, seen in ((1.0, GREEN), (-1.0, RED)):
        cube.matrix_world = Matrix.Translation((0, 0, height))
        assert rendered(scene, tmp_path)[24, 32, seen] == pytest.approx(1, abs=1e-3)
    cube.matrix_world = Matrix.Translation((0.5, 0, -1.0))
    row = rendered(scene, tmp_path)[24, :, :3].argmax(axis=-1)
    assert row[np.flatnonzero(np.diff(row, prepend=-1))].tolist() == [BLUE, RED, GREEN, BLUE]
    thing.hide_render = True
    assert rendered(scene, tmp_path)[..., RED].max() == 0


@pytest.mark.parametrize("place", [(0.55, -0.8, 0.7), (0.3, -0.35, 0.3), (0.1, -0.1, 0.4)])
def test_before_a_wall_edges_have_no_fringe_of_the_wall(stage, tmp_path, place):
    """The mesh render has the wall's blue in the cube's edge pixels; where the block is between the two, the frame must not."""
    scene, _, cube = stage
    cube.matrix_world = Matrix.LocRotScale(place, Euler((0.3, 0.5, 0.2)), (0.8,) * 3)
    add_mesh(scene.camera.matrix_world @ Matrix.Translation((0, 0, -5)), (0, 0, 1, 1), [(-9, -9, 0), (9, -9, 0), (9, 9, 0), (-9, 9, 0)])
    bpy.ops.snerg.composite()
    got = rendered(scene, tmp_path)
    green, red = covered(camera_from_blender(scene.camera, scene, evaluated(scene)), cube)
    between = (green + red == 1) & ~near(green + red < 1)
    edge = between & (green > 0) & (red > 0)
    error = np.abs(got[..., GREEN] - green)
    assert edge.sum() > 50 and got[..., BLUE][between].max() < 0.01
    assert error[edge].mean() < 0.13 and error[between & ~near(edge)].max() < 1e-3  # no hidden edge shines through either


def test_a_transparent_film_stays_transparent(stage, tmp_path):
    scene, *_ = stage
    scene.render.film_transparent = True
    bpy.ops.snerg.composite()
    picture = rendered(scene, tmp_path)
    assert picture[0, 0].tolist() == [0, 0, 0, 0] and picture[..., BLUE].max() == 0 and picture[24, 32, 3] == 1


def state() -> tuple:
    """What the operator makes and changes."""
    scene = bpy.context.scene
    holder = [(group.name, sorted(node.name for node in group.nodes), len(group.links)) for group in bpy.data.node_groups]
    settings = scene.render.film_transparent, scene.view_layers[0].use_pass_environment, scene.view_layers[0].use_pass_z
    return sorted(other.name for other in bpy.data.scenes), sorted(holder), settings


def test_twice_makes_nothing_twice_and_undo_takes_it_back(stage):
    before = state()
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.snerg.composite("EXEC_DEFAULT", True)
    once = state()
    assert once != before and len(once[0]) == 2
    bpy.ops.snerg.composite("EXEC_DEFAULT", True)
    assert state() == once
    bpy.ops.ed.undo()
    assert state() == once
    bpy.ops.ed.undo()
    assert state() == before


def test_again_follows_what_the_artist_changed(stage, tmp_path, capfd):
    scene, thing, cube = stage
    scene.collection.children.link(bpy.data.collections.new("Empty"))
    bpy.ops.snerg.composite()
    second = next(other for other in bpy.data.scenes if other.snerg.follows == scene)
    group = bpy.data.collections.new("Group")
    scene.collection.children.link(group)
    group.objects.link(thing)
    scene.collection.objects.unlink(thing)
    scene.collection.objects.unlink(cube)
    bpy.ops.snerg.composite()
    assert group in list(second.collection.children) and set(second.collection.objects) == set(scene.collection.objects)
    assert rendered(scene, tmp_path)[24, 32, RED] == 1
    scene.view_layers[0].layer_collection.children["Group"].exclude = True
    bpy.ops.snerg.composite()
    assert rendered(scene, tmp_path)[..., RED].max() == 0
    make(block(), tmp_path / "block", scene.collection, "Late")
    rendered(scene, tmp_path)
    assert "Not composited, because added later: Late;" in "".join(capfd.readouterr())


def test_the_second_render_follows_the_first_ones_camera_size_and_border(stage, tmp_path):
    scene, *_ = stage
    bpy.ops.snerg.composite()
    render, other = scene.render, add_camera("Other")
    other.matrix_world = Matrix.LocRotScale((-1.1, -1.5, 1.4), Euler((0.92, 0, -0.63)), (1, 1, 1))
    scene.camera, render.resolution_x, render.resolution_y, render.resolution_percentage = other, 192, 96, 50
    whole = rendered(scene, tmp_path)
    _, red = covered(camera_from_blender(other, scene, evaluated(scene)), bpy.data.objects["Cube"])
    assert whole.shape == (48, 96, 4) and np.abs(whole[..., RED] - red).mean() < 0.01
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = 0.25, 0.75, 0.5, 1.0
    part = rendered(scene, tmp_path)
    render.use_border = render.use_crop_to_border = False
    assert np.abs(part[..., RED] - whole[:24, 24:72, RED]).mean() < 0.003  # Cycles' noise is another with a border


def test_collections_render_in_the_second_scene_as_in_the_first(stage, tmp_path):
    scene, thing, cube = stage
    scene.collection.objects.unlink(cube)
    outer, inner = (bpy.data.collections.new(name) for name in ("Outer", "Inner"))
    scene.collection.children.link(outer)
    outer.children.link(inner)
    inner.objects.link(thing)
    scene.collection.objects.unlink(thing)
    scene.render.film_transparent = True
    collection = scene.view_layers[0].layer_collection.children["Outer"].children["Inner"]
    for name, shown in (("holdout", (0, 0)), ("indirect_only", (0, 0)), ("exclude", (0, 0)), ("", (1, 1))):
        if name:
            setattr(collection, name, True)
        bpy.ops.snerg.composite()
        assert tuple(rendered(scene, tmp_path)[24, 32, [RED, 3]]) == shown, name
        if name:
            setattr(collection, name, False)


def test_an_animation_moves_in_both_renders(stage, tmp_path):
    scene, thing, cube = stage
    bpy.ops.snerg.composite()
    scene.camera.matrix_world = Matrix.Translation((0, 0, 6))
    cube.matrix_world = Matrix.Translation((0, 0, 1))
    for which, object_ in enumerate((thing, cube)):
        for frame, x in ((1, -0.8), (2, 0.8)):
            object_.location.x = x if which else -x
            object_.keyframe_insert("location", frame=frame)
    scene.frame_start, scene.frame_end, scene.render.filepath = 1, 2, str(tmp_path / "frame_")
    bpy.ops.render.render(animation=True)
    left = [(read_image(tmp_path / f"frame_{n:04d}.png")[:, :32, :3] > 128).sum(axis=(0, 1)) for n in (1, 2)]
    assert left[0][GREEN] > 10 > left[0][RED] and left[1][RED] > 10 > left[1][GREEN]


@pytest.mark.slow
def test_eevee_gives_the_same_edges(stage, tmp_path):
    scene, _, cube = stage
    scene.render.engine = "BLENDER_EEVEE_NEXT" if bpy.app.version < (5, 0) else "BLENDER_EEVEE"
    bpy.ops.snerg.composite()
    try:
        got = rendered(scene, tmp_path)
    except RuntimeError as error:
        pytest.skip(f"EEVEE does not render here: {error}")
    green, red = covered(camera_from_blender(scene.camera, scene, evaluated(scene)), cube)
    error = np.abs(got[..., :3] - np.stack([red, green, 1 - red - green], axis=-1)).max(axis=-1)
    assert error.max() < 0.3 and error.mean() < 0.015
    assert np.abs(got[..., :3].sum(axis=-1) - 1).max() < 0.02 and (got[..., 3] == 1).all()


def test_nothing_of_the_artists_nodes_is_lost(stage, tmp_path):
    scene, *_ = stage
    tree = tree_of(scene)
    layers, invert = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeInvert")
    tree.links.new(layers.outputs["Image"], invert.inputs["Color"])
    output = tree.nodes.new("NodeGroupOutput" if bpy.app.version >= (5, 0) else "CompositorNodeComposite")
    if bpy.app.version >= (5, 0):
        tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
    tree.links.new(invert.outputs["Color"], output.inputs[0])
    for _ in range(2):
        assert bpy.ops.snerg.composite() == {"FINISHED"}
        assert {layers, invert, output, *(tree.nodes[name] for name in (MESHES, BAKED, MERGE))} == set(tree.nodes)
        assert invert.inputs["Color"].links[0].from_node == tree.nodes[MERGE] and output.inputs[0].links[0].from_node == invert
    assert rendered(scene, tmp_path)[24, 32, :3] == pytest.approx([1, 0, 1], abs=0.02)
    assert [group.name for group in bpy.data.node_groups].count(GROUP) == 1


def test_a_compositor_that_reads_no_render_is_left_alone(stage):
    scene, *_ = stage
    tree = tree_of(scene)
    tree.nodes.clear()
    tree.nodes.new("CompositorNodeInvert")
    scene.render.use_compositing = False
    tree.use_fake_user = True
    holder, name = tree_holder(bpy.data.scenes.new("Second"))
    if name != "node_tree":
        setattr(holder, name, tree)  # a tree of several scenes is copied where it is changed
    before = state()
    with pytest.raises(RuntimeError, match="no render layers of"):
        bpy.ops.snerg.composite()
    assert state() == before and not scene.render.use_compositing and tree_in_use(scene) == tree


@pytest.fixture
def lit(stage):
    """The stage without a world, under a sun that shines straight down, seen from above, with the block active."""
    scene, thing, cube = stage
    world, scene.world = scene.world, None
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    scene.collection.objects.link(sun)
    bpy.context.view_layer.objects.active = thing
    scene.camera.matrix_world = Matrix.LocRotScale((1.5, -2.1, 2.0), Euler((0.92, 0, 0.63)), (1, 1, 1))
    yield scene, thing, cube
    bpy.context.scene.world = world


def test_a_mesh_casts_its_shadow_on_the_baked_block_and_hides_inside_it(lit, tmp_path):
    scene, _, cube = lit
    assert bpy.ops.snerg.proxy(kind="SHADOW_CATCHER") == bpy.ops.snerg.composite() == {"FINISHED"}
    cube.matrix_world = Matrix.Translation((0, 0, 1.0)) @ Matrix.Scale(0.7, 4)
    above = rendered(scene, tmp_path)
    cube.matrix_world = Matrix.Identity(4)
    inside = rendered(scene, tmp_path)
    assert inside[..., GREEN].max() < 1e-3 and inside[..., RED].max() == pytest.approx(1, abs=1e-3)
    whole = inside[..., RED] > 0.999
    dark = whole & (above[..., RED] < 0.1) & (above[..., GREEN] == 0)
    assert dark.sum() > 30 and (above[..., RED][whole] > 0.98).sum() > 0.85 * whole.sum()


def test_a_holdout_cuts_the_block_out_of_what_is_behind(lit, tmp_path):
    scene, _, cube = lit
    scene.render.film_transparent = True
    scene.camera.matrix_world = Matrix.Translation((0, 0, 4))
    cube.matrix_world = Matrix.Translation((0, 0, -1)) @ Matrix.Scale(4, 4)
    assert rendered(scene, tmp_path)[24, 32, 3] == 1
    bpy.ops.snerg.proxy(kind="HOLDOUT")
    alpha = rendered(scene, tmp_path)[..., 3]
    assert alpha[24, 32] == 0 and alpha[24].max() == 1


def test_it_follows_the_object_and_there_is_one(lit):
    _, thing, _ = lit
    bpy.ops.snerg.proxy()
    (proxy,) = thing.children
    thing.matrix_world = Matrix.Translation((1, 2, 3)) @ Matrix.Scale(2, 4)
    bpy.context.view_layer.update()
    corners = np.array([list(proxy.matrix_world @ vertex.co) for vertex in proxy.data.vertices])
    side = 26 / 30 * 2
    assert np.allclose(corners.min(axis=0), np.array((1, 2, 3)) - side / 2, atol=0.02)
    assert np.allclose(np.ptp(corners, axis=0), side, atol=0.04)
    assert not proxy.data.validate() and proxy.is_shadow_catcher and not proxy.is_holdout
    bpy.ops.snerg.proxy(kind="HOLDOUT", threshold=0.2)
    assert thing.children == (proxy,) and proxy.is_holdout and not proxy.is_shadow_catcher


def test_it_wants_an_object_that_shows_a_scene(lit):
    cube = bpy.context.temp_override(object=bpy.data.objects["Cube"])
    with pytest.raises(RuntimeError, match="Select an object that shows a baked scene"), cube:
        bpy.ops.snerg.proxy()
