"""Baked scenes on disk."""

import json
import shutil
import sys
import tracemalloc
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from PIL import Image

from scenes import empty_snerg, make_cameras, make_forward, make_snerg, snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.codecs import LOSSLESS, SUFFIXES, CodecSettings
from snerg.core.export.image_files import encode_image, read_image_file
from snerg.core.export.jxl import MAX_HEADER_BYTES, jxl_size
from snerg.core.export.reference import write_reference
from snerg.core.export.scene_files import codec_of, read_scene, write_scene, write_scene_files
from snerg.core.export.video_files import VideoWriter
from snerg.core.rendering.render import render_scene
from snerg.core.scene.blocks import block_coordinates, fill_aprons
from snerg.core.scene.half_features import with_half_features
from snerg.core.scene.scene import Scene


def same(a: Scene, b: Scene) -> bool:
    numbers = (a.voxel_size, a.shape, a.near, a.about, a.effects) == (b.voxel_size, b.shape, b.near, b.about, b.effects)
    arrays = all(np.array_equal(x, y) for x, y in ((a.indirection, b.indirection), (a.cells, b.cells)))
    return numbers and arrays and np.allclose(a.grid_to_world, b.grid_to_world, rtol=0, atol=1e-15)


@pytest.mark.parametrize("make", [make_snerg, make_forward])
@pytest.mark.parametrize("diffuse", [False, True])
def test_round_trip(tmp_path, make, diffuse):
    scene = make(diffuse=diffuse)
    write_scene(scene, tmp_path / "scene")
    back = read_scene(tmp_path / "scene")
    assert same(back, scene) and (back.ndc is None) == (scene.ndc is None)
    if scene.ndc is not None:
        assert (back.ndc.focal, back.ndc.near) == (scene.ndc.focal, scene.ndc.near)
        assert np.allclose(back.ndc.camera_to_world, scene.ndc.camera_to_world, rtol=0, atol=1e-15)


@pytest.mark.parametrize("ndc", [{"focal": [1, 1]}, 3, {"camera_to_world": np.eye(4).tolist(), "focal": [1, 0], "near": 1}])
def test_a_damaged_frame_is_reported(tmp_path, ndc):
    write_scene(make_forward(), tmp_path / "scene")
    path = tmp_path / "scene" / "scene.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "ndc": ndc}))
    with pytest.raises(SnergError, match=r"damaged|forward-facing frame"):
        read_scene(tmp_path / "scene")


@pytest.mark.hard_case(56)
def test_the_atlas_is_streamed(tmp_path):
    """Beside the scene itself, memory holds a few slices and not a second atlas."""
    noise = np.random.default_rng(0).integers(0, 256, (180, 150, 180, 4), np.uint8)  # slower to encode than to slice
    scene = snerg_from_volume(noise, None, grid_to_world=np.eye(4), voxel_size=0.01)
    size = scene.cells.nbytes
    tracemalloc.start()
    try:
        write_scene(scene, tmp_path / "scene")
        assert tracemalloc.get_traced_memory()[1] < 0.8 * size
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        back = read_scene(tmp_path / "scene")
        assert tracemalloc.get_traced_memory()[1] - before < 1.7 * size
    finally:
        tracemalloc.stop()
    assert np.array_equal(back.cells, scene.cells)


LOSSY = tuple(name for name in SUFFIXES if not CodecSettings(name).lossless)


def needs(name: str) -> None:
    if name == "h264":
        pytest.importorskip("av")
    if name == "jxl":
        pytest.importorskip("pillow_jxl")


