"""SNeRG objects in the viewport's regions: instances, refused and forward-facing scenes, windows, undo. Runs inside Blender.

A walk notes the colour of the viewport at points of the world, as the screen shows it, in `window.seen`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy_extras.view3d_utils import location_3d_to_region_2d
from drive import Walk, Window
from mathutils import Matrix
from viewport import part

Point = tuple[float, float, float]


def stage(window: Window) -> None:
    """Nothing but a flat grey world, seen from in front, and no overlays."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    look(window.view)


def look(area: Any) -> None:
    """An area's viewport from in front, 6 units away, flat and without overlays."""
    space = area.spaces[0]
    space.shading.light, space.shading.color_type, space.overlay.show_overlays = "FLAT", "OBJECT", False
    data = space.region_3d
    data.view_perspective, data.view_rotation = "PERSP", (0.7071068, 0.7071068, 0, 0)
    data.view_location, data.view_distance = (0, 0, 0), 6


def add(window: Window, folder: str, place: Point = (0, 0, 0), name: str = "Block") -> Any:
    """A SNeRG object, moved by `place`."""
    with bpy.context.temp_override(window=window.window):
        bpy.ops.snerg.add_scene(directory=folder)
    thing = window.window.view_layer.objects.active
    thing.name = name
    thing.location = np.array(thing.location) + place
    return thing


def colours(window: Window, name: str, points: dict[str, Point], seconds: float = 3) -> Walk:
    """Wait, take a picture, and note the window's colours at points of the world: seen[name][point]."""
    area = window.view
    region, data = next(r for r in area.regions if r.type == "WINDOW"), area.spaces[0].region_3d
    yield from window.move(area.x + 20, area.y + 20)
    yield from window.wait(seconds)
    window.shoot(name)
    where = {point: location_3d_to_region_2d(region, data, at) for point, at in points.items()}
    window.seen[name] = {key: pixel(window, name, region.x + at.x, region.y + at.y) for key, at in where.items()}


def pixel(window: Window, name: str, x: float, y: float) -> list[int]:
    """The colour [3], 0 to 255, of a picture that was shot, in pixels of the window from its lower left corner."""
    image = bpy.data.images.load(str(window.folder / f"{name}.png"), check_existing=False)
    values = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)
    bpy.data.images.remove(image)
    return [int(v) for v in np.rint(255 * values[int(y), int(x), :3])]


def said(thing: Any) -> str:
    """What the object's panel says of the viewport."""
    return str(part("snerg_addon.viewport.card").problem_in_viewport(thing))


def refused_scene(window: Window, small: str, large: str) -> Walk:
    """A scene that the card refuses between two that it takes."""
    stage(window)
    add(window, small, (-1.3, 0, 0))
    refused = add(window, large, (0, 0, 0), "Refused")
    add(window, small, (1.3, 0, 0))
    yield from colours(window, "three", {"left": (-1.3, -0.4, 0), "refused": (0, -0.4, 0), "right": (1.3, -0.4, 0)}, 8)
    window.seen["said"] = said(refused)
    window.seen["works"] = part("snerg_addon.viewport.draw").works()


def little_memory(window: Window, small: str) -> Walk:
    """The preference for graphics memory leaves no room for the scene, then for its picture neither."""
    stage(window)
    thing = add(window, small)
    card = part("snerg_addon.viewport.card")
    yield from colours(window, "room", {"block": (0, -0.4, 0)}, 2)
    scenes = sum(held.bytes for held in card.scenes.values())
    window.seen["counted"] = card.memory() - scenes - sum(picture.bytes for picture in card.pictures.values())
    window.seen["pictures"] = len(card.pictures)
    thing.hide_set(True)
    yield from window.wait(1)
    window.seen["hidden"] = len(card.pictures)


