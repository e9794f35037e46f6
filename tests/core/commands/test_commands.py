"""Every command on small inputs: what it writes, what it returns, what it refuses before it starts."""

import json
import os
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from flax_checkpoint import networks, tree, write
from scenes import make_cameras, make_snerg
from snerg.core.baking.bake import BakeSettings
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.export import export_reference
from snerg.core.commands.import_artifact import import_source
from snerg.core.commands.info import info
from snerg.core.commands.render import file_names, render_views
from snerg.core.commands.train import train_field
from snerg.core.data.dataset import DatasetOptions
from snerg.core.data.load import read_dataset
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import Cancelled, SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import codec_of, read_scene, write_scene
from snerg.core.io.files import folder_bytes
from snerg.core.io.images import over, read_image, to_uint8
from snerg.core.nerf.checkpoint import read_field, write_field
from snerg.core.nerf.reference_checkpoint import read_reference_checkpoint, reference_mlp
from snerg.core.rendering.render import MarchSettings, render_scene
from snerg.core.study.evaluate import Score, evaluate, held_out, open_target
from snerg.core.training.config import PRESETS
from snerg.core.training.training_folder import NEW, UNFINISHED, training_folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    folder = tmp_path_factory.mktemp("baked") / "scene"
    write_scene(make_snerg((40, 36, 44), fog=False), folder)
    return folder


@pytest.fixture(scope="module")
def field(tmp_path_factory, dataset):
    pytest.importorskip("jax")
    out = tmp_path_factory.mktemp("trained") / "field"
    result = train_field(dataset, out, steps=12, seed=3)
    assert result["steps"] == 12 and result["views"] == 12 and not result["resumed"] and result["bytes"] > 1000
    return out


@pytest.fixture
def checkpoint(tmp_path):
    return write(tmp_path / "checkpoint_5", tree(networks(np.random.default_rng(0))))


class StopAfter:
    """Progress that cancels once training has said something `times` times."""

    def __init__(self, times):
        self.left = times

    def __call__(self, fraction, message):
        if message.startswith("Step"):
            self.left -= 1
        if self.left < 0:
            raise Cancelled("Stopped by the test.")


def test_a_stopped_training_goes_on(tmp_path, dataset, monkeypatch):
    train = pytest.importorskip("snerg.core.training.trainer")
    monkeypatch.setattr(train.time, "perf_counter", iter(np.arange(0.0, 1e6, 0.3)).__next__)  # so that each step tells of itself
    with pytest.raises(Cancelled):
        train_field(dataset, tmp_path / "field", steps=8, progress=StopAfter(3))
    out = tmp_path / "field"
    reached = read_field(out).about["steps"]
    assert 0 < reached < 8
    views = read_dataset(dataset)
    settings = replace(PRESETS["fast"], steps=8, seconds=None)
    assert training_folder(out, settings, views) == (out, UNFINISHED)
    for other, images in ((replace(settings, steps=9), views), (settings, read_dataset(dataset, "test"))):  # anew, and not over this one
        folder, state = training_folder(out, other, images)
        assert state == NEW and folder.parent == tmp_path and folder.name.startswith(".field.training-")
    result = train_field(dataset, tmp_path / "field", steps=8)
    assert result["resumed"] and result["steps"] == 8
    folder, state = training_folder(out, settings, views)
    assert folder != out and state == NEW  # finished: anew
    assert [path.name for path in tmp_path.iterdir()] == ["field"]


def test_a_field_is_measured_and_described(field, dataset):
    result = evaluate(field, dataset, "test")
    assert result["kind"] == "field" and result["views"] == 3
    assert 3 < result["psnr"] < 60 and -1 < result["ssim"] <= 1 and result["seconds_per_view"] > 0
    about = info(field)
    assert about["kind"] == "field" and about["views"] == 12 and about["steps"] == 12 and about["effects"] == {"view_dependence": True}


