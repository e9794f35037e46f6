"""The graphics card's memory: scenes, pictures of regions, the bound of the preferences, and what the card refuses."""

from __future__ import annotations

import traceback
from pathlib import Path

import bpy

from ...core.errors import SnergError
from ...core.scene.scene import Scene
from ..preferences import gpu_bytes
from ..scene_object import snerg_objects, source_of
from .gpu_scene import GpuScene, Target, bytes_of
from .loading import forget, in_use, keep
from .picture import Picture, forget_shader
from .slow import SlowPicture

NO_ROOM = "The viewport draws it slowly: it needs more graphics memory than the preferences allow."
NO_PICTURE = "The viewport does not draw it everywhere: its pictures need more graphics memory than the preferences allow."
REFUSED = (
    "The graphics card does not take it ({}), so that the viewport draws it slowly; bake it with fewer voxels, or close other programs "
    "that use the card and open the file again. F12 works."
)
Place = tuple[int, ...]  # the region's address, then which object or instance (Shown.place), its own number first
scenes: dict[int, GpuScene] = {}  # by the identity of the scene, which they hold
refused: dict[int, tuple[Scene, str]] = {}  # likewise: why the card does not take it
pictures: dict[Place, Picture] = {}
slow: dict[Place, tuple[SlowPicture, Target | None]] = {}
said: dict[Place, str] = {}  # why an object is not drawn, or slowly


def memory() -> int:
    """Bytes of the card's memory that scenes and pictures take."""
    drawn = sum(target.bytes for _, target in slow.values() if target is not None)
    return sum(held.bytes for held in scenes.values()) + sum(picture.bytes for picture in pictures.values()) + drawn


def room_for(size: int) -> bool:
    """Whether the preferences leave that many bytes."""
    return memory() + size <= gpu_bytes()


def problem_in_viewport(thing: bpy.types.Object) -> str:
    """Why a region does not draw an object, or draws it slowly, one sentence; '' where all draw it."""
    return next((text for place, text in said.items() if place[1] == thing.session_uid), "")


def held(scene: Scene) -> GpuScene | None:
    """A scene on the graphics card; None where the card refuses it, or the preferences leave no room once scenes that nothing shows any
    more are let go."""
    found = scenes.get(id(scene))
    if found is not None or id(scene) in refused:
        return found
    keep({folder for thing in snerg_objects(bpy.data) for folder in shown_from(thing)})
    for known in (scenes, refused):
        for key in [key for key, other in known.items() if not in_use(other.scene if isinstance(other, GpuScene) else other[0])]:
            del known[key]
    if not room_for(bytes_of(scene)):
        return None
    try:
        scenes[id(scene)] = GpuScene(scene)
    except Exception as error:  # Blender's own, of memory, of the driver: the others go on being drawn
        refuse(scene, error)
    return scenes.get(id(scene))


def refuse(scene: Scene, error: Exception) -> None:
    """Try a scene on the card no more until it is read again: it would fail at every redraw."""
    if not isinstance(error, ValueError | MemoryError):
        traceback.print_exception(error)
    scenes.pop(id(scene), None)
    refused[id(scene)] = scene, REFUSED.format(str(error).strip().rstrip(".") or type(error).__name__)


def shown_from(thing: bpy.types.Object) -> list[Path]:
    """The folder that an object's scene is read from; none where its packed scene is damaged."""
    try:
        return [source_of(thing)]
    except SnergError:
        return []


def forget_closed(manager: bpy.types.WindowManager) -> None:
    """Let go of pictures of regions that are closed and of objects that are gone."""
    regions = {region.as_pointer() for window in manager.windows for area in window.screen.areas for region in area.regions}
    objects = {thing.session_uid for thing in bpy.data.objects}
    for place in [place for place in {*pictures, *slow, *said} if place[0] not in regions or place[1] not in objects]:
        drop(place)


def forget_hidden(region: int, shown: set[Place]) -> None:
    """Let go of a region's pictures of what it shows no more."""
    for place in [place for place in {*pictures, *slow, *said} if place[0] == region and place not in shown]:
        drop(place)


def drop(place: Place) -> None:
    """Let go of the pictures at a place, and of what was said of them."""
    pictures.pop(place, None)
    said.pop(place, None)
    drop_slow(place)


def drop_slow(place: Place) -> None:
    """Let go of the slow picture at a place."""
    if place in slow:
        slow.pop(place)[0].close()


def clear() -> None:
    """Let go of everything."""
    for place in {*pictures, *slow, *said}:
        drop(place)
    scenes.clear()
    refused.clear()
    forget_shader()
    forget()