@pytest.mark.parametrize("diffuse", [False, True])
@pytest.mark.parametrize("name", SUFFIXES)
def test_codecs(tmp_path, name, diffuse):
    """Lossless codecs are exact; lossy ones are close, and closer at a higher quality; alpha is exact in all."""
    needs(name)
    scene = make_snerg((40, 33, 35), diffuse)
    means, sizes = [], []
    for quality in (100, 60):
        folder = tmp_path / str(quality)
        write_scene(scene, folder, codec=CodecSettings(name, quality))
        back = read_scene(folder)
        assert np.array_equal(back.cells[..., -1], scene.cells[..., -1])
        assert codec_of(folder) == CodecSettings(name) if name not in LOSSY else CodecSettings(name, quality)
        full = scene.cells[..., -1] > 0
        assert quality == 60 or abs((back.cells[full].astype(int) - scene.cells[full]).mean()) < 0.25, "a bias would add up along rays"
        means.append(np.abs(back.cells.astype(int) - scene.cells).mean())
        sizes.append(sum(path.stat().st_size for path in folder.iterdir() if path.suffix != ".json"))
        assert diffuse != any("feature" in path.name for path in folder.iterdir())
    if name in LOSSY:
        assert means[0] < 0.1 < means[1] < 1 and sizes[0] > 1.5 * sizes[1]
    else:
        assert same(back, scene) and sizes[0] == sizes[1]


def alike_in_groups(scene: Scene) -> Scene:
    """The scene with straight features that are the same in each 2 x 2 x 2 voxels of a cell."""
    cells = scene.cells.copy()
    places = np.indices(cells.shape[:4])[1:] // 2 + block_coordinates(scene.indirection).T.reshape(3, -1, 1, 1, 1) * 15
    straight = np.stack([(37 * (k + 1) * places[0] + 11 * places[1] + 101 * places[2]) % 256 for k in range(4)], axis=-1)
    cells[..., 3:7] = (straight * cells[..., 7:].astype(int) + 127) // 255
    return replace(scene, cells=cells)


@pytest.mark.parametrize("name", ["png", "webp", "jxl", "jpeg"])
def test_features_at_half_the_resolution(tmp_path, name):
    """Colours and alpha are as with the codec alone; features follow from a straight value a group, also across blocks' borders."""
    needs(name)
    scene = alike_in_groups(make_snerg((70, 40, 35)))
    codec = CodecSettings(name, half_features=True)
    for folder, one in (("half", codec), ("whole", CodecSettings(name))):
        write_scene(scene, tmp_path / folder, codec=one)
    half, whole = (read_scene(tmp_path / folder) for folder in ("half", "whole"))
    assert codec_of(tmp_path / "half") == codec
    assert np.array_equal(half.cells[..., [0, 1, 2, 7]], whole.cells[..., [0, 1, 2, 7]])
    difference = np.abs(half.cells[..., 3:7].astype(int) - scene.cells[..., 3:7])
    assert difference.mean() < 0.7 and (name not in LOSSLESS or difference.max() <= 6), "8 errors of a half, and half of a 64th"
    aprons = half.cells.copy()
    list(fill_aprons(aprons, half.indirection))
    assert name not in LOSSLESS or np.array_equal(aprons, half.cells)
    sizes = [sum(path.stat().st_size for path in (tmp_path / folder).glob("feature*")) for folder in ("half", "whole")]
    assert np.array_equal(with_half_features(whole.cells), half.cells) == (name in LOSSLESS)
    assert sizes[0] < 0.75 * sizes[1]


def test_features_above_alpha_need_the_whole_resolution(tmp_path):
    scene = make_snerg((20, 20, 20))
    scene = replace(scene, cells=np.maximum(scene.cells, np.array([0] * 3 + [1] + [0] * 4, np.uint8)))
    with pytest.raises(SnergError, match="features above their alpha"):
        write_scene(scene, tmp_path / "scene", codec=CodecSettings("webp", half_features=True))
    with pytest.raises(SnergError, match=r"H\.264 stores features at full resolution"):
        CodecSettings("h264", half_features=True)
    write_scene(make_snerg((20, 20, 20), diffuse=True), tmp_path / "scene", codec=CodecSettings("webp", half_features=True))


