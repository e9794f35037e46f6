"""The demo's scene, built in Blender by script: a workbench still life with something glossy, thin and textured.

Run inside Blender (`blender -P demo/build_scene.py`) to see it, or call `build` from a script that has bpy.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import bpy

BOX_NAME = "SNeRG Box"
CAMERAS = 68
SIZE = 240  # pixels a side
SAMPLES = 12  # with denoising within 39 dB of a converged picture; without, twice as many take longer and reach less
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))
Colour = tuple[float, float, float]


def build(size: int = SIZE, samples: int = SAMPLES, cameras: int = CAMERAS) -> bpy.types.Scene:
    """Empty the scene and fill it: objects, lights, cameras, render settings and the box, which the scene's settings know.

    size: pixels a side. samples: Cycles samples a pixel. The add-on must be registered.
    """
    scene = bpy.context.scene
    _clear()
    _base()
    _sphere()
    _bricks()
    _knot()
    _rods()
    _mug()
    _lights(scene)
    _cameras(scene, cameras)
    _render_settings(scene, size, samples)
    box = bpy.data.objects.new(BOX_NAME, None)
    box.empty_display_type = "CUBE"
    box.location, box.scale = (0.0, 0.0, 0.44), (1.21, 1.21, 0.58)
    scene.collection.objects.link(box)
    if hasattr(scene, "snerg"):
        scene.snerg.box = box
    return scene


def _clear() -> None:
    for collection in (bpy.data.objects, bpy.data.meshes, bpy.data.materials, bpy.data.lights, bpy.data.cameras, bpy.data.curves):
        for thing in list(collection):
            collection.remove(thing)


def _render_settings(scene: bpy.types.Scene, size: int, samples: int) -> None:
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.resolution_x = render.resolution_y = size
    render.resolution_percentage = 100
    cycles.device = "CPU"
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    try:
        cycles.use_denoising, cycles.denoiser = True, "OPENIMAGEDENOISE"
        # Half the time of Cycles' defaults, for 0.6 dB less towards the converged picture.
        cycles.denoising_prefilter, cycles.denoising_quality = "NONE", "FAST"
    except TypeError:  # a Blender that was built without it, as Linux distributions do
        cycles.use_denoising, cycles.samples = False, 2 * samples
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 4, 2, 2
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.sample_clamp_indirect = 2.0
    cycles.blur_glossy = 1.0


# Materials


def _material(name: str, colour: Colour, roughness: float = 0.6, metallic: float = 0.0, coat: float = 0.0) -> bpy.types.Material:
    material = bpy.data.materials.new(name)
    _use_nodes(material)
    shader = _shader(material)
    shader.inputs["Base Color"].default_value = (*colour, 1.0)
    shader.inputs["Roughness"].default_value = roughness
    shader.inputs["Metallic"].default_value = metallic
    shader.inputs["Coat Weight"].default_value = coat
    shader.inputs["Coat Roughness"].default_value = 0.12
    return material


def _use_nodes(thing: bpy.types.Material | bpy.types.World) -> None:
    if bpy.app.version < (5, 0):  # from then on there is nothing else
        thing.use_nodes = True


def _shader(material: bpy.types.Material) -> Any:
    return next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


def _textured(material: bpy.types.Material, kind: str, settings: Callable[[Any], None], space: str = "Object") -> bpy.types.Material:
    """Drive the base colour by a texture node in the coordinates `space`."""
    tree = material.node_tree
    place, texture = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new(kind)
    settings(texture)
    tree.links.new(place.outputs[space], texture.inputs["Vector"])
    tree.links.new(texture.outputs["Color"], _shader(material).inputs["Base Color"])
    return material


def _add(thing: bpy.types.Object, name: str, material: bpy.types.Material, smooth: bool = True) -> bpy.types.Object:
    thing.name = name
    thing.data.materials.append(material)
    if smooth and thing.type == "MESH":
        thing.data.polygons.foreach_set("use_smooth", [True] * len(thing.data.polygons))
    return thing


def _bevel(thing: bpy.types.Object, width: float) -> None:
    bevel = thing.modifiers.new("Bevel", "BEVEL")
    bevel.width, bevel.segments = width, 3


# Objects


def _base() -> None:
    """A round board with a checker."""
    bpy.ops.mesh.primitive_cylinder_add(vertices=96, radius=1.15, depth=0.1, location=(0, 0, -0.05))

    def checker(node: Any) -> None:
        node.inputs["Scale"].default_value = 5.0
        node.inputs["Color1"].default_value = (0.62, 0.58, 0.50, 1)
        node.inputs["Color2"].default_value = (0.16, 0.24, 0.28, 1)

    material = _textured(_material("Board", (0.5, 0.5, 0.5), 0.7), "ShaderNodeTexChecker", checker)
    board = _add(bpy.context.object, "Board", material, smooth=False)
    _bevel(board, 0.02)


def _sphere() -> None:
    """Glossy: a lacquered red ball, and a small brass one."""
    bpy.ops.mesh.primitive_uv_sphere_add(segments=64, ring_count=32, radius=0.34, location=(-0.38, -0.36, 0.34))
    _add(bpy.context.object, "Lacquer Ball", _material("Red Lacquer", (0.62, 0.035, 0.03), 0.35, coat=0.8))
    bpy.ops.mesh.primitive_uv_sphere_add(segments=48, ring_count=24, radius=0.16, location=(0.12, -0.78, 0.16))
    _add(bpy.context.object, "Brass Ball", _material("Brass", (0.85, 0.58, 0.22), 0.32, metallic=1.0))


def _bricks() -> None:
    """Textured: a stack of brick blocks."""

    def brick(node: Any) -> None:
        node.inputs["Scale"].default_value = 8.0
        node.inputs["Color1"].default_value = (0.58, 0.24, 0.12, 1)
        node.inputs["Color2"].default_value = (0.72, 0.40, 0.20, 1)
        node.inputs["Mortar"].default_value = (0.72, 0.68, 0.60, 1)
        node.inputs["Mortar Size"].default_value = 0.025

    material = _textured(_material("Bricks", (0.6, 0.3, 0.2), 0.85), "ShaderNodeTexBrick", brick, "UV")
    blocks = (((0.56, 0.56, 0.46), (0.42, 0.40, 0.23), 0.4), ((0.34, 0.34, 0.30), (0.40, 0.42, 0.61), 0.95))
    for index, (size, place, turn) in enumerate(blocks):
        bpy.ops.mesh.primitive_cube_add(size=1, location=place, rotation=(0, 0, turn))
        thing = _add(bpy.context.object, f"Block {index + 1}", material, smooth=False)
        thing.scale = size
        bpy.ops.object.transform_apply(location=False, rotation=False, scale=True)
        _bevel(thing, 0.015)


def _knot() -> None:
    """A teal trefoil standing behind the ball."""
    points = []
    for step in range(120):
        t = 2 * math.pi * step / 120
        points.append((math.sin(t) + 2 * math.sin(2 * t), math.cos(t) - 2 * math.cos(2 * t), -math.sin(3 * t)))
    knot = _tube("Knot", points, 0.075, _material("Teal", (0.02, 0.30, 0.33), 0.3, coat=0.4), scale=0.125)
    knot.location, knot.rotation_euler = (-0.48, 0.42, 0.44), (math.radians(90), 0, math.radians(35))


def _rods() -> None:
    """Thin: a wire globe on a rod."""
    steel = _material("Steel Wire", (0.30, 0.31, 0.33), 0.4, metallic=0.6)
    place = (0.62, -0.38, 0.0)
    rod = _tube("Rod", [(0, 0, 0), (0, 0, 0.48)], 0.016, steel, closed=False)
    rod.location = place
    ring = [(math.cos(2 * math.pi * s / 64), math.sin(2 * math.pi * s / 64), 0.0) for s in range(64)]
    for index in range(3):
        wire = _tube(f"Ring {index + 1}", ring, 0.013, steel, scale=0.24)
        wire.location = (place[0], place[1], 0.72)
        wire.rotation_euler = (math.radians(90), 0, math.radians(60 * index))
    wire = _tube("Equator", ring, 0.013, steel, scale=0.24)
    wire.location = (place[0], place[1], 0.72)
    bpy.ops.mesh.primitive_ico_sphere_add(subdivisions=4, radius=0.085, location=(place[0], place[1], 0.72))
    _add(bpy.context.object, "Globe Heart", _material("Yellow", (0.85, 0.55, 0.03), 0.5))


def _mug() -> None:
    """A white mug: hollow, with a handle and a blue band."""
    profile = [(0.0, 0.0), (0.17, 0.0), (0.19, 0.02), (0.19, 0.36), (0.18, 0.37), (0.165, 0.36), (0.165, 0.05), (0.0, 0.04)]
    steps, vertices, faces = 48, [], []
    for radius, height in profile:
        vertices += [(radius * math.cos(2 * math.pi * s / steps), radius * math.sin(2 * math.pi * s / steps), height) for s in range(steps)]
    for row in range(len(profile) - 1):
        for s in range(steps):
            a, b = row * steps + s, row * steps + (s + 1) % steps
            faces.append((a, b, b + steps, a + steps))
    mesh = bpy.data.meshes.new("Mug")
    mesh.from_pydata(vertices, [], faces)
    china = _material("China", (0.80, 0.79, 0.76), 0.35, coat=0.3)
    mug = bpy.data.objects.new("Mug", mesh)
    bpy.context.collection.objects.link(mug)
    _add(mug, "Mug", china)
    mesh.materials.append(_material("Blue Band", (0.03, 0.10, 0.42), 0.4, coat=0.3))
    mesh.update()
    handle = [(0.18 + 0.12 * math.sin(a), 0.0, 0.19 - 0.11 * math.cos(a)) for a in (math.pi * s / 24 for s in range(25))]
    _tube("Mug Handle", handle, 0.022, china, closed=False).parent = mug
    band = [(0.192 * math.cos(2 * math.pi * s / 64), 0.192 * math.sin(2 * math.pi * s / 64), 0.27) for s in range(64)]
    _tube("Mug Band", band, 0.014, mesh.materials[1]).parent = mug
    mug.location, mug.rotation_euler = (0.02, 0.80, 0.0), (0, 0, math.radians(60))


def _tube(
    name: str,
    points: Iterable[tuple[float, float, float]],
    radius: float,
    material: bpy.types.Material,
    scale: float = 1.0,
    closed: bool = True,
) -> bpy.types.Object:
    """A round tube along points."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution, curve.use_fill_caps = "3D", radius, 4, True
    spline = curve.splines.new("POLY")
    path = [tuple(scale * value for value in point) for point in points]
    spline.points.add(len(path) - 1)
    for target, point in zip(spline.points, path, strict=True):
        target.co = (*point, 1.0)
    spline.use_cyclic_u = closed
    spline.use_smooth = True
    thing = bpy.data.objects.new(name, curve)
    bpy.context.collection.objects.link(thing)
    return _add(thing, name, material)