def test_a_scene_is_measured_and_described(scene, dataset):
    """The dataset shows this very scene: 8 bits of colour and alpha are all that is lost."""
    result = evaluate(scene, dataset, "test")
    assert result["kind"] == "scene" and result["psnr"] > 45 and result["ssim"] > 0.99
    about = info(scene)
    snerg = read_scene(scene)
    assert about["voxels"] == [40, 36, 44] and about["blocks"] == len(snerg.cells) and about["effects"]["view_dependence"]
    assert about["megabytes"] == pytest.approx(folder_bytes(scene) / 1e6, abs=1e-3)


def test_measuring_goes_by_what_training_knew(field, dataset, tmp_path):
    """Without options, eval takes the dataset, its splits and the background from the field itself."""
    own = evaluate(field)
    assert own["dataset"] == str(dataset) and own["split"] == "test" and own["holdout"] == 8 and own["downscale"] == 1
    trained = read_field(field)
    settings = {**trained.about["settings"], "background": "#0000ff"}
    options = {"holdout": 4, "downscale": 2}
    write_field(replace(trained, about={**trained.about, "settings": settings, "dataset_options": options}), tmp_path / "field")
    target = open_target(tmp_path / "field")
    assert target.background == (0, 0, 1) and asdict(target.options) == options
    result = evaluate(tmp_path / "field")
    assert result["downscale"] == 2 and result["holdout"] == 4 and result["psnr"] != own["psnr"]


def test_the_views_held_out_are_those_that_training_did_not_see(tmp_path, dataset):
    folder = tmp_path / "one"
    shutil.copytree(dataset / "train", folder / "train")
    (folder / "transforms.json").write_text((dataset / "transforms_train.json").read_text())
    for options in (DatasetOptions(4), DatasetOptions(5)):
        seen = {view.image for view in read_dataset(folder, "train", options).views}
        unseen = {view.image for view in held_out(folder, options).views}
        assert unseen and not seen & unseen and len(seen | unseen) == 12
    with pytest.raises(SnergError, match="no views that training did not see"):
        held_out(folder, DatasetOptions(0))


def test_pictures_beside_the_truth(scene, dataset, tmp_path):
    for _ in range(2):  # the second takes the place of the first
        result = evaluate(scene, dataset, out=tmp_path / "pictures")
    names = sorted(p.name for p in (tmp_path / "pictures").glob("*.*"))
    assert result["out"] == str(tmp_path / "pictures") and names[-5:] == ["000.png", "001.png", "002.png", "contact.png", "views.json"]
    views = json.loads((tmp_path / "pictures" / "views.json").read_text())
    assert [view["psnr"] > 40 for view in views] == [True] * 3
    sheet = read_image(tmp_path / "pictures" / "contact.png")
    truth = to_uint8(over(read_dataset(dataset, "test").read(0)))
    assert np.array_equal(sheet[28:68, 6:46], truth)  # beside it, what was rendered
    assert np.array_equal(sheet[28:68, 52:92], read_image(tmp_path / "pictures" / "000.png"))


def test_hidden_pixels_do_not_count():
    score, random = Score(), np.random.default_rng(0)
    truth = random.random((30, 40, 3))
    picture, mask = truth + 0.01, np.ones((30, 40), bool)
    picture[:, 20:], mask[:, 20:] = random.random((30, 20, 3)), False
    score.add(picture, truth, mask=mask)
    assert score.result()["psnr"] == pytest.approx(40, abs=1e-3) and score.result()["ssim"] > 0.99
    with pytest.raises(SnergError, match="mask hides all"):
        score.add(picture, truth, mask=np.zeros_like(mask))


@pytest.mark.hard_case(30)
def test_identical_pictures_give_no_number():
    score = Score()
    picture = np.random.default_rng(0).random((20, 20, 3))
    score.add(picture, picture)
    assert score.result()["psnr"] is None and score.text() == "identical"
    score.add(picture, np.clip(picture + 0.1, 0, 1))
    assert score.result()["psnr"] > 20


def test_a_dataset_is_described(dataset):
    about = info(dataset)
    assert about["splits"] == {"test": 3, "train": 12} and about["sizes"] == [[40, 40]] and about["alpha"] and about["box"]


