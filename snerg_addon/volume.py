"""A baked scene as a Volume object, which Cycles and EEVEE light."""

from __future__ import annotations

import hashlib
from pathlib import Path

import bpy

from .owner import absolute_path, blend_path
from .project import Project
from .scene_object import folder_of, link_beside, snerg_objects

NAME = "SNeRG Volume"


def volume_path(project: Project, folder: Path) -> Path:
    """Where the volume of the scene in a folder is written: within the project, by another name for each scene."""
    name = project.key(folder).replace("/", "_")
    if not folder.is_relative_to(project.folder):
        name = f"{folder.name}-{hashlib.sha256(str(folder).encode()).hexdigest()[:8]}"
    return project.folder / "volumes" / f"{name}.vdb"


def parent_of(scene: bpy.types.Scene, project: Project, path: Path, wanted: str) -> bpy.types.Object | None:
    """The SNeRG object that a volume belongs to: the one of the full name `wanted`, else any that shows its scene; None where none does."""
    shown = [thing for thing in snerg_objects(scene) if volume_path(project, folder_of(thing)) == path]
    return next((thing for thing in shown if thing.name_full == wanted), shown[0] if shown else None)


def add_volume(parent: bpy.types.Object, path: Path, scene: bpy.types.Scene) -> bpy.types.Object:
    """A Volume object of a .vdb file, as a child of a SNeRG object; one that shows the file already is kept. Others share its data."""
    shown = [data for data in bpy.data.volumes if data.library is None and absolute_path(data.filepath, scene) == path]
    for data in shown:
        data.grids.unload()  # written again
    for child in parent.children:
        if child.type == "VOLUME" and child.data in shown:
            return child
    volume = shown[0] if shown else bpy.data.volumes.new(NAME)
    if not shown:
        volume.filepath = blend_path(path)
        volume.materials.append(material())
    thing = bpy.data.objects.new(NAME, volume)
    thing.parent = parent
    link_beside(thing, parent, scene)
    return thing


def material() -> bpy.types.Material:
    """Extinction by the grid `density`, scattering in the colours of the grid `color`.

    The colours hold the light under which the scene was photographed; Emission Strength of 1 shows them as they were.
    """
    known = [made for made in bpy.data.materials if made.name == NAME and made.library is None]
    if known:
        return known[0]
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