def instances(window: Window, folder: str) -> Walk:
    """The block by a collection instance and by geometry nodes, while its own collection is not in the view layer; then hidden."""
    stage(window)
    thing = add(window, folder)
    scene, home = window.window.scene, bpy.data.collections.new("Home")
    for holder in list(thing.users_collection):
        holder.objects.unlink(thing)
    scene.collection.children.link(home)
    home.objects.link(thing)
    window.window.view_layer.layer_collection.children["Home"].exclude = True
    first = bpy.data.objects.new("Instance", None)
    first.instance_type, first.instance_collection, first.location = "COLLECTION", home, (-1.3, 0, 0)
    scene.collection.objects.link(first)
    second = bpy.data.objects.new("Nodes", bpy.data.meshes.new("Nodes"))
    second.location = (1.3, 0, 0)
    scene.collection.objects.link(second)
    second.modifiers.new("Nodes", "NODES").node_group = collection_nodes(home)
    points = {"own": (0, -0.4, 0), "collection": (-1.3, -0.4, 0), "nodes": (1.3, -0.4, 0)}
    yield from colours(window, "shown", points)
    window.view.spaces[0].show_object_viewport_empty = False
    yield from colours(window, "no empties", points, 1)
    window.view.spaces[0].show_object_viewport_empty = True
    for other in window.window.view_layer.objects:
        other.select_set(other == first)
    yield from window.over_view()
    yield from window.press("H")
    yield from colours(window, "hidden", points, 1)
    yield from window.over_view()
    yield from window.press("H", alt=True)
    window.window.view_layer.layer_collection.children["Home"].exclude = False
    for other in window.window.view_layer.objects:
        other.select_set(other == second)
    yield from window.over_view()
    yield from window.press("NUMPAD_SLASH")
    yield from window.wait(1)
    look(window.view)
    yield from colours(window, "local view", points, 2)
    yield from window.over_view()
    yield from window.press("NUMPAD_SLASH")
    yield from window.wait(1)
    look(window.view)
    yield from colours(window, "all", points, 2)


def collection_nodes(collection: Any) -> Any:
    """A group of geometry nodes that instances a collection."""
    group = bpy.data.node_groups.new("Instances", "GeometryNodeTree")
    group.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    info, out = group.nodes.new("GeometryNodeCollectionInfo"), group.nodes.new("NodeGroupOutput")
    info.inputs["Collection"].default_value = collection
    group.links.new(info.outputs[0], out.inputs[0])
    return group


def undo(window: Window, folder: str) -> Walk:
    """Move the block with G X, undo and redo that with Ctrl-Z; undo adding it and redo that."""
    stage(window)
    points = {"here": (0, -0.4, 0), "there": (1.3, -0.4, 0)}
    with bpy.context.temp_override(window=window.window):
        bpy.ops.ed.undo_push(message="Stage")
    add(window, folder)
    with bpy.context.temp_override(window=window.window):
        bpy.ops.ed.undo_push(message="Add")  # as Blender does after a menu's operator, not after a script's
    yield from colours(window, "added", points)
    yield from window.over_view()
    yield from window.press("G")
    yield from window.press("X")
    for kind, letter in (("ONE", "1"), ("PERIOD", "."), ("THREE", "3")):
        window.send(kind, "PRESS", unicode=letter)
        window.send(kind, "RELEASE")
        yield
    yield from window.press("RET")
    yield from colours(window, "moved", points, 2)
    for name, keys in (("unmoved", {}), ("unadded", {}), ("added again", {"shift": True}), ("moved again", {"shift": True})):
        yield from window.over_view()
        yield from window.press("Z", ctrl=True, **keys)
        yield from colours(window, name, points, 2)


def kept(window: Window, folder: str) -> Walk:
    """Hide it in one of two view layers; save, open; link its collection from another file."""
    stage(window)
    thing, scene = add(window, folder), window.window.scene
    points = {"here": (0, -0.4, 0)}
    for other in window.window.view_layer.objects:
        other.select_set(other == thing)
    yield from colours(window, "first layer", points)
    scene.view_layers.new("Second")
    window.window.view_layer = scene.view_layers["Second"]
    thing.hide_set(True, view_layer=scene.view_layers["Second"])
    yield from colours(window, "second layer", points, 1)
    window.window.view_layer = scene.view_layers[0]
    yield from colours(window, "first again", points, 1)
    path = window.folder / "kept.blend"
    yield from window.file("save_as_mainfile", path)
    yield from window.file("read_homefile")
    stage(window)
    yield from colours(window, "empty file", points, 1)
    yield from window.file("open_mainfile", path)
    look(window.view)
    yield from colours(window, "opened", points)
    yield from window.file("read_homefile")
    stage(window)
    with bpy.data.libraries.load(str(path), link=True) as (source, target):
        target.objects = [name for name in source.objects if name == "Block"]
    window.window.scene.collection.objects.link(target.objects[0])
    window.seen["library"] = target.objects[0].library is not None
    yield from colours(window, "linked", points)


