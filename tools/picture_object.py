"""A baked scene among meshes, for the pictures of the object's life that pictures.py takes.

`python picture_object.py SCENE VDB FOLDER`, in the Python of this project, renders FOLDER/f12.png, composite.png and volume.png by Blender
as a module. picture_walk.py builds the same in Blender's window.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

SIZE = (640, 400)  # pixels
EYE, LENS = (1.5, -3.6, 1.9), 45  # world units, mm
SAMPLES = {"composite": 48, "volume": 16}  # of Cycles; denoised
Colour = tuple[float, float, float]


def build(folder: Path) -> bpy.types.Object:
    """Empty the scene, and put the baked scene among meshes: a ring that passes through it, a slab behind and a cone in front. Returns the
    baked scene's object, selected and active."""
    empty()
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_torus_add(major_radius=0.92, minor_radius=0.05, major_segments=96, minor_segments=24, location=(0, 0, 0.3))
    bpy.context.object.rotation_euler = (0.5, 0.25, 0)
    _colour("Ring", (0.28, 0.08, 0.5))
    bpy.ops.mesh.primitive_cube_add(size=1, location=(-0.5, 1.35, 0.45), scale=(1.7, 0.1, 1.1))
    _colour("Slab", (0.1, 0.35, 0.12))
    bpy.ops.mesh.primitive_cone_add(vertices=64, radius1=0.17, depth=0.48, location=(0.72, -0.8, 0.24))
    _colour("Cone", (0.8, 0.35, 0.03))
    _light("Key", (2.5, -2.0, 3.5), 110, 1.0)
    _light("Fill", (-3.0, -2.0, 2.0), 25, 2.0)
    bpy.ops.object.camera_add(location=EYE)
    scene.camera = camera = bpy.context.object
    camera.rotation_euler = (Vector((0, 0, 0.3)) - Vector(EYE)).to_track_quat("-Z", "Y").to_euler()
    camera.data.lens, camera.data.display_size = LENS, 0.3
    scene.world = scene.world or bpy.data.worlds.new("World")
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = *SIZE, 100
    bpy.ops.snerg.add_scene(directory=str(folder))
    return bpy.context.object


def empty() -> None:
    """Remove all objects."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)


def _colour(name: str, colour: Colour) -> None:
    """Name the active object, and give it a material of a colour, which Solid mode shows too."""
    thing = bpy.context.object
    thing.name = name
    material = bpy.data.materials.new(name)
    if not material.node_tree:
        material.use_nodes = True
    shader = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")
    shader.inputs["Base Color"].default_value = (*colour, 1)
    material.diffuse_color = (*colour, 1)
    thing.data.materials.append(material)
    for polygon in thing.data.polygons:
        polygon.use_smooth = name != "Slab"


def _light(name: str, place: tuple[float, float, float], watts: float, size: float) -> None:
    """A square lamp that shines on the still life."""
    bpy.ops.object.light_add(type="AREA", location=place)
    lamp = bpy.context.object
    lamp.name, lamp.data.energy, lamp.data.size = name, watts, size
    lamp.rotation_euler = (-Vector(place)).to_track_quat("-Z", "Y").to_euler()


def main() -> None:
    """Render the three pictures."""
    source, vdb, folder = (Path(argument).resolve() for argument in sys.argv[1:])
    import snerg
    from snerg.snerg_addon.volume import add_volume

    snerg.register()
    bpy.ops.wm.save_as_mainfile(filepath=str(folder / "object.blend"))  # its project lies beside it
    build(source)
    scene = bpy.context.scene
    scene.view_settings.view_transform = "Standard"  # as docs/blender.md recommends
    scene.render.engine, scene.render.film_transparent = "SNERG", False
    _grey_world(scene, 0.6)
    write(folder / "f12.png")
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = SAMPLES["composite"], True, 0
    if bpy.ops.snerg.composite() != {"FINISHED"}:
        sys.exit("Composite with This Render failed.")
    write(folder / "composite.png")
    add_volume(scene, vdb, source)
    light_volume(scene)
    write(folder / "volume.png")


def light_volume(scene: bpy.types.Scene) -> None:
    """Only the volume of the object, on a floor, under one small lamp."""
    scene.render.use_compositing = scene.render.film_transparent = False
    for other in scene.objects:
        other.hide_render = other.type in ("MESH", "LIGHT")
    bpy.ops.mesh.primitive_plane_add(size=60, location=(0, 0, -0.11))
    _colour("Floor", (0.22, 0.22, 0.22))
    _light("Lamp", (-3.0, -1.4, 2.6), 520, 0.35)
    _grey_world(scene, 0.25)
    cycles = scene.cycles
    cycles.samples, cycles.volume_bounces, cycles.max_bounces = SAMPLES["volume"], 2, 3


def _grey_world(scene: bpy.types.Scene, level: float) -> None:
    """Light of one grey from everywhere, which the engine SNeRG shows too."""
    scene.world.color = (level, level, level)
    if not scene.world.node_tree:
        scene.world.use_nodes = True
    background = next(node for node in scene.world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (level, level, level, 1)


def write(path: Path) -> None:
    """Render the scene into a PNG."""
    scene: Any = bpy.context.scene
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main()
