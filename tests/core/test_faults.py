"""A fault at every write, rename, flush and new folder of every save: the old result is there or the new one, whole."""

import json
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from faults import Faults

from scenes import make_cameras, make_snerg
from snerg.core.baking.resume import ResumeCache
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.export import export_reference
from snerg.core.commands.import_artifact import import_source
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import SnergError
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import read_scene, write_scene
from snerg.core.io.files import discard, write_bytes
from snerg.core.io.json_files import json_bytes, read_json
from snerg.core.nerf.checkpoint import read_field_and_state, write_field
from snerg.core.nerf.field import Field
from snerg.core.nerf.hash_grid import HashGrid
from snerg.core.nerf.model import HashModelConfig, init_field
from snerg.core.nerf.sampling import Domain
from snerg.core.training.log import Log, read_log
from snerg.core.training.training_folder import finish


@dataclass(frozen=True)
class Save:
    """begin: puts the old result under a folder; write: puts the new one in its place; state: what a reader finds there."""

    begin: Callable[[Path], None]
    write: Callable[[Path], None]
    state: Callable[[Path], object]


def field(steps: int) -> Field:
    """A field that says how long it was trained, in its arrays too."""
    domain = Domain.around(np.full(3, -1.0), np.full(3, 1.0))
    family = HashModelConfig(HashGrid(levels=2, coarsest=4, finest=8, log2_size=8), width=8)
    drawn = init_field(family, "diffuse", np.random.default_rng(0))["field"]
    params = {name: np.full_like(array, steps) for name, array in drawn.items()}
    return Field(family, params, None, domain, None, 0.01, about={"steps": steps}, view="diffuse")


def training_state(folder: Path) -> object:
    """The steps of a field, which its parameters and training state bear out, and of its log."""
    found, state = read_field_and_state(folder)
    steps = found.about["steps"]
    assert all((array == steps).all() for array in found.params.values()) and (not state or state["clock"] == steps)
    return steps, [line["step"] for line in read_log(folder)]


def checkpoint(folder: Path, steps: int) -> None:
    write_field(field(steps), folder / "field", {"clock": np.array(steps)})


def begin_training(folder: Path) -> None:
    Log(folder / "field", 0).add(step=1)
    checkpoint(folder, 1)


def begin_versions(folder: Path) -> None:
    """A finished field, and another that was trained beside it."""
    begin_training(folder)
    write_field(field(1), folder / "field")
    Log(folder / ".field.training-01234567", 0).add(step=2)
    write_field(field(2), folder / ".field.training-01234567")


def scene(which: int):
    return replace(make_snerg((31, 20, 20)), about={"which": which})


def scene_state(path: Path) -> object:
    return read_scene(path).about["which"]


def with_source(write: Callable[[object, Path], None], old: Callable[[Path], None]) -> Callable[[Path], None]:
    """Something to make the new result of, and the old result."""

    def begin(folder: Path) -> None:
        write(scene(2), folder / "source")
        old(folder)

    return begin


def kept(folder: Path, parts: int) -> None:
    work = ResumeCache(folder / ".scene.bake", "key")
    for part in range(parts):
        work.add("stage", part, {"cells": np.full(8, part)})
        work.flush()


def kept_state(folder: Path) -> object:
    work = ResumeCache(folder / ".scene.bake", "key")
    found = sorted((part, int(arrays["cells"].sum())) for part, arrays in work.read("stage"))
    assert found == [(part, 8 * part) for part in range(len(found))]
    return len(found)


def rendered(folder: Path) -> None:
    write_transforms(folder / "cameras.json", make_cameras(width=16, height=12)[:2], ["a", "b"])
    (folder / "out").mkdir()
    write_scene(scene(2), folder / "source")
    shutil.copytree(folder / "source", folder / "out", dirs_exist_ok=True)


def page_state(folder: Path) -> object:
    """Of a page in one file: its end is there once; of another: the scene in it."""
    page = folder / "out" / "index.html"
    text = page.read_text()
    assert text.count("</html>") == 1
    return len(text) if len(text) > 2**18 else scene_state(folder / "out" / "scene")


def row(number: int) -> Callable[[Path], None]:
    return lambda folder: write_bytes(folder / "rows" / "a.json", json_bytes({"key": "a", "psnr": number}))


