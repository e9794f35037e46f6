"""Pictures of every kind become 8 bits of sRGB with straight alpha."""

from __future__ import annotations

import math
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from snerg.core.errors import SnergError
from snerg.core.io.images import (
    MAX_PIXELS,
    display_referred,
    linear_to_srgb,
    over,
    read_image,
    read_size,
    reduced,
    srgb_to_linear,
    to_uint8,
)

GREY = 30000  # of 65535: 116.7 of 255


def test_every_kind_of_png(tmp_path):
    draw = np.random.default_rng(0)
    colour = draw.integers(0, 256, (6, 5, 3), dtype=np.uint8)
    Image.fromarray(colour).save(tmp_path / "colour.png")
    assert np.array_equal(read_image(tmp_path / "colour.png"), colour)
    palette = Image.fromarray(colour).quantize(16)
    palette.save(tmp_path / "palette.png")
    assert np.array_equal(read_image(tmp_path / "palette.png"), np.asarray(palette.convert("RGB")))
    palette.save(tmp_path / "clear.png", transparency=0)
    clear = read_image(tmp_path / "clear.png")
    assert clear.shape == (6, 5, 4) and np.array_equal(clear[..., 3] == 0, np.asarray(palette) == 0)
    Image.fromarray(colour[..., 0]).save(tmp_path / "grey.png")
    assert np.array_equal(read_image(tmp_path / "grey.png"), np.repeat(colour[..., :1], 3, axis=-1))
    Image.fromarray(np.full((6, 5), GREY, np.uint16)).save(tmp_path / "deep.png")
    assert (read_image(tmp_path / "deep.png") == 117).all()  # not 255, which a plain conversion clips to
    Image.new("LA", (5, 6), (9, 80)).save(tmp_path / "la.png")
    assert read_image(tmp_path / "la.png").shape == (6, 5, 4)


def test_sixteen_bits_a_channel(tmp_path):
    import zlib

    rows = b"".join(b"\0" + struct.pack(">3H", GREY, 65535, 0) * 4 for _ in range(3))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 4, 3, 16, 2, 0, 0, 0))
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))
    assert np.abs(read_image(tmp_path / "a.png").astype(int) - [117, 255, 0]).max() <= 1


def test_photographs_are_taken_as_they_are_stored(tmp_path):
    pixels = np.zeros((8, 16, 3), np.uint8)
    pixels[:, 8:] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees for viewing
    Image.fromarray(pixels).save(tmp_path / "a.jpg", exif=exif, quality=95)
    assert read_size(tmp_path / "a.jpg") == (16, 8)
    assert np.abs(read_image(tmp_path / "a.jpg").astype(int) - pixels).max() < 8
    Image.new("CMYK", (4, 4)).save(tmp_path / "c.jpg")
    assert read_image(tmp_path / "c.jpg").shape == (4, 4, 3)


@pytest.mark.hard_case(62)
def test_formats_that_run_programs_are_not_opened(tmp_path):
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\nshowpage\n")
    with pytest.raises(SnergError, match="cannot be read"):
        read_image(tmp_path / "a.png")


def write_exr(path: Path, values: np.ndarray, names: tuple[str, ...] = (), window: tuple[int, int, int, int] | None = None) -> None:
    oiio = pytest.importorskip("OpenImageIO")
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], values.shape[2], "float")
    if names:
        spec.channelnames = names
    if window:
        spec.x, spec.y, spec.full_width, spec.full_height = window
    file = oiio.ImageOutput.create(str(path))
    assert file.open(str(path), spec), file.geterror()
    file.write_image(np.ascontiguousarray(values, np.float32))
    file.close()


@pytest.mark.hard_case(8)
def test_openexr_is_linear_and_premultiplied(tmp_path):
    values = np.zeros((4, 6, 4), np.float32)
    values[:2] = [0.5 * srgb_to_linear(np.array(0.5)), 0.5, 0, 0.5]  # half covered by a display grey of 0.5, 1, 0
    values[3] = [3, 1, 0.2, 1]
    write_exr(tmp_path / "a.exr", values)
    assert read_size(tmp_path / "a.exr") == (6, 4)
    pixels = read_image(tmp_path / "a.exr")
    assert np.abs(pixels[0, 0].astype(int) - [128, 255, 0, 128]).max() <= 1 and (pixels[2] == 0).all()
    assert pixels[3, 0].tolist() == [255, 255, round(255 * float(linear_to_srgb(np.array(0.2)))), 255]
    write_exr(tmp_path / "b.exr", values[..., :3])
    assert read_image(tmp_path / "b.exr").shape == (4, 6, 3)