@pytest.mark.hard_case(58)
@pytest.mark.parametrize("name", LOSSY)
def test_empty_stays_empty(tmp_path, name):
    """A lossy codec spreads colour into empty space; rays that hit nothing would show it as haze."""
    needs(name)
    scene = make_snerg((40, 33, 35), fog=False)
    write_scene(scene, tmp_path / "scene", codec=CodecSettings(name, 50))
    back = read_scene(tmp_path / "scene")
    assert (back.cells[..., :-1] <= back.cells[..., -1:]).all()
    assert not back.cells[scene.cells[..., -1] == 0].any()
    suffix = SUFFIXES[name]
    if name != "h264":  # as stored, before colours are limited to alpha
        pixels = np.asarray(Image.open(tmp_path / "scene" / f"rgb_003.{suffix}"))
        alpha = np.asarray(Image.open(tmp_path / "scene" / "alpha_003.png"))
        assert (pixels[alpha == 0] > 0).any()
    camera = make_cameras(width=60, height=45)[0]
    clear = render_scene(scene, camera)
    assert (render_scene(back, camera).colour[clear.alpha == 0] == 0).all()


@pytest.mark.parametrize("name", LOSSY)
def test_colours_above_alpha_need_a_lossless_codec(tmp_path, name):
    needs(name)
    scene = make_snerg((20, 20, 20), diffuse=True)
    scene = replace(scene, cells=np.maximum(scene.cells, np.array([1, 0, 0, 0], np.uint8)))
    with pytest.raises(SnergError, match="colours above their alpha"):
        write_scene(scene, tmp_path / "scene", codec=CodecSettings(name))
    assert list(tmp_path.iterdir()) == []
    write_scene(scene, tmp_path / "scene", codec=CodecSettings("webp"))
    assert same(read_scene(tmp_path / "scene"), scene)


def test_an_alternative_is_read_where_the_first_codec_is_not_installed(tmp_path, monkeypatch):
    needs("jxl")
    scene = make_snerg((20, 20, 20))
    write_scene_files(scene, tmp_path, codec=CodecSettings("jxl"), alternatives=[CodecSettings("webp")])
    monkeypatch.setitem(sys.modules, "pillow_jxl", None)
    assert same(read_scene(tmp_path), scene) and codec_of(tmp_path) == CodecSettings("jxl")
    write_scene_files(scene, tmp_path, codec=CodecSettings("webp"))
    edit(tmp_path, lambda value: value.update(codec={"name": "jxl", "quality": None}))
    with pytest.raises(SnergError, match="pip install pillow-jxl-plugin"):
        read_scene(tmp_path)


@pytest.mark.parametrize("size", [(1, 1), (8, 8), (256, 32), (400, 300), (32, 2048), (160, 90), (160, 192), (7, 500), (70000, 1)])
def test_the_size_of_a_jpeg_xl_is_read_from_its_header(size):
    needs("jxl")
    image = encode_image("alpha", np.zeros(size[::-1], np.uint8), CodecSettings("jxl"))
    assert jxl_size(image[:MAX_HEADER_BYTES]) == size


def test_a_jpeg_xl_that_says_it_is_huge_is_not_decoded(tmp_path):
    """Its decoder allocates the whole image before it tells the size."""
    needs("jxl")
    bits = 3 << 1 | 2**29 << 3 | 1 << 33  # no multiple of 8; selector 3: 30 bits of height - 1; ratio 1: as wide as high
    (tmp_path / "rgb_000.jxl").write_bytes(b"\xff\x0a" + bits.to_bytes(14, "little"))
    with pytest.raises(SnergError, match=r"rgb_000\.jxl says that it is 536870913 x 536870913 pixels"):
        read_image_file(tmp_path / "rgb_000.jxl", (32, 32, 3))


@pytest.mark.hard_case(57)
@pytest.mark.parametrize("name", SUFFIXES)
def test_empty_scenes(tmp_path, name):
    needs(name)
    write_scene(empty_snerg(), tmp_path / "scene", codec=CodecSettings(name))
    assert same(read_scene(tmp_path / "scene"), empty_snerg())