@pytest.mark.hard_case(8)
def test_images_are_put_over_white_in_display_space():
    image = np.uint8([[[0, 0, 0, 128], [255, 0, 0, 255], [9, 9, 9, 0]]])
    assert np.allclose(over(image), [[[127 / 255] * 3, [1, 0, 0], [1, 1, 1]]], atol=1e-6)


def test_importing_a_checkpoint_gives_a_field_that_equals_it(tmp_path, checkpoint):
    pytest.importorskip("jax")
    result = import_source(checkpoint, tmp_path / "field")
    assert result["imported"] == "checkpoint" and result["kind"] == "field"
    random = np.random.default_rng(1)
    points = random.uniform(-1.2, 1.2, (300, 3))
    directions = np.float32(np.tile([0.0, 0.6, 0.8], (300, 1)))
    expected = reference_mlp(np, read_reference_checkpoint(checkpoint), points.astype(np.float32), directions)
    density, colour, features = read_field(tmp_path / "field").query(points)
    assert np.abs(density - expected[0]).max() < 1e-5 * max(1, expected[0].max())
    assert np.abs(colour - expected[1]).max() < 1e-5 and np.abs(features - expected[2]).max() < 1e-5


def test_the_real_checkpoint_as_a_field_equals_the_references_outputs(data, tmp_path):
    pytest.importorskip("jax")
    import_source(data / "reference" / "checkpoint", tmp_path / "field")
    with np.load(data / "reference" / "checkpoint" / "ref_eval.npz") as truth:
        density, colour, features = read_field(tmp_path / "field").query(truth["pts"].astype(np.float64))
        expected = 1 / (1 + np.exp(-truth["raw_rgb_features"].astype(np.float64)))
        assert np.abs(density - np.maximum(truth["raw_sigma"][:, 0], 0)).max() < 1e-5
        assert np.abs(np.hstack([colour, features]) - expected).max() < 1e-5


def test_importing_scenes(tmp_path, scene):
    snerg = read_scene(scene)
    write_reference(snerg, tmp_path / "reference")
    for source, kind in ((tmp_path / "reference", "reference scene"), (scene, "scene")):
        result = import_source(source, tmp_path / "imported")
        assert result["imported"] == kind and result["kind"] == "scene"
        assert np.array_equal(read_scene(tmp_path / "imported").cells, snerg.cells)


def test_importing_what_needs_no_import(dataset, tmp_path):
    with pytest.raises(SnergError, match="dataset"):
        import_source(dataset, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("size", "shape"),
    [({}, (64, 48)), ({"width": 50}, (50, 38)), ({"height": 30}, (40, 30)), ({"width": 20, "height": 50}, (20, 50))],
)
def test_rendering_views(tmp_path, scene, size, shape):
    cameras = make_cameras(width=64, height=48)[:3]
    write_transforms(tmp_path / "cameras.json", cameras, [camera.name for camera in cameras])
    result = render_views(scene, tmp_path / "cameras.json", tmp_path / "out", **size)
    assert result["views"] == 3 and sorted(result["files"]) == sorted(p.name for p in (tmp_path / "out").glob("*.png"))
    width, height = shape
    picture = read_image(tmp_path / "out" / result["files"][1])
    assert picture.shape == (height, width, 4)
    expected = render_scene(read_scene(scene), cameras[1].resized(width, height))
    assert np.array_equal(picture, to_uint8(expected.straight()))
    assert np.abs(over(picture) - expected.over()).max() < 2.5 / 255


def test_names_of_pictures():
    assert file_names(["a", "b c", "../d"]) == ["a", "b_c", "d"]
    assert file_names(["a", "A"]) == ["000_a", "001_A"]
    assert file_names(["", "x"]) == ["000", "001_x"]


def test_exporting_the_reference_layout(tmp_path, scene):
    result = export_reference(scene, tmp_path / "out")
    assert result["kind"] == "reference scene" and result["blocks"] == len(read_scene(scene).cells)