def several_regions(window: Window, folder: str) -> Walk:
    """A second window, and the four views of the first; each has its own picture, and what is closed has none."""
    stage(window)
    add(window, folder)
    card = part("snerg_addon.viewport.card")
    yield from colours(window, "one", {"here": (0, -0.4, 0)})
    window.seen["in one"] = len(card.pictures)
    with bpy.context.temp_override(window=window.window, area=window.view):
        bpy.ops.screen.area_dupli("INVOKE_DEFAULT")
    yield from window.wait(3)
    windows = bpy.context.window_manager.windows
    window.seen["windows"], window.seen["in two"] = len(windows), len(card.pictures)
    window.shoot("two windows")
    with bpy.context.temp_override(window=windows[1]):
        bpy.ops.wm.window_close()
    yield from window.wait(4)
    window.seen["after closing"] = len(card.pictures)
    region = next(r for r in window.view.regions if r.type == "WINDOW")
    with bpy.context.temp_override(window=window.window, area=window.view, region=region):
        bpy.ops.screen.region_quadview()
    yield from window.wait(4)
    window.shoot("quad view")
    space = window.view.spaces[0]
    regions = [r for r in window.view.regions if r.type == "WINDOW"]
    window.seen["quad"] = []
    for part_of, data in zip(regions, space.region_quadviews, strict=True):
        at = location_3d_to_region_2d(part_of, data, (0, 0, 0))
        window.seen["quad"].append(pixel(window, "quad view", part_of.x + at.x, part_of.y + at.y))
    window.seen["in quad"] = len(card.pictures)
    area = window.view
    area.type = "CONSOLE"
    yield from window.wait(4)
    window.seen["no viewport"] = card.memory() - sum(held.bytes for held in card.scenes.values())


def forward_facing(window: Window, folder: str, pose: str) -> Walk:
    """A scene in device coordinates, seen from its own frame; how the picture differs from F12's marcher."""
    stage(window)
    yield from window.wait(0.5)
    window.longest_pause = 0.0
    for _ in range(60):
        window.view.tag_redraw()
        yield
    window.seen["idle_pause"] = window.longest_pause
    thing = add(window, folder)
    space = window.view.spaces[0]
    data = space.region_3d
    camera = bpy.data.objects.new("Camera", bpy.data.cameras.new("Camera"))
    window.window.scene.collection.objects.link(camera)
    matrix = np.array([float(v) for v in Path(pose).read_text().split()]).reshape(4, 4)
    camera.matrix_world = Matrix(matrix.tolist())
    bpy.context.view_layer.update()
    data.view_perspective = "PERSP"
    data.view_matrix = camera.matrix_world.inverted()
    card = part("snerg_addon.viewport.card")
    yield from window.wait(0.5)
    window.longest_pause = 0.0
    window.seen["done"] = yield from window.until(lambda: card.slow and all(p.done and t for p, t in card.slow.values()), 60)
    window.seen["longest_pause"] = window.longest_pause
    yield from window.wait(1)
    window.shoot("forward")
    window.seen["said"] = said(thing)
    (target,) = (target for _, target in card.slow.values())
    drawn = np.array(target.picture.read(), np.float32).reshape(target.size[1], target.size[0], 4)
    window.seen["size"] = target.size
    region = next(r for r in window.view.regions if r.type == "WINDOW")
    window.seen["region"] = [region.width, region.height]
    scene = part("core.export.scene_files").read_scene(Path(folder))
    view = np.array(data.window_matrix)
    focal = view[0, 0] * region.width / 2, view[1, 1] * region.height / 2
    centre = region.width / 2 * (1 - view[0, 2]), region.height / 2 * (1 + view[1, 2])
    seen = part("core.geometry.camera").Camera(
        region.width,
        region.height,
        focal,
        centre,
        np.array(data.view_matrix.inverted(), np.float64),
        near=space.clip_start,
        far=space.clip_end,
    )
    frame = part("core.rendering.render").render_scene(scene, seen)
    wanted = np.concatenate([frame.colour, frame.alpha[..., None]], axis=-1)[::-1]
    error = 255 * np.abs(np.clip(drawn, 0, 1) - np.clip(wanted, 0, 1))
    window.seen["difference"] = [float(np.percentile(error, 99.9)), float(error.mean()), float(wanted[..., 3].mean())]