@pytest.mark.parametrize(("name", "quality"), [("gif", 90), ("jpeg", 0), ("avif", 101), ("jpeg", 9.5)])
def test_no_such_codec(name, quality):
    with pytest.raises(SnergError, match=r"no codec 'gif'|whole number from 1 to 100"):
        CodecSettings(name, quality)


def test_h264_gives_one_scene_one_file(tmp_path):
    """x264's macroblock tree gave other bytes in half of the runs."""
    pytest.importorskip("av")
    frames = (np.random.default_rng(0).random((34, 64, 96, 3)) * 60 + np.linspace(0, 190, 96)[:, None]).astype(np.uint8)
    found = set()
    for run in range(6):
        writer = VideoWriter(tmp_path / f"{run}.mp4", CodecSettings("h264", 90))
        for frame in frames:
            writer.add(frame)
        writer.close()
        found.add((tmp_path / f"{run}.mp4").read_bytes())
    assert len(found) == 1


def test_h264_without_pyav(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SnergError, match="pip install av"):
        write_scene(make_snerg((20, 20, 20)), tmp_path / "scene", codec=CodecSettings("h264"))
    assert list(tmp_path.iterdir()) == []


def test_version_2_is_read(tmp_path):
    scene = make_snerg((40, 33, 35))
    write_scene(scene, tmp_path / "scene")
    edit(tmp_path / "scene", lambda value: (value.update(version=2), value.pop("codec")))
    assert same(read_scene(tmp_path / "scene"), scene) and codec_of(tmp_path / "scene") == CodecSettings()


def edit(folder, change) -> None:
    path = folder / "scene.json"
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def cut(path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def resized(path) -> None:
    Image.open(path).resize((17, 9)).save(path)


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stored")
    for name in SUFFIXES:
        if find_spec({"h264": "av", "jxl": "pillow_jxl"}.get(name, "PIL")):
            write_scene(make_snerg((20, 20, 20)), folder / name, codec=CodecSettings(name, 60))
    write_scene(in_floats(make_snerg((20, 20, 20))), folder / "float")
    return folder


FILES = {
    "png": ("rgba_002.png", "feature_001.png"),
    "webp": ("alpha_002.png", "rgb_000.webp", "feature_001.webp"),
    "jxl": ("alpha_002.jxl", "rgb_000.jxl", "feature_001.jxl"),
    "jpeg": ("alpha_002.png", "rgb_000.jpg", "feature_001.jpg"),
    "avif": ("alpha_002.png", "rgb_000.avif", "feature_001.avif"),
    "h264": ("alpha_002.png", "rgb.mp4", "feature.mp4"),
    "float": ("cells.npy",),
}


@pytest.mark.hard_case(61)
@pytest.mark.parametrize(("name", "file"), [(name, file) for name, files in FILES.items() for file in files])
def test_damaged_files_are_named(tmp_path, stored, name, file):
    needs(name)
    damage = {"missing": lambda path: path.unlink(), "cut": cut, "empty": lambda path: path.write_bytes(b"")}
    damage["noise"] = lambda path: path.write_bytes(np.random.default_rng(1).bytes(5000))
    if file.rpartition(".")[2] not in ("mp4", "npy"):
        damage["resized"] = resized
    for what, change in damage.items():
        folder = shutil.copytree(stored / name, tmp_path / what)
        change(folder / file)
        with pytest.raises(SnergError) as caught:
            read_scene(folder)
        assert str(folder / file) in str(caught.value), what


@pytest.mark.parametrize(
    "change",
    [
        lambda value: value.pop("codec"),
        lambda value: value.update(codec="png"),
        lambda value: value.update(codec={"name": "gif", "quality": 3}),
        lambda value: value.update(codec={"name": "jpeg", "quality": None}),
        lambda value: value["codec"].update(half_features=1),
        lambda value: value["codec"].update(half_features=True),
        lambda value: value.update(alternatives=5),
        lambda value: value.update(alternatives=[{"name": "gif", "quality": None}]),
        lambda value: value.update(atlas_blocks=[0, 1, 1]),
        lambda value: value.update(atlas_blocks=[1, 1, 10**9]),
        lambda value: value.update(cells=-1),
        lambda value: value.update(cells=10**9),
        lambda value: value.update(shape=[10**7] * 3),
        lambda value: value.update(shape=[1e400] * 3),
        lambda value: value.update(network=[1]),
        lambda value: value.update(about=7),
    ],
)
def test_damaged_numbers_are_reported(tmp_path, stored, change):
    folder = shutil.copytree(stored / "png", tmp_path / "scene")
    edit(folder, change)
    with pytest.raises(SnergError):
        read_scene(folder)


def in_floats(scene: Scene) -> Scene:
    return replace(scene, cells=scene.cells.astype(np.float32) / 255)


def test_floats_round_trip(tmp_path):
    scene = in_floats(make_snerg((20, 20, 20)))
    write_scene(scene, tmp_path / "scene")
    back = read_scene(tmp_path / "scene")
    assert same(back, scene) and back.cells.dtype == np.float32 and codec_of(tmp_path / "scene") == CodecSettings()
    for codec in ("jpeg", "webp"):
        with pytest.raises(SnergError, match="not quantised"):
            write_scene(scene, tmp_path / "other", codec=CodecSettings(codec))
    with pytest.raises(SnergError, match="not quantised"):
        write_reference(scene, tmp_path / "other")
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]
    cells = scene.cells.copy()
    for bad in (np.nan, 1.5, -0.1):
        cells[0, 3, 3, 3, 3] = bad
        np.save(tmp_path / "scene" / "cells.npy", cells)
        with pytest.raises(SnergError, match=r"cells.npy holds values outside 0 to 1"):
            read_scene(tmp_path / "scene")


