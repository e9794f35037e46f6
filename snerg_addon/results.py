"""The list of what a project holds: datasets, fields and scenes with their figures. Choosing one makes it the current one.

Blender's lists show collections of properties, which nothing may change while they are drawn: the timer (operators/watch.py) keeps one
collection a project up to date. It is the window manager's, hence no part of the file, nor of undo.
"""

# mypy: disable-error-code="valid-type"
# Blender reads the annotations of properties as values, hence no postponed evaluation here.

from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, IntProperty, StringProperty

from ..core.artifact import is_dataset
from ..core.errors import SnergError
from . import activity
from .dataset_notes import noted_datasets
from .owner import absolute_path, blend_path
from .project import VERSIONS, Project, project_of


@dataclass(frozen=True)
class Result:
    """kind: 'dataset', 'field' or 'scene'. folder: its path. label: its name. in_use: whether it is current."""

    kind: str
    folder: str
    label: str
    in_use: bool


def results_of(project: Project) -> list[Result]:
    """What the project holds: its datasets, then the versions of field and scene, the newest first. Never raises."""
    found = []
    for path in known_datasets(project):
        label = "Rendered" if path == project.own_dataset else path.name
        found.append(Result("dataset", str(path), label, path == project.dataset))
    for kind in VERSIONS:
        in_use = project.in_use(kind)
        for version in reversed(project.versions(kind)):
            found.append(Result(kind, str(version), label_of(project, kind, version), version == in_use))
    return found


def label_of(project: Project, kind: str, version: Path) -> str:
    """The name that the artist gave a version, else 'Field 001'."""
    name = project.name_of(version)
    return name if name != version.name else f"{kind.title()} {name}"


def known_datasets(project: Project) -> list[Path]:
    """The project's own dataset, those that were imported or trained on, and the current one; of these, the ones that are there."""
    paths = dict.fromkeys([project.own_dataset, *noted_datasets(project), project.dataset])
    return [path for path in paths if is_dataset(path)]


def choose(scene: bpy.types.Scene, kind: str, folder: Path) -> None:
    """Make a result the current one of its kind. Raises SnergError where it is not there any more, or the project cannot be written."""
    project = project_of(scene)
    if kind == "dataset":
        if not is_dataset(folder):
            raise SnergError(f"{folder} is not there any more; it was renamed or removed.")
        scene.snerg.dataset = "" if folder == project.own_dataset else blend_path(folder)
        return
    if folder not in project.versions(kind):
        raise SnergError(f"The {kind} {folder.name} is not there any more; it was renamed or removed.")
    project.use(kind, folder)


def lost(project: Project, scene: bpy.types.Scene) -> list[str]:
    """A sentence for the project's folder, and for each version in use, that was renamed or removed outside Blender."""
    settings = scene.snerg
    if settings.project_id and settings.folder and bpy.data.filepath and not absolute_path(settings.folder, scene).is_dir():
        return [f"There is no folder {settings.folder}. Was it renamed? Choose it above, or a new project starts there."]
    sentences = []
    for kind in VERSIONS:
        chosen = project.chosen(kind)
        if chosen is not None and chosen not in (there := project.versions(kind)):
            instead = f"{project.in_use(kind).name} is used instead" if there else "there is no other"
            sentences.append(f"The {kind} {project.name_of(chosen)} was renamed or removed; {instead}.")
    return sentences


class SNERG_PG_result(bpy.types.PropertyGroup):
    """A dataset, a field or a scene of a project"""

    def _label(self) -> str:
        return str(self.shown)

    def _rename(self, name: str) -> None:
        project, version = project_of(bpy.context.scene), Path(self.folder)
        given = "" if name == f"{self.kind.title()} {version.name}" else name
        _do(project, lambda: project.rename(version, given))

    kind: StringProperty()
    folder: StringProperty()
    shown: StringProperty()
    label: StringProperty(name="Name", description="Double-click to rename. Empty: its number", get=_label, set=_rename)
    in_use: BoolProperty()


class SNERG_PG_results(bpy.types.PropertyGroup):
    """The results of a project; its name is the project's folder"""

    def _index(self) -> int:
        return int(self.active)

    def _choose(self, index: int) -> None:
        scene, chosen = bpy.context.scene, self.items[index]
        self.active = index
        _do(project_of(scene), lambda: choose(scene, chosen.kind, Path(chosen.folder)))

    items: CollectionProperty(type=SNERG_PG_result)
    active: IntProperty(default=-1)
    index: IntProperty(name="Result", description="Click to make it the current one", get=_index, set=_choose)


def _do(project: Project, work: Any) -> None:
    """Do what the list asks for, and show it; the panel shows what went wrong."""
    try:
        work()
    except SnergError as error:
        activity.report(project.folder, str(error), False)
    refresh()


def refresh() -> bool:
    """Bring the lists of all scenes' projects up to date. Returns whether one has changed."""
    manager, changed = bpy.context.window_manager, False
    for project in {project.folder: project for project in map(project_of, bpy.data.scenes)}.values():
        found, name = results_of(project), str(project.folder)
        shown = manager.snerg_results.get(name)
        if shown is None:
            shown = manager.snerg_results.add()
            shown.name = name
        if [_values(item) for item in shown.items] != [astuple(result) for result in found]:
            _fill(shown, found)
            changed = True
    return changed


def _values(item: Any) -> tuple[Any, ...]:
    return item.kind, item.folder, item.shown, item.in_use


def _fill(shown: Any, found: list[Result]) -> None:
    """Write the results into a list. Its active row stays with its result while that is in use, else with the one in its place."""
    old = shown.items[shown.active] if 0 <= shown.active < len(shown.items) else None
    kind, folder = (old.kind, old.folder) if old else ("", "")
    shown.items.clear()
    for result in found:
        item = shown.items.add()
        item.name, item.kind, item.folder = f"{result.kind} {result.label}", result.kind, result.folder
        item.shown, item.in_use = result.label, result.in_use
    used = [index for index, result in enumerate(found) if result.in_use]
    same = [index for index in used if found[index].folder == folder] or [index for index in used if found[index].kind == kind]
    shown.active = (same or used[-1:] or [-1])[0]


def shown_results(scene: bpy.types.Scene) -> Any:
    """The list of the scene's project (SNERG_PG_results); None before the timer has made it."""
    return bpy.context.window_manager.snerg_results.get(str(project_of(scene).folder))


def register() -> None:
    """Keep the lists with the window manager."""
    bpy.types.WindowManager.snerg_results = CollectionProperty(type=SNERG_PG_results)


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.snerg_results


CLASSES = (SNERG_PG_result, SNERG_PG_results)