def composite(window: Window) -> Walk:
    """The picture over a mesh's edge, which stands half in front of and half behind it: the largest difference from NumPy's, in levels."""
    import gpu
    from gpu_extras.batch import batch_for_shader

    gpu_scene, picture, view = (part(f"snerg_addon.viewport.{name}") for name in ("gpu_scene", "picture", "view"))
    width, height, draw = 64, 48, np.random.default_rng(3)
    alpha = draw.random((height, width, 1)).astype(np.float32)
    alpha[:8], alpha[8:16] = 0, 1
    colour = np.concatenate([draw.random((height, width, 3)).astype(np.float32) * alpha, alpha], axis=-1)
    depths = np.where(np.arange(height) % 2, 3.0, 5.0)[:, None] * np.ones((1, width))  # before and behind the mesh at 4
    target = gpu_scene.Target.of(colour, depths.astype(np.float32))
    matrix = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1.2, -2.2], [0, 0, -1, 0]], np.float64)
    projection = view.Projection.from_matrix(matrix)
    shown, depth = (
        gpu.types.GPUTexture((width, height), format="RGBA32F"),
        gpu.types.GPUTexture((width, height), format="DEPTH_COMPONENT32F"),
    )
    back, mesh = (0.2, 0.3, 0.4, 1.0), (0.7, 0.1, 0.5, 1.0)
    edge = 2 * 37 / width - 1
    for holdout in (False, True):
        buffer = gpu.types.GPUFrameBuffer(color_slots=(shown,), depth_slot=depth)
        with buffer.bind():
            gpu.state.viewport_set(0, 0, width, height)
            gpu.state.depth_mask_set(True)
            buffer.clear(color=back, depth=1.0)
            lines = gpu.shader.from_builtin("UNIFORM_COLOR")
            gpu.state.depth_test_set("LESS_EQUAL")
            lines.bind()
            lines.uniform_float("color", mesh)
            x = 4 * edge
            corners = [(-4, -4, -4), (x, -4, -4), (x, 4, -4), (-4, -4, -4), (x, 4, -4), (-4, 4, -4)]
            with gpu.matrix.push_pop(), gpu.matrix.push_pop_projection():
                gpu.matrix.load_matrix(Matrix.Identity(4))
                gpu.matrix.load_projection_matrix(Matrix(matrix.tolist()))
                batch_for_shader(lines, "TRIS", {"pos": corners}).draw(lines)
            picture.lay(target, part("snerg_addon.viewport.view").Part(0, 0, width, height), projection, holdout)
        found = np.array(shown.read(), np.float32).reshape(height, width, 4)[..., :3]
        left = np.array(depth.read(), np.float32).reshape(height, width)
        behind = np.where((np.arange(width) < 37)[None, :, None], mesh[:3], back[:3]) * np.ones((height, 1, 1))
        hidden = ((depths > 4) & (np.arange(width) < 37)[None])[..., None]
        straight = np.clip(colour[..., :3] / np.maximum(alpha, 1e-9), 0, 1)
        linear = np.where(straight <= 0.04045, straight / 12.92, ((straight + 0.055) / 1.055) ** 2.4)
        over = linear * alpha * (0 if holdout else 1) + (1 - alpha) * behind
        wanted = np.where(hidden, behind, over)
        encode = part("core.io.images").linear_to_srgb
        error = 255 * np.abs(encode(np.clip(found, 0, 1)) - encode(np.clip(wanted, 0, 1)))
        at = np.where((alpha[..., 0] > 0) & ~hidden[..., 0], depths, np.where(np.arange(width) < 37, 4.0, np.inf))
        wanted_depth = np.where(np.isfinite(at), 0.5 * (1.2 * at - 2.2) / np.where(np.isfinite(at), at, 1) + 0.5, 1.0)
        window.seen["holdout" if holdout else "shown"] = [float(error.max()), float(np.abs(left - wanted_depth).max())]
        yield