@pytest.mark.hard_case(54)
@pytest.mark.parametrize("blocks", [1, 254, 255, 256, 700])
def test_any_number_of_blocks_on_an_axis(tmp_path, blocks):
    values = np.zeros((30 * blocks, 4, 4, 4), np.uint8)
    values[-2:] = 200
    values[:1] = 100
    scene = snerg_from_volume(values, None, grid_to_world=np.eye(4), voxel_size=0.001)
    write_scene(scene, tmp_path / "scene")
    assert same(read_scene(tmp_path / "scene"), scene)


@pytest.mark.slow
@pytest.mark.hard_case(56)
def test_four_thousand_blocks_are_streamed(tmp_path):
    """Half a gigabyte of cells: memory holds them and a few layers of 32 MiB each."""
    cells = np.zeros((4096, 32, 32, 32, 4), np.uint8)
    cells[:, 5:9, 7, 3:30] = np.arange(4096, dtype=np.uint16).view(np.uint8).reshape(4096, 2)[:, None, None, [0, 1, 0, 1]]
    scene = replace(
        make_snerg((20, 20, 20), diffuse=True),
        cells=cells,
        shape=(480,) * 3,
        indirection=np.arange(4096, dtype=np.int32).reshape((16,) * 3),
    )
    tracemalloc.start()
    try:
        write_scene(scene, tmp_path / "scene")
        assert tracemalloc.get_traced_memory()[1] < 200e6
        tracemalloc.reset_peak()
        back = read_scene(tmp_path / "scene")
        assert tracemalloc.get_traced_memory()[1] < cells.nbytes + 200e6
    finally:
        tracemalloc.stop()
    assert np.array_equal(back.cells, cells)


@pytest.mark.hard_case(69)
@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1.0001, -1e-6])
def test_float_cells_outside_of_0_to_1_are_not_written(tmp_path, wrong):
    scene = make_snerg((34, 30, 40))
    cells = scene.cells.astype(np.float32) / 255
    write_scene(replace(scene, cells=cells), tmp_path / "good")
    cells[0, 3, 4, 5, 7] = wrong
    with pytest.raises(SnergError, match="atlas holds values outside 0 to 1"):
        write_scene(replace(scene, cells=cells), tmp_path / "bad")
    assert not (tmp_path / "bad").exists()
