"""Baked scenes by their folder, read in a thread, so that the window stays free; read again when their files change."""

from __future__ import annotations

import threading
import traceback
from dataclasses import dataclass
from pathlib import Path

from ...core.artifact import open_scene
from ...core.errors import SnergError
from ...core.scene.scene import Scene


@dataclass
class Loaded:
    """A folder's scene once it is read; problem: why it cannot be shown, one sentence. Both empty: it is being read."""

    stamp: int
    scene: Scene | None = None
    problem: str = ""
    thread: threading.Thread | None = None


_known: dict[Path, Loaded] = {}


def loaded(folder: Path) -> Loaded:
    """What is known of the scene in a folder; the first time it begins to be read. Never raises."""
    stamp = stamp_of(folder)
    found = _known.get(folder)
    if found is None or found.stamp != stamp:
        found = Loaded(stamp, found.scene if found is not None and stamp else None)  # shown until the new one is read
        if stamp == 0:
            found.problem = f"There is no baked scene in {folder}; choose another folder, or bake again."
        else:
            found.thread = threading.Thread(target=_read, args=(folder, found), daemon=True)
            found.thread.start()
        _known[folder] = found  # last: another thread that finds it may wait for its thread
    return found


def cached(folder: Path) -> Scene:
    """The scene in a folder, read now where it has not been yet. Raises SnergError when it cannot be."""
    entry = loaded(folder)
    if entry.thread is not None:
        entry.thread.join()
    if entry.scene is None:
        raise SnergError(entry.problem)
    return entry.scene


def reading() -> bool:
    """Whether a scene is being read now."""
    return any(entry.thread is not None and entry.thread.is_alive() for entry in list(_known.values()))


def keep(folders: set[Path]) -> None:
    """Let go of the scenes of all other folders."""
    for folder in [folder for folder in list(_known) if folder not in folders]:
        del _known[folder]


def in_use(scene: Scene) -> bool:
    """Whether a folder's files are still those of this scene."""
    return any(entry.scene is scene for entry in list(_known.values()))


def forget() -> None:
    """Let go of every scene."""
    _known.clear()


def stamp_of(folder: Path) -> int:
    """Another number when the folder's files were written again, 0 where it has none."""
    for name in ("scene.json", "scene_params.json", "scene/scene.json"):
        try:
            return (folder / name).stat().st_mtime_ns
        except OSError:
            continue
    return 0


def has_scene(folder: Path) -> bool:
    """Whether a folder has the file that each baked scene has; not whether that can be read."""
    return stamp_of(folder) != 0


def _read(folder: Path, entry: Loaded) -> None:
    try:
        entry.scene = open_scene(folder)
    except SnergError as error:
        entry.scene, entry.problem = None, str(error)
    except Exception as error:  # said on the object, and in the console
        traceback.print_exception(error)
        entry.scene = None
        entry.problem = f"{folder} cannot be shown ({type(error).__name__}: {error}); Blender's console says where."