SAVES = {
    "training's save": Save(begin_training, lambda f: checkpoint(f, 2), lambda f: training_state(f / "field")),
    "training's end": Save(begin_training, lambda f: write_field(field(2), f / "field"), lambda f: training_state(f / "field")),
    "training's log": Save(begin_training, lambda f: Log(f / "field", 1), lambda f: training_state(f / "field")),
    "training over a field": Save(
        begin_versions, lambda f: finish(f / ".field.training-01234567", f / "field"), lambda f: training_state(f / "field")
    ),
    "bake's parts": Save(lambda f: kept(f, 1), lambda f: kept(f, 3), kept_state),
    "scene": Save(lambda f: write_scene(scene(1), f / "out"), lambda f: write_scene(scene(2), f / "out"), lambda f: scene_state(f / "out")),
    "import of a scene": Save(
        with_source(write_reference, lambda f: write_scene(scene(1), f / "out")),
        lambda f: import_source(f / "source", f / "out"),
        lambda f: scene_state(f / "out"),
    ),
    "import of a field": Save(
        lambda f: (begin_training(f), write_field(field(2), f / "source")),
        lambda f: import_source(f / "source", f / "field"),
        lambda f: training_state(f / "field"),
    ),
    "export": Save(
        with_source(write_scene, lambda f: write_reference(scene(1), f / "out")),
        lambda f: export_reference(f / "source", f / "out"),
        lambda f: read_json(f / "out" / "scene_params.json")["snerg_for_blender"]["about"]["which"],
    ),
    "page": Save(
        with_source(write_scene, lambda f: write_scene(scene(1), f / "before") or bundle_scene(f / "before", f / "out")),
        lambda f: bundle_scene(f / "source", f / "out"),
        page_state,
    ),
    "page in one file": Save(
        with_source(write_scene, lambda f: write_scene(scene(1), f / "before") or bundle_scene(f / "before", f / "out")),
        lambda f: bundle_scene(f / "source", f / "out", single_file=True),
        page_state,
    ),
    "row of a study": Save(row(1), row(2), lambda f: json.loads((f / "rows" / "a.json").read_text())["psnr"]),
}


def names(folder: Path) -> set[str]:
    """All that lies in a folder and beside the results."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def run(save: Save, folder: Path, template: Path, at: int | None) -> tuple[Faults, str | None]:
    """Save once over a fresh copy of the old result, with a fault; the sentence that it ended in."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(template, folder)
    faults = Faults(at)
    try:
        with faults.injected():
            save.write(folder)
    except SnergError as error:
        return faults, str(error)
    return faults, None


def sweep(save: Save, folder: Path, every: int = 1) -> Counter:
    """A fault at every call in turn, or every n-th; how many, by what was found. Fails on half a result or anything left behind."""
    template, place = folder / "template", folder / "place"
    template.mkdir()
    save.begin(template)
    old, old_names = save.state(template), names(template)
    whole, said = run(save, place, template, None)
    assert said is None
    new, new_names = save.state(place), names(place)
    assert old != new or old_names != new_names or save is SAVES["training's log"]
    found: Counter = Counter()
    for at in range(0, whole.count, every):
        faults, said = run(save, place, template, at)
        state, left = save.state(place), names(place)
        where = f"{faults.kind}, call {at} of {whole.count}: {said}"
        if said is None:
            assert state == new and left == new_names, where
            found["done all the same"] += 1
        else:
            assert said.startswith("Cannot write ") and said.count("\n") == 0 and said.endswith("."), where
            assert state == old or save is SAVES["bake's parts"], where
            assert left == old_names or save is SAVES["bake's parts"], where
            assert not [name for name in left if name.endswith((".part", ".old", ".lock"))], where
            found["refused, the old is there"] += 1
        if save is not SAVES["training over a field"] or (place / ".field.training-01234567").exists():
            save.write(place)  # once more, on a disk that works again, over what the fault left
        assert save.state(place) == new, where
    return found


LONG = ("scene", "import of a scene", "export", "page", "page in one file")  # most of their calls are of pictures, all alike


@pytest.mark.hard_case(60)
@pytest.mark.parametrize("kind", SAVES)
def test_a_fault_at_a_step_of_a_save(tmp_path, kind):
    assert sweep(SAVES[kind], tmp_path, 7 if kind in LONG else 1)["refused, the old is there"] > 2


@pytest.mark.slow
@pytest.mark.hard_case(60)
@pytest.mark.parametrize("kind", LONG)
def test_a_fault_at_every_step_of_a_save(tmp_path, kind):
    found = sweep(SAVES[kind], tmp_path)
    print(f"{kind}: {sum(found.values())} faults, {dict(found)}")


def test_a_folder_of_a_bake_goes_without_a_rest(tmp_path):
    kept(tmp_path, 2)
    discard(tmp_path / ".scene.bake")
    assert not list(tmp_path.iterdir())