@pytest.mark.parametrize("single_file", [False, True])
def test_bundling_a_web_page(tmp_path, scene, single_file):
    cameras = make_cameras(width=64, height=48)[:2]
    write_transforms(tmp_path / "cameras.json", cameras, [camera.name for camera in cameras])
    for _ in range(2):  # the second replaces the first
        result = bundle_scene(scene, tmp_path / "web", tmp_path / "cameras.json", single_file)
    assert result["cameras"] == 2 and (tmp_path / "web" / "index.html").is_file() and result["bytes"] > 1000
    about = info(tmp_path / "web")
    assert about["kind"] == "page" and about["single_file"] == single_file
    if not single_file:
        assert about["cameras"] == ["Front", "Shifted, rolled"]
        import_source(tmp_path / "web", tmp_path / "back")
        assert np.array_equal(read_scene(tmp_path / "back").cells, read_scene(scene).cells)


def test_what_an_output_must_not_replace(tmp_path, scene, dataset, checkpoint):
    with pytest.raises(SnergError, match="made from"):
        export_reference(scene, scene)
    with pytest.raises(SnergError, match="made from"):
        export_reference(scene, scene.parent)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(SnergError, match="other files"):
        export_reference(scene, tmp_path / "mine")
    import_source(checkpoint, tmp_path / "field")
    with pytest.raises(SnergError, match="holds a field"):
        export_reference(scene, tmp_path / "field")
    (tmp_path / "file").write_text("")
    with pytest.raises(SnergError, match="folder"):
        export_reference(scene, tmp_path / "file" / "out")


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody can write to")
def test_an_unwritable_output_is_found_before_the_work(scene, dataset):
    for work in (
        lambda out: export_reference(scene, out),
        lambda out: train_field(dataset, out, steps=1),
        lambda out: import_source(scene, out),
    ):
        with pytest.raises(SnergError, match="Cannot write"):
            work(Path("/proc/self/out"))


def test_cancelling_leaves_nothing(tmp_path, scene):
    def stop(fraction, message):
        raise Cancelled("Stopped by the test.")

    with pytest.raises(Cancelled):
        export_reference(scene, tmp_path / "out", progress=stop)
    assert not list(tmp_path.iterdir())


def test_a_field_whose_images_are_gone_says_so(tmp_path, field):
    trained = read_field(field)
    write_field(replace(trained, dataset=str(tmp_path / "moved")), tmp_path / "field")
    with pytest.raises(SnergError, match="--no-refine"):
        bake_scene(tmp_path / "field", tmp_path / "scene", BakeSettings(40))
    assert not (tmp_path / "scene").exists()


def test_baking_refining_and_measuring(tmp_path, field, dataset):
    (tmp_path / "box.json").write_text(json.dumps({"min": [-1, -1, -1], "max": [1, 1, 1.1]}))
    said = []
    result = bake_scene(
        field, tmp_path / "scene", BakeSettings(40, supersampling=1), tmp_path / "box.json", progress=lambda f, m: said.append(f)
    )
    assert result["kind"] == "scene" and result["refined"] and set(result["seconds"]) == {"bake", "refine"}
    assert 40 <= max(result["voxels"]) <= 44 and said == sorted(said) and said[-1] <= 1
    assert evaluate(tmp_path / "scene", dataset, "test")["psnr"] > 3
    codec, coarse = CodecSettings("jpeg", 80), BakeSettings(40, supersampling=1)
    plain = bake_scene(field, tmp_path / "scene", coarse, refine=False, codec=codec, fit=True, prune=0.05)
    assert plain["fitted"] and not plain["refined"] and list(plain["seconds"]) == ["bake", "prune", "fit"]
    assert plain["about"]["prune"]["voxels_after"] < plain["about"]["prune"]["voxels_before"] and plain["about"]["fit"]["gain_db"] >= 0
    assert codec_of(tmp_path / "scene") == CodecSettings("jpeg", 80)