# Lights and cameras


def _lights(scene: bpy.types.Scene) -> None:
    """A soft key whose reflection is the highlight, a cool fill, a rim, and a pale sky."""
    for name, place, size, watts, colour in (
        ("Key", (2.6, -2.2, 3.6), 1.4, 150.0, (1.0, 0.95, 0.88)),
        ("Fill", (-3.4, -1.4, 2.2), 2.4, 45.0, (0.80, 0.88, 1.0)),
        ("Rim", (0.6, 3.4, 2.8), 1.6, 80.0, (1.0, 0.97, 0.92)),
    ):
        data = bpy.data.lights.new(name, "AREA")
        data.shape, data.size, data.energy, data.color = "DISK", size, watts, colour
        light = bpy.data.objects.new(name, data)
        light.location = place
        _aim(light, (0, 0, 0.3))
        scene.collection.objects.link(light)
    world = scene.world or bpy.data.worlds.new("World")
    scene.world = world
    _use_nodes(world)
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (0.72, 0.80, 0.92, 1)
    background.inputs["Strength"].default_value = 0.3


def _cameras(scene: bpy.types.Scene, count: int) -> None:
    """Cameras over the upper hemisphere, of two focal lengths, none of them level with the board."""
    lenses = [bpy.data.cameras.new(f"Lens {index + 1}") for index in range(2)]
    lenses[0].lens, lenses[1].lens = 50.0, 60.0
    for index in range(count):
        z = 0.97 - 0.88 * (index + 0.5) / count
        across, around = math.sqrt(1 - z * z), GOLDEN_ANGLE * index
        camera = bpy.data.objects.new(f"Camera {index:02d}", lenses[index % 2])
        distance = 3.9 if index % 2 == 0 else 4.6
        camera.location = (distance * across * math.cos(around), distance * across * math.sin(around), 0.35 + distance * z)
        _aim(camera, (0, 0, 0.35))
        scene.collection.objects.link(camera)
    scene.camera = bpy.data.objects[f"Camera {count * 5 // 8:02d}"]


def _aim(thing: bpy.types.Object, target: tuple[float, float, float]) -> None:
    direction = thing.location.copy()
    direction.x, direction.y, direction.z = (b - a for a, b in zip(thing.location, target, strict=True))
    thing.rotation_euler = direction.to_track_quat("-Z", "Y").to_euler()


if __name__ == "__main__":
    build()
