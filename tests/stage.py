"""Things to put into a Blender scene in a test."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import bpy

from snerg.snerg_addon.project import Project, remember


def add_camera(name: str = "Camera", location: tuple[float, float, float] = (0.0, 0.0, 5.0), **settings: Any) -> Any:
    """A camera that looks down."""
    data = bpy.data.cameras.new(name)
    for key, value in settings.items():
        setattr(data, key, value)
    camera = bpy.data.objects.new(name, data)
    camera.location = location
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.view_layer.update()
    return camera


def add_plane(size: float = 1.0, location: tuple[float, float, float] = (0.0, 0.0, 0.0), emission: float = 0.5) -> Any:
    """A square that glows evenly, whatever the light."""
    half = size / 2
    mesh = bpy.data.meshes.new("Plane")
    mesh.from_pydata([(-half, -half, 0), (half, -half, 0), (half, half, 0), (-half, half, 0)], [], [(0, 1, 2, 3)])
    material = bpy.data.materials.new("Glow")
    tree = material.node_tree
    tree.nodes.clear()
    glow, out = tree.nodes.new("ShaderNodeEmission"), tree.nodes.new("ShaderNodeOutputMaterial")
    glow.inputs["Color"].default_value = (emission, emission, emission, 1)
    tree.links.new(glow.outputs[0], out.inputs["Surface"])
    mesh.materials.append(material)
    plane = bpy.data.objects.new("Plane", mesh)
    plane.location = location
    bpy.context.scene.collection.objects.link(plane)
    bpy.context.view_layer.update()
    return plane


def contents(folder: Path) -> dict[str, bytes]:
    """{path: bytes} of all files of a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def a_version(project: Project, step: str, psnr: float | None = None) -> Path:
    """A new version as a job writes it: finished with this PSNR, or stopped where psnr is None."""
    version = project.new_version(step)
    (version / {"field": "field.npz", "scene": "scene.json"}[step]).write_bytes(str(psnr).encode())
    if psnr is not None:
        remember(project, step, version, {"psnr": psnr})
    return version
