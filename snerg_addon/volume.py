"""A baked scene as a Volume object, which Cycles and EEVEE light."""

from __future__ import annotations

from pathlib import Path

import bpy

from .owner import absolute_path, blend_path
from .scene_object import folder_of, snerg_objects

NAME = "SNeRG Volume"


def add_volume(scene: bpy.types.Scene, path: Path, source: Path) -> bpy.types.Object | None:
    """A Volume object of a .vdb file, as a child of the SNeRG object that shows `source`; one that shows the file already is kept.

    Returns None where no object shows the source any more.
    """
    parent = next((thing for layer in scene.view_layers for thing in snerg_objects(layer) if folder_of(thing) == source), None)
    if parent is None:
        return None
    for child in parent.children:
        if child.type == "VOLUME" and absolute_path(child.data.filepath, scene) == path:
            child.data.grids.unload()  # written again
            return child
    volume = bpy.data.volumes.new(NAME)
    volume.filepath = blend_path(path)
    volume.materials.append(material())
    thing = bpy.data.objects.new(NAME, volume)
    thing.parent = parent
    parent.users_collection[0].objects.link(thing)
    return thing


def material() -> bpy.types.Material:
    """Extinction by the grid `density`, scattering in the colours of the grid `color`.

    The colours hold the light under which the scene was photographed; Emission Strength of 1 shows them as they were.
    """
    known = bpy.data.materials.get(NAME)
    if known is not None:
        return known
    made = bpy.data.materials.new(NAME)
    if not made.node_tree:
        made.use_nodes = True
    tree = made.node_tree
    tree.nodes.clear()
    output, shader = tree.nodes.new("ShaderNodeOutputMaterial"), tree.nodes.new("ShaderNodeVolumePrincipled")
    colour = tree.nodes.new("ShaderNodeAttribute")
    colour.attribute_name = "color"
    shader.inputs["Density Attribute"].default_value = "density"
    shader.inputs["Density"].default_value = 1.0
    tree.links.new(colour.outputs["Color"], shader.inputs["Color"])
    tree.links.new(colour.outputs["Color"], shader.inputs["Emission Color"])
    tree.links.new(shader.outputs["Volume"], output.inputs["Volume"])
    colour.location, shader.location, output.location = (-300, 0), (0, 0), (300, 0)
    return made
