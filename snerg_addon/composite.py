"""SNeRG objects in another engine's renders: a second scene that renders them, and compositor nodes that merge both by depth."""

from __future__ import annotations

from typing import Any

import bpy

from ..core.errors import SnergError
from . import depth_merge

MESHES, BAKED, MERGE = "SNeRG Meshes", "SNeRG Baked", "SNeRG Merge"  # names of the nodes in the artist's tree
MERGED = ("Image", "Alpha", "Depth")  # what the merge gives in place of the render layers' outputs
ENVIRONMENT = ("Environment", "Env")  # the pass's name from Blender 5.0, and before


def composite(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> bpy.types.Scene:
    """Make F12 of a scene show its SNeRG objects among what its own engine renders. Returns the scene that renders them.

    The nodes are inserted between the render layers of `layer` and what follows; a second call updates what the first made. Raises
    SnergError where the scene's compositor does not read these render layers.
    """
    layer = composited_layer(tree_in_use(scene), scene) or layer
    check(scene, layer)
    tree = tree_of(scene)
    sources = [node for node in tree.nodes if reads(node, scene, layer)]
    show_all(scene, layer)
    second = second_scene(scene, layer)
    meshes = render_layers(tree, MESHES, scene, layer)
    baked = render_layers(tree, BAKED, second, second.view_layers[0])
    merge = merge_node(tree)
    connect(tree, merge, meshes, baked, opaque=layer.use_pass_environment and environment(meshes) is not None)
    lead_on(tree, sources, merge)
    place(tree, sources, meshes, baked, merge)
    return second


def check(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    """Raise SnergError where the render of a view layer cannot be composited. Changes nothing."""
    if scene.path_resolve("library") is not None:
        raise SnergError(f"The scene {scene.name!r} is linked from another file; composite it there, or in a scene of this file.")
    tree = tree_in_use(scene)
    nodes = [] if tree is None else tree.nodes
    if len(nodes) and MERGE not in nodes and not any(reads(node, scene, layer) for node in nodes):
        raise SnergError(f"The compositor of {scene.name!r} has no render layers of {layer.name!r} to insert into; add such a node.")


def tree_in_use(scene: bpy.types.Scene) -> bpy.types.NodeTree | None:
    """The compositor nodes that a render of the scene goes through; None where there are none. Changes nothing."""
    if "compositor_effects" in scene.bl_rna.properties:
        return next((effect.node_group for effect in scene.compositor_effects if effect.enable_for_render), None)
    if "compositing_node_group" in scene.bl_rna.properties:
        return scene.compositing_node_group
    return scene.node_tree


def tree_of(scene: bpy.types.Scene) -> bpy.types.NodeTree:
    """The scene's compositor nodes, made where there are none, and a copy of the scene's own where other scenes use them too."""
    holder, name = tree_holder(scene)
    tree = getattr(holder, name)
    if tree is None:
        tree = bpy.data.node_groups.new(f"{scene.name} Compositor", "CompositorNodeTree")
        setattr(holder, name, tree)
    elif name != "node_tree" and (tree.library is not None or tree.users - tree.use_fake_user > 1):
        tree = tree.copy()
        setattr(holder, name, tree)
    scene.render.use_compositing = True
    return tree


def tree_holder(scene: bpy.types.Scene) -> tuple[Any, str]:
    """What has a scene's compositor tree, and by which attribute."""
    if "compositor_effects" in scene.bl_rna.properties:  # from Blender 5.3: effects, of which the first gets the render
        effects = scene.compositor_effects
        first = next((effect for effect in effects if effect.enable_for_render), None)
        return first or effects.new("Compositor"), "node_group"
    if "compositing_node_group" in scene.bl_rna.properties:  # from Blender 5.0
        return scene, "compositing_node_group"
    scene.use_nodes = True
    return scene, "node_tree"


def composited_layer(tree: bpy.types.NodeTree | None, scene: bpy.types.Scene) -> bpy.types.ViewLayer | None:
    """The view layer that an earlier call merged; None where there was none, or it is gone."""
    node = None if tree is None else tree.nodes.get(MESHES)
    return None if node is None else scene.view_layers.get(node.layer)


def reads(node: bpy.types.Node, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> bool:
    """Whether a node brings the render of a view layer into the tree."""
    return node.type == "R_LAYERS" and node.name != MESHES and node.scene == scene and node.layer == layer.name


def show_all(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> None:
    """Turn on what the merge needs: depth, coverage and, where the film is opaque, the environment as a pass of its own.

    Only a transparent film tells how much of a pixel is covered; the environment pass is added again by the merge.
    """
    layer.use_pass_z = True
    if not scene.render.film_transparent:
        layer.use_pass_environment = scene.render.film_transparent = True


def second_scene(scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> bpy.types.Scene:
    """The scene that renders the SNeRG objects of another one, made where there is none, with the same objects and settings."""
    second = next((other for other in bpy.data.scenes if other.snerg.follows == scene), None)
    if second is None:
        second = bpy.data.scenes.new(f"{scene.name} SNeRG")
        second.snerg.follows = scene
    for ours, theirs in ((second.collection.children, scene.collection.children), (second.collection.objects, scene.collection.objects)):
        for gone in set(ours) - set(theirs):
            ours.unlink(gone)
        for new in [thing for thing in theirs if thing not in set(ours)]:
            ours.link(new)
    second.render.engine, second.render.film_transparent, second.render.use_compositing = "SNERG", True, False
    second.view_layers[0].use_pass_z = True
    second.view_layers[0].update()  # else a new one has no layer collections yet
    copy_visibility(layer.layer_collection, second.view_layers[0].layer_collection)
    copy_settings(scene, second)
    return second


def copy_visibility(source: bpy.types.LayerCollection, target: bpy.types.LayerCollection) -> None:
    """Give the collections of a view layer what decides in another one whether and how they render."""
    twins = {child.collection: child for child in target.children}
    for child in source.children:
        twin = twins[child.collection]
        twin.exclude = child.exclude
        twin.holdout, twin.indirect_only = child.holdout, child.indirect_only
        copy_visibility(child, twin)


def copy_settings(scene: bpy.types.Scene, second: bpy.types.Scene) -> None:
    """Copy camera, frames and size of the picture, so that the second scene can be rendered alone too; the engine follows the first."""
    second.camera = scene.camera
    second.frame_end, second.frame_start, second.frame_step = scene.frame_end, scene.frame_start, scene.frame_step
    render, twin = scene.render, second.render
    for name in (
        *("resolution_x", "resolution_y", "resolution_percentage", "pixel_aspect_x", "pixel_aspect_y", "fps", "fps_base"),
        *("use_border", "use_crop_to_border", "border_min_x", "border_max_x", "border_min_y", "border_max_y"),
    ):
        setattr(twin, name, getattr(render, name))


def render_layers(tree: bpy.types.NodeTree, name: str, scene: bpy.types.Scene, layer: bpy.types.ViewLayer) -> bpy.types.Node:
    """The render layers node of that name, of a scene's view layer."""
    node = tree.nodes.get(name) or tree.nodes.new("CompositorNodeRLayers")
    node.name = node.label = name
    node.scene = scene
    node.layer = layer.name  # which also updates the sockets to the passes
    return node


def merge_node(tree: bpy.types.NodeTree) -> bpy.types.Node:
    """The node that merges by depth."""
    node = tree.nodes.get(MERGE) or tree.nodes.new("CompositorNodeGroup")
    node.name = node.label = MERGE
    node.node_tree = depth_merge.group()
    return node


def environment(node: bpy.types.Node) -> bpy.types.NodeSocket | None:
    """The environment pass of a render layers node."""
    return next((node.outputs[name] for name in ENVIRONMENT if name in node.outputs and node.outputs[name].enabled), None)


def connect(tree: bpy.types.NodeTree, merge: bpy.types.Node, meshes: bpy.types.Node, baked: bpy.types.Node, opaque: bool) -> None:
    """Link both renders into the merge."""
    for name in MERGED:
        tree.links.new(meshes.outputs[name], merge.inputs[name])
        tree.links.new(baked.outputs[name], merge.inputs[f"Baked {name}"])
    merge.inputs["Opaque"].default_value = float(opaque)
    if opaque:
        tree.links.new(environment(meshes), merge.inputs["Environment"])


def lead_on(tree: bpy.types.NodeTree, sources: list[bpy.types.Node], merge: bpy.types.Node) -> None:
    """Lead what came from the render layers from the merge instead; in a new tree, to the output."""
    for link in list(tree.links):
        if link.from_node in sources and link.from_socket.name in MERGED:
            tree.links.new(merge.outputs[link.from_socket.name], link.to_socket)
    if not merge.outputs["Image"].is_linked and not sources:
        tree.links.new(merge.outputs["Image"], output_of(tree))


def output_of(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Where a tree's picture goes."""
    if bpy.app.version < (5, 0):
        node = next((node for node in tree.nodes if node.type == "COMPOSITE"), None) or tree.nodes.new("CompositorNodeComposite")
    else:
        if not tree.interface.items_tree:
            tree.interface.new_socket("Image", in_out="OUTPUT", socket_type="NodeSocketColor")
        node = next((node for node in tree.nodes if node.type == "GROUP_OUTPUT"), None) or tree.nodes.new("NodeGroupOutput")
    if node.location.length == 0:
        node.location = 600, 0
    return node.inputs[0]


def place(tree: bpy.types.NodeTree, sources: list[bpy.types.Node], *ours: bpy.types.Node) -> None:
    """Put the three nodes under the render layers that they follow, the first time."""
    if ours[0].location.length == 0:
        left, top = sources[0].location if sources else (0, 0)
        for node, (x, y) in zip(ours, ((0, -400), (0, -800), (350, -400)), strict=True):
            node.location = left + x, top + y
