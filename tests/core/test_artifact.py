"""What lies at a path, and what a file inside a folder stands for."""

import shutil

import numpy as np
import pytest
from captures import ring, write_ngp

from flax_checkpoint import networks, tree, write
from scenes import make_snerg
from snerg.core.artifact import FIELDS, SCENES, artifact_at, check_kind, kind_of, open_artifact
from snerg.core.commands.bundle import bundle_scene
from snerg.core.errors import SnergError
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import write_scene
from snerg.core.nerf.checkpoint import write_field
from snerg.core.nerf.reference_checkpoint import field_of, read_reference_checkpoint
from snerg.core.scene.scene import Scene


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """A folder with one artifact of every kind."""
    room = tmp_path_factory.mktemp("room")
    scene = make_snerg((34, 30, 20))
    write_scene(scene, room / "scene")
    write_reference(scene, room / "reference scene")
    bundle_scene(room / "scene", room / "page")
    (room / "dataset").mkdir()
    write_ngp(room / "dataset", ring(4))
    (room / "checkpoint").mkdir()
    path = write(room / "checkpoint/checkpoint_3", tree(networks(np.random.default_rng(0))))
    (room / "field").mkdir()
    write_field(field_of(read_reference_checkpoint(path), "here"), room / "field")
    (room / "field/log.csv").write_text("step\n")
    return room


FILES = {
    "scene": ["scene.json", "indirection.png", "rgba_000.png"],
    "reference scene": ["scene_params.json", "atlas_indices.png", "rgba_000.png", "feature_000.png"],
    "page": ["index.html"],
    "field": ["field.npz", "log.csv"],
    "dataset": ["transforms.json"],
    "checkpoint": ["checkpoint_3"],
}


@pytest.mark.parametrize("kind", FILES)
def test_a_file_inside_stands_for_the_folder(room, kind):
    assert kind_of(room / kind) == kind
    for name in FILES[kind]:
        assert kind_of(room / kind / name) == kind


def test_what_a_file_stands_for(room, tmp_path):
    assert artifact_at(room / "scene/scene.json") == room / "scene"
    assert artifact_at(room / "page/scene/scene.json") == room / "page/scene"
    assert artifact_at(room / "page/index.html") == room / "page"
    for name in ("field/field.npz", "checkpoint/checkpoint_3", "dataset/transforms.json"):
        assert artifact_at(room / name) == room / name  # opened as they are
    picture = next((room / "dataset").rglob("*.png"))
    assert artifact_at(picture) == room / "dataset"
    other = shutil.copy(picture, tmp_path / "alone.png")
    assert artifact_at(tmp_path / "alone.png") == tmp_path / "alone.png" == other
    assert isinstance(open_artifact(room / "reference scene/rgba_000.png"), Scene)


@pytest.mark.parametrize(
    ("there", "wanted", "noun", "words"),
    [
        ("checkpoint/checkpoint_3", SCENES, "baked scene", "a checkpoint of the published code, not a baked scene; use Import Field"),
        ("scene", FIELDS, "field", "is a baked scene, not a field; use Import Scene"),
        ("reference scene/rgba_000.png", FIELDS, "field", "is a baked scene, not a field; use Import Scene"),
        ("page", ("dataset",), "dataset", "is a web page of a baked scene, not a dataset; use Import Scene"),
        ("dataset", SCENES, "baked scene", "is a dataset, not a baked scene; use Import Dataset"),
        ("field/field.npz", ("dataset",), "dataset", "is a field, not a dataset; use Import Field"),
        ("nowhere", SCENES, "baked scene", "does not exist; choose the folder of a baked scene"),
    ],
)
def test_another_kind_is_refused_with_the_way_to_open_it(room, there, wanted, noun, words):
    with pytest.raises(SnergError, match=words):
        check_kind(room / there, wanted, noun)


def test_a_file_of_no_kind_is_not_called_a_checkpoint(tmp_path):
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(SnergError, match="is not a baked scene; choose the folder of one"):
        check_kind(tmp_path / "notes.txt", SCENES, "baked scene")