def test_openexr_passes_and_windows(tmp_path):
    values = np.random.default_rng(0).uniform(0, 1, (4, 6, 5)).astype(np.float32)
    names = ("ViewLayer.Depth.Z", *(f"ViewLayer.Combined.{c}" for c in "RGB"), "ViewLayer.Mist.Z")
    write_exr(tmp_path / "passes.exr", values, names)
    expected = np.floor(linear_to_srgb(values[..., 1:4]) * 255 + 0.5)
    assert np.abs(read_image(tmp_path / "passes.exr") - expected).max() <= 1
    write_exr(tmp_path / "crop.exr", values[..., :4] * 0 + 1, window=(2, 1, 10, 7))
    whole = read_image(tmp_path / "crop.exr")
    assert whole.shape == (7, 10, 4) and (whole[1:5, 2:8] == 255).all() and whole[..., 3].sum() == 24 * 255
    write_exr(tmp_path / "depth.exr", values[..., :1], ("Z",))
    with pytest.raises(SnergError, match="channels"):
        read_image(tmp_path / "depth.exr")


@pytest.mark.hard_case(59, 61)
def test_openexr_that_is_broken(tmp_path):
    values = np.full((64, 64, 4), 0.5, np.float32)
    write_exr(tmp_path / "a.exr", values * np.random.default_rng(0).uniform(0, 1, values.shape))
    whole = (tmp_path / "a.exr").read_bytes()
    box = struct.pack("<4i", 0, 0, 63, 63)
    assert whole.count(box) == 2  # the data window and the display window
    false = whole.replace(box, struct.pack("<4i", 0, 0, 99999, 99999))
    values[3, 3, 1] = np.nan
    write_exr(tmp_path / "nan.exr", values)
    nan = (tmp_path / "nan.exr").read_bytes()
    for content in (b"", b"\x76\x2f\x31\x01", whole[:200], whole[: len(whole) // 2], false, nan):
        (tmp_path / "bad.exr").write_bytes(content)
        with pytest.raises(SnergError, match=r"bad\.exr") as error:
            read_image(tmp_path / "bad.exr")
        assert "\n" not in str(error.value)
    with pytest.raises(SnergError, match="does not exist"):
        read_size(tmp_path / "none.exr")


def test_openexr_without_openimageio(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "OpenImageIO", None)
    (tmp_path / "a.exr").write_bytes(b"")
    with pytest.raises(SnergError, match="pip install openimageio"):
        read_size(tmp_path / "a.exr")


def test_premultiplied_to_straight():
    found = display_referred(np.array([[0.0, 0, 0, 0], [0.25, 0, 0, 0.25], [2.0, 0, 0, 0.5]], np.float32))
    assert np.allclose(found, [[0, 0, 0, 0], [1, 0, 0, 0.25], [1, 0, 0, 0.5]])


def test_making_pictures_smaller():
    pixels = np.random.default_rng(0).integers(0, 256, (11, 9, 3), dtype=np.uint8)
    expected = pixels[:9, :9].reshape(3, 3, 3, 3, 3).mean(axis=(1, 3))
    assert np.abs(reduced(pixels, 3) - expected).max() <= 1
    assert reduced(pixels, 1) is pixels


@pytest.mark.hard_case(61)
def test_large_photographs_raise_no_warning(tmp_path):
    side = 9600  # 92 million pixels: more than Pillow likes, fewer than MAX_PIXELS
    assert side * side < MAX_PIXELS
    Image.new("1", (side, side)).save(tmp_path / "a.png", compress_level=0)
    assert read_size(tmp_path / "a.png") == (side, side)


def smooth(width: int = 48, height: int = 32) -> np.ndarray:
    """[H, W, 3]: a gradient, which lossy codecs keep nearly as it is."""
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([columns * 4, rows * 6, np.full_like(rows, 90)], axis=-1).astype(np.uint8)


def test_avif_with_and_without_alpha(tmp_path):
    pixels = smooth()
    Image.fromarray(pixels).save(tmp_path / "a.avif", quality=95)
    assert read_size(tmp_path / "a.avif") == (48, 32)
    assert np.abs(read_image(tmp_path / "a.avif").astype(int) - pixels).max() < 12
    clear = np.dstack([pixels, np.where(np.arange(48) < 24, 0, 255) * np.ones((32, 1))]).astype(np.uint8)
    Image.fromarray(clear).save(tmp_path / "b.avif", quality=95)
    found = read_image(tmp_path / "b.avif")
    assert found.shape == (32, 48, 4) and found[5, 5, 3] == 0 and found[5, 40, 3] == 255
    data = (tmp_path / "a.avif").read_bytes()
    (tmp_path / "a.avif").write_bytes(data[: len(data) // 2])
    for read in (read_image, read_size):
        with pytest.raises(SnergError, match=r"a\.avif"):
            read(tmp_path / "a.avif")


def test_heic_under_any_name(tmp_path):
    heif = pytest.importorskip("pillow_heif")
    pixels = smooth()
    heif.from_pillow(Image.fromarray(pixels)).save(tmp_path / "a.heic", quality=95)
    (tmp_path / "b.jpg").write_bytes((tmp_path / "a.heic").read_bytes())
    for name in ("a.heic", "b.jpg"):
        assert read_size(tmp_path / name) == (48, 32)
        assert np.abs(read_image(tmp_path / name).astype(int) - pixels).max() < 12
    data = (tmp_path / "a.heic").read_bytes()
    (tmp_path / "a.heic").write_bytes(data[: len(data) // 2])
    for read in (read_image, read_size):
        with pytest.raises(SnergError, match=r"a\.heic"):
            read(tmp_path / "a.heic")


def test_a_format_without_its_decoder_says_what_to_install(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(100))
    (tmp_path / "a.avif").write_bytes(b"\0\0\0\x18ftypavif\0\0\0\0mif1avif" + bytes(100))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    monkeypatch.setattr("snerg.core.io.images.features.check", lambda name: False)
    for name, says in (("a.heic", "pip install pillow-heif"), ("a.avif", "pip install -U pillow")):
        with pytest.raises(SnergError, match=says):
            read_size(tmp_path / name)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "avif"])
def test_a_file_copied_in_part_is_known_by_its_size(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    file = tmp_path / f"a.{suffix}"
    Image.fromarray(noise).save(file)
    data = file.read_bytes()
    file.write_bytes(data + bytes(9000))  # another program's data may follow
    assert read_size(file) == (64, 64)
    file.write_bytes(data[: len(data) * 2 // 3])
    with pytest.raises(SnergError, match="a." + suffix):
        read_size(file)


def test_srgb_is_that_of_the_standard():
    """IEC 61966-2-1, in floats of 64 bits, at every 8-bit level and both ways; three values from its table."""
    level = np.arange(256) / 255
    linear = np.array([c / 12.92 if c <= 0.04045 else math.pow((c + 0.055) / 1.055, 2.4) for c in level.tolist()])
    assert np.abs(srgb_to_linear(level) - linear).max() < 1e-15 and np.abs(linear_to_srgb(linear) - level).max() < 1e-7
    assert srgb_to_linear(np.array([10, 11, 128]) / 255) == pytest.approx([0.003035270, 0.003346536, 0.215860501], rel=1e-6)
    assert linear_to_srgb(np.array([0.001, 0.0031308, 0.01, 0.18, -0.1, 1.0])) == pytest.approx(
        [0.01292, 0.040450, 0.0998528, 0.4613561, -1.292, 1.0], rel=1e-5
    )


@pytest.mark.hard_case(51, 59)
def test_eight_bits_are_rounded_to_nearest():
    """On average nothing is lost at any level; what lies outside is held, and what is not finite is refused."""
    spread = np.linspace(0, 1, 100_001)
    found = to_uint8(spread).astype(np.float64)
    assert np.abs(found - 255 * spread).max() <= 0.5 + 1e-9 and abs((found - 255 * spread).mean()) < 1e-4
    assert to_uint8(np.array([-0.2, 1.01, 1e9])).tolist() == [0, 255, 255]
    for bad in (np.nan, np.inf):
        with pytest.raises(SnergError, match="not finite"):
            to_uint8(np.array([0.5, bad]))


@pytest.mark.hard_case(8)
def test_half_transparent_edges_are_blended_as_they_are_stored():
    """Black of alpha 1/2 over white is 1/2, not the 0.735 of linear light; over a colour that colour's half is added."""
    pixels = np.array([[0, 0, 0, 128], [200, 100, 50, 51], [10, 20, 30, 255], [255, 255, 255, 0]], np.uint8)
    alpha = pixels[:, 3:] / 255
    for background in ((1.0, 1.0, 1.0), (0.2, 0.0, 0.8)):
        assert over(pixels, background) == pytest.approx(pixels[:, :3] / 255 * alpha + (1 - alpha) * np.array(background), abs=1e-6)
    assert over(pixels)[0] == pytest.approx([0.498, 0.498, 0.498], abs=1e-3)


def test_every_16_bit_value_becomes_the_nearest_level(tmp_path):
    values = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    Image.fromarray(values).save(tmp_path / "deep.png")
    assert np.array_equal(read_image(tmp_path / "deep.png")[..., 0], np.rint(values.astype(np.float64) * 255 / 65535))
