"""Things to put into a Blender scene in a test."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import bpy

from snerg.snerg_addon.project import Project, remember


def empty_scene() -> Any:
    """The scene of a new file without objects, with fast render settings.

    A new file takes milliseconds. Whatever is deleted or set back by name leaves the rest to the next test: a cursor that a test had
    moved was where Blender added another test's objects.
    """
    bpy.ops.wm.read_homefile(use_factory_startup=True)
    for things in (bpy.data.objects, bpy.data.collections, bpy.data.meshes, bpy.data.cameras, bpy.data.materials, bpy.data.lights):
        for thing in list(things):
            things.remove(thing)
    scene = bpy.context.scene
    render = scene.render
    render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 1, False
    render.resolution_x, render.resolution_y = 32, 24
    return scene


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


def every_setting(thing: Any, path: str = "", depth: int = 0) -> dict[str, Any]:
    """{path: value} of all readable properties of a Blender struct and of the structs that it owns."""
    found: dict[str, Any] = {}
    for prop in thing.bl_rna.properties:
        if prop.identifier in ("rna_type", "is_evaluated", "bindings"):
            continue
        value, name = getattr(thing, prop.identifier), f"{path}.{prop.identifier}"
        if prop.type == "POINTER":
            if isinstance(value, bpy.types.ID) or value is None:
                found[name] = getattr(value, "name_full", None)
            elif depth < 4:
                found.update(every_setting(value, name, depth + 1))
        elif prop.type == "COLLECTION":
            found[name] = [getattr(item, "name", "") for item in value]
        else:
            found[name] = list(value) if getattr(prop, "is_array", False) else value
    return found


def state(scene: Any) -> dict[str, Any]:
    """All properties of the scene that rendering could change, and the names of all data-blocks."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # what Blender is going to remove is still the artist's
        settings = every_setting(scene)
    kinds = ("objects", "cameras", "scenes", "meshes", "worlds", "collections")
    lists = {kind: sorted(thing.name for thing in getattr(bpy.data, kind)) for kind in kinds}
    return {**settings, **lists}


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