def test_what_is_left_out_to_compare_with(tmp_path, field, dataset):
    """Each setting shows in the scene that comes of it, and only where it should."""
    (tmp_path / "box.json").write_text(json.dumps({"min": [-1, -1, -1], "max": [1, 1, 1]}))

    blind = replace(read_field(field), cameras=tuple(replace(camera, near=1e6) for camera in read_field(field).cameras))
    write_field(blind, tmp_path / "blind")

    def baked(name, source=field, **settings):
        chosen = BakeSettings(40, supersampling=1, **settings)
        bake_scene(source, tmp_path / name, chosen, tmp_path / "box.json", refine=name == "diffuse")
        return read_scene(tmp_path / name)

    whole, diffuse = baked("whole"), baked("diffuse", network=False)
    assert diffuse.network is None and "refine" not in diffuse.about
    assert np.abs(diffuse.cells.astype(int) - whole.cells[..., [0, 1, 2, 7]]).max() <= 1  # rounded up or down at random
    assert not len(baked("unseen", tmp_path / "blind").cells)
    assert np.array_equal(baked("kept", tmp_path / "blind", visibility=False).cells, whole.cells)
    exact = baked("exact", quantise=False)
    assert exact.cells.dtype == np.float32 and np.abs(exact.cells * 255 - whole.cells).max() < 2
    coarse = baked("coarse", voxel_size=0.1)
    assert coarse.voxel_size == 0.1 and coarse.shape == (22, 22, 22)
    with pytest.raises(SnergError, match="not quantised"):
        bake_scene(field, tmp_path / "other", BakeSettings(40, quantise=False), codec=CodecSettings("jpeg"))


def test_settings_that_would_change_nothing_say_so(tmp_path, field, dataset):
    trained = read_field(field)
    write_field(replace(trained, view="diffuse", network=None, cameras=()), tmp_path / "field")
    for settings, match in ((BakeSettings(network=False), "diffuse"), (BakeSettings(visibility=False), "no cameras")):
        with pytest.raises(SnergError, match=match):
            bake_scene(tmp_path / "field", tmp_path / "scene", settings)
    assert not (tmp_path / "scene").exists()
    with pytest.raises(SnergError, match="not marched"):
        evaluate(field, dataset, settings=MarchSettings(tolerance=0.1))
    write_scene(make_snerg((31, 30, 33), diffuse=True), tmp_path / "diffuse")
    with pytest.raises(SnergError, match="--per-sample-network"):
        evaluate(tmp_path / "diffuse", dataset, settings=MarchSettings(per_sample_network=True))


def test_how_a_scene_is_marched_can_be_chosen(tmp_path, scene, dataset):
    usual = evaluate(scene, dataset)["psnr"]
    assert evaluate(scene, dataset, settings=MarchSettings(tolerance=0.9))["psnr"] < usual - 0.01
    assert evaluate(scene, dataset, settings=MarchSettings(per_sample_network=True))["psnr"] < usual - 1
    write_transforms(tmp_path / "cameras.json", make_cameras(width=20, height=20)[:1], ["one"])
    for settings in (MarchSettings(), MarchSettings(per_sample_network=True)):
        render_views(scene, tmp_path / "cameras.json", tmp_path / "out", settings=settings)
        expected = render_scene(read_scene(scene), make_cameras(width=20, height=20)[0], settings)
        assert np.array_equal(read_image(tmp_path / "out" / "one.png"), to_uint8(expected.straight()))


def test_a_flat_box_is_refused_before_the_bake(tmp_path, field):
    (tmp_path / "box.json").write_text(json.dumps({"min": [-1, -1, 0], "max": [1, 1, 0]}))
    with pytest.raises(SnergError, match="box"):
        bake_scene(field, tmp_path / "scene", box=tmp_path / "box.json")
    assert not (tmp_path / "scene").exists()


def test_paths_that_are_nothing(tmp_path):
    with pytest.raises(SnergError, match="does not exist"):
        info(tmp_path / "nothing")
    with pytest.raises(SnergError, match="no dataset"):
        info(tmp_path)


def test_a_box_that_holds_nothing_bakes_to_an_empty_scene_and_says_so(tmp_path, field):
    (tmp_path / "box.json").write_text(json.dumps({"min": [50, 50, 50], "max": [51, 51, 51]}))
    result = bake_scene(field, tmp_path / "scene", BakeSettings(32, supersampling=1), tmp_path / "box.json")
    assert result["blocks"] == 0 and not result["refined"] and "box" in result["warning"]
