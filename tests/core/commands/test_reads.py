"""Each command reads the header of each image once, and decodes each image once."""

import json
from collections import Counter

import pytest

from snerg.core.baking.bake import BakeSettings
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.effects import effects
from snerg.core.commands.info import info
from snerg.core.commands.train import train_field
from snerg.core.data import dataset as dataset_module
from snerg.core.data.load import read_dataset, read_split
from snerg.core.data.readers import transforms
from snerg.core.io.images import read_image, write_png
from snerg.core.study.evaluate import evaluate

VIEWS = 15


@pytest.fixture(scope="module")
def capture(dataset, tmp_path_factory):
    """The views of the small dataset in one transforms.json, as other tools write it, one of them with a mask."""
    root = tmp_path_factory.mktemp("capture") / "capture"
    root.mkdir()
    frames = []
    for split in ("train", "test"):
        value = json.loads((dataset / f"transforms_{split}.json").read_text())
        for frame in value["frames"]:
            name = f"{len(frames):03d}.png"
            image = read_image(dataset / f"{frame['file_path']}.png")
            write_png(root / name, image)
            frames.append({**frame, "file_path": name})
    write_png(root / "mask.png", image[..., :1].repeat(3, axis=-1) | 255)
    frames[1]["mask_path"] = "mask.png"
    (root / "transforms.json").write_text(json.dumps({**value, "frames": frames}))
    return root


@pytest.fixture
def reads(monkeypatch):
    """How often the header of each image was read, and how often its pixels, by (function, file)."""
    count: Counter[tuple[str, str]] = Counter()

    def counting(module, name):
        function = getattr(module, name)

        def counted(path, *args):
            count[name, str(path)] += 1
            return function(path, *args)

        monkeypatch.setattr(module, name, counted)

    for module, name in ((dataset_module, "read_image"), (dataset_module, "read_size"), (transforms, "read_size")):
        counting(module, name)
    return count


def most(count, function):
    """The most often that a function was called for one file."""
    return max((times for (name, _), times in count.items() if name == function), default=0)


def test_another_split_reads_nothing_again(capture, reads):
    train = read_dataset(capture)
    val = read_split(train, "val")
    assert len(train.views) + len(val.views) == VIEWS
    assert len(reads) == VIEWS and most(reads, "read_size") == 1
    again = read_dataset(capture, "val")
    assert [view.image for view in again.views] == [view.image for view in val.views]
    for one, other in zip(again.cameras, val.cameras, strict=True):
        assert one.to_json() == other.to_json()


def test_a_split_in_a_file_of_its_own_is_read_from_it(dataset, reads):
    train = read_dataset(dataset)
    assert len(read_split(train, "test").views) == 3
    assert most(reads, "read_size") == 1


@pytest.mark.parametrize("command", [info, effects])
def test_info_and_effects_read_each_image_once(command, capture, reads):
    command(capture)
    assert sum(name == "read_size" for name, _ in reads) == VIEWS
    assert most(reads, "read_size") == 1 and most(reads, "read_image") == 1


@pytest.mark.slow
def test_training_measuring_and_baking_read_each_image_once(capture, tmp_path, reads):
    pytest.importorskip("jax")
    small = {"samples": "4096", "family.grid.levels": "4", "family.grid.log2_size": "12", "view_dependence": "deferred"}
    train_field(capture, tmp_path / "field", steps=12, seed=3, values=small)
    assert most(reads, "read_size") == 1 and most(reads, "read_image") == 1
    reads.clear()
    evaluate(tmp_path / "field")
    assert most(reads, "read_size") == 1 and most(reads, "read_image") == 1
    reads.clear()
    bake_scene(tmp_path / "field", tmp_path / "scene", BakeSettings(resolution=32))
    assert reads and most(reads, "read_size") == 1 and most(reads, "read_image") == 1
