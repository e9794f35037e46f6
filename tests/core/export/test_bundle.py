"""Web pages of scenes on disk: their codec, and which files go into them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from scenes import looking, make_snerg
from snerg.core.cli import main
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.export import export_reference
from snerg.core.commands.render import render_views
from snerg.core.data.readers.camera_files import write_transforms
from snerg.core.errors import SnergError
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.reference import reference_files, write_reference
from snerg.core.export.scene_files import codec_of, read_scene, scene_files, write_scene
from snerg.core.geometry.camera import Camera, panorama_focal
from snerg.core.io.images import read_image


@pytest.fixture
def stored(tmp_path):
    write_scene(make_snerg((34, 20, 20)), tmp_path / "scene", codec=CodecSettings("jpeg", 70))
    (tmp_path / "scene" / "diary.txt").write_text("mine")
    return tmp_path / "scene"


def test_images_are_copied_unchanged(tmp_path, stored):
    """Encoding a lossy image again would lose more."""
    result = bundle_scene(stored, tmp_path / "web")
    assert result["codec"] == "jpeg"
    names = {path.name for path in stored.iterdir()} - {".snerg", "diary.txt"}
    assert {path.name for path in (tmp_path / "web" / "scene").iterdir()} == names
    for name in names:
        assert (tmp_path / "web" / "scene" / name).read_bytes() == (stored / name).read_bytes()


def test_another_codec(tmp_path, stored):
    assert bundle_scene(stored, tmp_path / "web", codec=CodecSettings("webp"))["codec"] == "webp"
    assert codec_of(tmp_path / "web" / "scene") == CodecSettings("webp")
    assert np.array_equal(read_scene(tmp_path / "web" / "scene").cells, read_scene(stored).cells)


def test_a_page_with_jpeg_xl_holds_webp_too(tmp_path, stored):
    pytest.importorskip("pillow_jxl")
    bundle_scene(stored, tmp_path / "web", codec=CodecSettings("jxl"))
    folder = tmp_path / "web" / "scene"
    names = {path.name for path in scene_files(folder)}
    assert names == {path.name for path in folder.iterdir()}
    assert {"alpha_000.jxl", "rgb_000.jxl", "feature_000.jxl", "alpha_000.png", "rgb_000.webp", "feature_000.webp"} < names
    assert json.loads((folder / "scene.json").read_text())["alternatives"] == [{"name": "webp", "quality": None}]
    assert np.array_equal(read_scene(folder).cells, read_scene(stored).cells)
    bundle_scene(folder, tmp_path / "again")  # its own codec
    assert {path.name for path in (tmp_path / "again" / "scene").iterdir()} == names
    with pytest.raises(SnergError, match="Not all browsers decode JPEG XL"):
        bundle_scene(stored, tmp_path / "single", single_file=True, codec=CodecSettings("jxl"))


def test_an_older_scene_is_converted(tmp_path):
    write_scene(make_snerg((34, 20, 20)), tmp_path / "scene")
    path = tmp_path / "scene" / "scene.json"
    value = json.loads(path.read_text())
    del value["codec"]
    path.write_text(json.dumps({**value, "version": 2}))
    bundle_scene(tmp_path / "scene", tmp_path / "web")
    assert json.loads((tmp_path / "web" / "scene" / "scene.json").read_text())["version"] == 3


def test_from_the_command_line(tmp_path, stored, capsys):
    assert main(["bundle", str(stored), "--out", str(tmp_path / "web"), "--codec", "avif", "--quality", "60", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["codec"] == "avif"
    assert codec_of(tmp_path / "web" / "scene") == CodecSettings("avif", 60)
    for more, words in (
        (["--quality", "60"], "give --codec"),
        (["--codec", "h264"], "full chroma"),
        (["--codec", "jpeg", "--quality", "200"], "1 to 100"),
    ):
        assert main(["bundle", str(stored), "--out", str(tmp_path / "other"), *more]) == 2
        message = capsys.readouterr().err.strip()
        assert words in message and "\n" not in message
    assert not (tmp_path / "other").exists()


def test_a_damaged_codec_is_reported(tmp_path, stored):
    path = stored / "scene.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "codec": 5}))
    with pytest.raises(SnergError, match="no good codec"):
        bundle_scene(stored, tmp_path / "web")


@pytest.mark.parametrize("codec", ["png", "webp", "jpeg", "avif"])
def test_only_the_files_of_the_scene_are_published(tmp_path, codec):
    """Neither other files with similar names nor the targets of links."""
    secret = tmp_path / "secret"
    secret.write_text("secret")
    scene = tmp_path / "scene"
    write_scene(make_snerg((34, 20, 20)), scene, codec=CodecSettings(codec))
    names = {path.name for path in scene.iterdir()} - {".snerg"}
    (scene / "rgba_999.txt").symlink_to(secret)
    (scene / "rgba_998.png").write_text("secret")
    (scene / "alpha_007.txt").write_text("secret")
    for single in (False, True):
        bundle_scene(scene, tmp_path / f"web {single}", single_file=single)
    assert {path.name for path in (tmp_path / "web False" / "scene").iterdir()} == names
    assert "c2VjcmV0" not in (tmp_path / "web True" / "index.html").read_text()  # "secret"


@pytest.mark.parametrize("name", ["scene.json", "indirection.png", "rgba_000.png", "feature_001.png"])
def test_a_link_is_not_published(tmp_path, name):
    """Even to a valid image: the user did not choose to publish it."""
    scene = tmp_path / "scene"
    write_scene(make_snerg((34, 20, 20)), scene)
    (scene / name).rename(tmp_path / "private")
    (scene / name).symlink_to(tmp_path / "private")
    publish = (
        lambda: bundle_scene(scene, tmp_path / "out"),
        lambda: bundle_scene(scene, tmp_path / "out", codec=CodecSettings("webp")),
        lambda: export_reference(scene, tmp_path / "out"),
    )
    for write in publish:
        with pytest.raises(SnergError, match=f"{name} is a link"):
            write()
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["scene_params.json", "atlas_indices.png", "rgba_000.png", "feature_001.png"])
def test_a_link_in_the_reference_layout_is_not_published(tmp_path, name):
    scene = tmp_path / "reference"
    write_reference(make_snerg((34, 20, 20)), scene)
    (scene / name).rename(tmp_path / "private")
    (scene / name).symlink_to(tmp_path / "private")
    for write in (
        lambda: bundle_scene(scene, tmp_path / "out"),
        lambda: bundle_scene(scene, tmp_path / "out", single_file=True),
        lambda: export_reference(scene, tmp_path / "out"),
    ):
        with pytest.raises(SnergError, match=f"{name} is a link"):
            write()
    assert not (tmp_path / "out").exists()


def test_only_what_the_reference_layout_names_is_published(tmp_path):
    scene = tmp_path / "reference"
    write_reference(make_snerg((34, 20, 20)), scene)
    assert {path.name for path in reference_files(scene)} == {path.name for path in scene.iterdir()} - {".snerg"}
    (tmp_path / "secret").write_text("secret")
    (scene / "rgba_999.png").symlink_to(tmp_path / "secret")
    bundle_scene(scene, tmp_path / "web")
    assert not list((tmp_path / "web").rglob("rgba_999*"))


def test_every_file_of_a_scene_is_named(tmp_path):
    scene = make_snerg((34, 20, 20))
    pytest.importorskip("av")
    write_scene(replace(scene, cells=scene.cells / np.float32(255)), tmp_path / "float")
    write_scene(scene, tmp_path / "h264", codec=CodecSettings("h264", 70))
    for folder in (tmp_path / "float", tmp_path / "h264"):
        assert {path.name for path in scene_files(folder)} == {path.name for path in folder.iterdir()} - {".snerg"}


def test_a_page_leaves_out_panoramas_and_says_so(tmp_path):
    """The page cannot draw them; `snerg render` can, also from the same file."""
    pose = looking((1.5, -2.0, 0.8), (0, 0, 0))
    cameras = [
        Camera(24, 18, (26.0, 26.0), (12, 9), pose, name="plain"),
        Camera(32, 16, panorama_focal(32, 16), (16, 8), pose, "equirectangular", "round"),
        Camera(16, 16, (6.0, 6.0), (8, 8), pose, "fisheye", "fish", widest=1.4),
    ]
    write_transforms(tmp_path / "t.json", cameras, [camera.name for camera in cameras])
    write_scene(make_snerg((20, 20, 20)), tmp_path / "scene")
    said: list[str] = []
    result = bundle_scene(tmp_path / "scene", tmp_path / "page", tmp_path / "t.json", progress=lambda _, text: said.append(str(text)))
    listed = json.loads((tmp_path / "page" / "cameras.json").read_text())["cameras"]
    assert [camera["name"] for camera in listed] == ["plain"] and result["cameras"] == 1
    assert any(text.startswith("2 panoramic or fisheye cameras are left out") for text in said)
    written = render_views(tmp_path / "scene", tmp_path / "t.json", tmp_path / "out")
    assert written["files"] == ["plain.png", "round.png", "fish.png"]
    fish = read_image(tmp_path / "out" / "fish.png")
    assert fish[..., 3].max() > 100 and fish[0, 0, 3] == 0


def test_annotations_go_into_the_page(tmp_path, stored, capsys):
    """Their cameras are those that the page lists; one that it does not list is said and dropped."""
    camera = Camera(8, 8, (8, 8), (4, 4), looking((0, -4, 0), (0, 0, 0)), name="Front")
    write_transforms(tmp_path / "cameras.json", [camera], ["Front"])
    notes = [
        {"text": "Window", "position": [1, 2, 3], "camera": "Front"},
        {"text": "Door", "position": [0, 0, 0.5], "camera": "Gone"},
    ]
    (tmp_path / "notes.json").write_text(json.dumps({"annotations": notes}))
    files = ["--out", str(tmp_path / "web"), "--cameras", str(tmp_path / "cameras.json"), "--annotations", str(tmp_path / "notes.json")]
    assert main(["bundle", str(stored), *files, "--measure", "--unit-scale", "0.01", "--unit-system", "imperial"]) == 0
    assert "where the page does not list theirs: Gone." in "".join(capsys.readouterr())
    listed = json.loads((tmp_path / "web" / "cameras.json").read_text())
    assert listed["parts"] == ["annotations", "measure"] and listed["units"] == {"metres": 0.01, "system": "imperial"}
    written = json.loads((tmp_path / "web" / "annotations.json").read_text())["annotations"]
    assert written == [notes[0], {"text": "Door", "position": [0, 0, 0.5]}]
    assert {path.name for path in (tmp_path / "web" / "optional").iterdir()} == {"annotations.js", "benchmark.js", "measure.js"}


@pytest.mark.parametrize(
    ("notes", "says"),
    [
        ({"annotations": "none"}, "must be a list"),
        ({"annotations": [{"text": "x", "position": [1, 2]}]}, "the position of annotation 1 must be three numbers"),
        ({"annotations": [{"text": "x", "position": [1, 2, None]}]}, "the position of annotation 1 is None"),
        ({"annotations": [{"text": 4, "position": [1, 2, 3]}]}, "the text of annotation 1 is 4"),
        ({"annotations": [{"text": " ", "position": [1, 2, 3]}]}, "has no text"),
        ({"annotations": [{"text": "x" * 501, "position": [1, 2, 3]}]}, "a label holds 500"),
        ([], "it is \\[\\]; it must be an object"),
    ],
)
def test_annotations_that_cannot_be_used(tmp_path, stored, notes, says):
    (tmp_path / "notes.json").write_text(json.dumps(notes))
    with pytest.raises(SnergError, match=says):
        bundle_scene(stored, tmp_path / "web", annotations=tmp_path / "notes.json")
    assert not (tmp_path / "web").exists()
