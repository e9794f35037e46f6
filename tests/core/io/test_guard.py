"""The guard of readers: what a file may ask for, and the one sentence that anything else becomes."""

from __future__ import annotations

import os
import struct
import tokenize
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from snerg.core.data.readers.camera_files import read_cameras
from snerg.core.errors import MAX_MESSAGE, Cancelled, SnergError
from snerg.core.geometry.box import Box
from snerg.core.io.guard import read_arrays, reading
from snerg.core.io.images import read_image, read_mask, read_size
from snerg.core.io.json_files import read_json
from snerg.core.nerf.checkpoint import read_field

RAISED = (
    zlib.error("x"),
    tokenize.TokenError("x"), OverflowError(), RecursionError("deep"), struct.error("x"),
    RuntimeError("AVIF"), IndexError(),
    np.linalg.LinAlgError("x"), UnicodeDecodeError("utf-8", b"a", 0, 1, "x"), AttributeError("a"), StopIteration(), OSError("broken data"),
    zipfile.BadZipFile("x"), MemoryError(), KeyError("a\nb"), TypeError("t"), EOFError(),
)  # fmt: skip


@pytest.mark.parametrize("error", RAISED, ids=lambda error: type(error).__name__)
def test_whatever_a_decoder_raises_is_one_sentence(error):
    with pytest.raises(SnergError, match="/a/file") as caught, reading(Path("/a/file"), "write it again"):
        raise error
    assert str(caught.value).endswith(".") and str(caught.value).isprintable()


def test_being_stopped_passes():
    with pytest.raises(Cancelled), reading(Path("/a/file"), "write it again"):
        raise Cancelled("Stopped.")


def test_a_sentence_is_short_and_printable_whatever_it_names():
    sentence = str(SnergError("The file " + "a\nb\x1b[31m\ud800" * 50_000 + " is damaged."))
    assert len(sentence) <= MAX_MESSAGE and sentence.isprintable() and sentence.endswith("is damaged.")


@pytest.mark.skipif(os.name != "posix", reason="Windows has no pipes in folders")
@pytest.mark.parametrize("read", [Box.read, read_cameras, read_json, read_image, read_size, read_field])
def test_only_regular_files_are_read(read, tmp_path):
    pipe = tmp_path / "pipe.png"
    os.mkfifo(pipe)
    for path in (pipe, Path("/dev/zero")):
        with pytest.raises(SnergError):  # and at once: a pipe that nobody writes to would be waited for
            read(path)


def test_an_npz_that_unpacks_to_much_is_refused_by_its_header(tmp_path):
    path = tmp_path / "field.npz"
    np.savez_compressed(path, a=np.zeros(2**26, np.uint8))
    assert path.stat().st_size < 2**17
    tracemalloc.start()
    with pytest.raises(SnergError, match="would unpack to"):
        read_field(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 2**20


@pytest.mark.parametrize("change", ["longer", "shorter", "another version"])
def test_an_array_that_is_not_what_its_header_says_is_refused(tmp_path, change):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(100))
    with zipfile.ZipFile(path) as archive:
        data = archive.read("a.npy")
    changed = {
        "longer": data.replace(b"(100,)", b"(999,)"),
        "shorter": data[:-8],
        "another version": data[:6] + b"\x09" + data[7:],
    }[change]
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", changed)
    with pytest.raises(SnergError, match=r"a\.npz"), reading(path, "write it again"):
        read_arrays(path, 2**20)


def test_arrays_come_back_as_they_were(tmp_path):
    arrays = {
        "a": np.arange(6.0).reshape(2, 3),
        "f": np.asfortranarray(np.arange(6).reshape(2, 3)),
        "n": np.array(4),
        "t": np.array("text"),
    }
    np.savez(tmp_path / "a.npz", **arrays)
    back = read_arrays(tmp_path / "a.npz", 2**20)
    assert back.keys() == arrays.keys()
    assert all(np.array_equal(back[name], array) and back[name].dtype == array.dtype for name, array in arrays.items())
    back["a"][0, 0] = 7  # they are the reader's own


def test_a_small_file_with_a_huge_picture_is_refused_by_its_header(tmp_path):
    Image.new("1", (11000, 11000)).save(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size < 2**15
    for read in (read_size, read_image):
        with pytest.raises(SnergError, match="11000 x 11000 pixels in"):
            read(tmp_path / "a.png")


def test_a_white_mask_of_a_large_photograph_is_read(tmp_path):
    Image.new("1", (8000, 6000), 255).save(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size < 2**15
    assert read_mask(tmp_path / "a.png", 80, 60).all()
