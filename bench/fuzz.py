"""`make fuzz`: every reader is given damaged files, and each must be accepted or refused with one sentence.

A seeded run damages small valid files of every kind that SNeRG reads, one change or a few an input, and calls the reader in a worker
with a limit of memory and of time. Whatever ends otherwise is written down with the number that makes it again:
`python bench/fuzz.py --only NUMBER`. The last line counts inputs by outcome; the exit code is 1 where any was mishandled.
"""

from __future__ import annotations

import argparse
import copy
import io
import json
import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from snerg.core.commands.info import page_cameras

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
MEMORY = 2**30  # bytes that a reader may take beside what the worker has
EACH = 5000  # inputs that a worker takes
SECONDS = 20.0  # that it may take
GOOD = ("accepted", "refused")
EXTREMES: list[Any] = [
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**30, -(10**400), 1e30, -1e300, 1e-320, float("nan"), float("inf"), -float("inf"), "",
    "x" * 5000, "a\nb\x1b[31m", "../../etc/passwd", "\ud800", "__proto__", [], {}, [[]], [0] * 3, [[1, 0], [0, 1]], {"a": {"b": []}},
]  # fmt: skip


@dataclass(frozen=True)
class Subject:
    """A kind of file. make: writes a valid one into an empty folder; read: calls the reader; files: which of them are damaged."""

    name: str
    make: Callable[[Path], object]
    read: Callable[[Path], object]
    files: tuple[str, ...]


def subjects() -> list[Subject]:
    """One for each reader."""
    import captures

    import flax_checkpoint
    from scenes import make_cameras, make_snerg, random_network
    from snerg.core.baking.resume import ResumeCache
    from snerg.core.data.load import read_dataset
    from snerg.core.data.readers.camera_files import read_cameras, write_transforms
    from snerg.core.data.readers.path_files import path_of_cameras, read_path
    from snerg.core.data.readers.ply import read_ply
    from snerg.core.export.bundle import cameras_json
    from snerg.core.export.codecs import CodecSettings
    from snerg.core.export.reference import read_reference, write_reference
    from snerg.core.export.scene_files import codec_of, read_scene, write_scene
    from snerg.core.geometry.box import Box
    from snerg.core.geometry.camera_path import path_bytes
    from snerg.core.io.files import write_arrays
    from snerg.core.io.guard import reading
    from snerg.core.io.images import read_image, read_mask
    from snerg.core.io.json_files import json_bytes
    from snerg.core.nerf.checkpoint import read_field, write_field
    from snerg.core.nerf.field import Field
    from snerg.core.nerf.hash_grid import HashGrid
    from snerg.core.nerf.model import HashModelConfig, MlpModelConfig, init_field
    from snerg.core.nerf.reference_checkpoint import field_of, read_reference_checkpoint
    from snerg.core.nerf.sampling import CELLS, Domain
    from snerg.core.study import effects, field_probe_file
    from snerg.core.study.field_probe import FieldProbe, Rates
    from snerg.core.study.plan import Configuration
    from snerg.core.study.sweep import read_row
    from snerg.core.training.log import read_log

    small = make_snerg((14, 12, 15))
    ring, facing = captures.ring(4), captures.facing(4)
    points = captures.thing(20, 0)

    def field(folder: Path, family: Any, view: str) -> None:
        params = init_field(family, view, np.random.default_rng(0))
        domain = Domain.around(-np.ones(3), np.ones(3))
        decision = {"effect": "NDC", "chosen": False, "evidence": "none", "measured": 1.0, "threshold": 2.0, "overridden": False}
        about = {"steps": 3, "seconds": 1.5, "settings": {"background": "white"}, "decisions": [decision]}
        about["dataset_options"] = {"holdout": 8, "downscale": 1}
        network = random_network() if "view" in params else None
        held = np.ones(CELLS**3, bool)
        write_field(Field(family, params["field"], network, domain, held, 0.01, make_cameras()[:2], "", about, view=view), folder)
        arrays = dict(np.load(folder / "field.npz"))
        np.savez_compressed(folder / "field.npz", **arrays)  # small, or most damage would fall on the occupancy

    def scene(folder: Path, codec: str) -> None:
        baked = make_snerg((14, 12, 15), fog=False)
        if codec == "float":
            baked, codec = replace(baked, cells=np.float32(baked.cells) / 255), "png"
        bake: dict[str, Any] = {"settings": {"visibility_threshold": 0.01}, "voxels": {"held": 5, "seen": 3}}
        bake["seconds"] = {"visibility": 1.0, "prefilter": 2.0}
        bake |= {"samples": 2, "samples_measured": [{"samples": 1, "error": 0.1}, {"samples": 2, "error": 0.05}]}
        bake |= {"light": {"passes": 0.5, "voxels": 3.0}}
        baked.about.update(bake=bake, refine={"gain_db": 0.1, "psnr_before": 1.0, "psnr_after": 1.1, "seconds": {"all": 1.0}})
        write_scene(baked, folder / "s", codec=CodecSettings(codec))

    def shown(folder: Path) -> None:
        effects.of_scene(read_scene(folder / "s"), codec_of(folder / "s"))

    def told(folder: Path) -> None:
        read = read_field(folder)
        effects.of_field(read)

    def dataset(folder: Path) -> None:
        read = read_dataset(folder)
        read.read(0)
        read.mask(0)
        read.suggested_box()

    def picture(kind: str, mode: str) -> Callable[[Path], None]:
        from PIL import Image

        def make(folder: Path) -> None:
            pixels = np.random.default_rng(1).integers(0, 255, (24, 20, 4), np.uint8)
            Image.fromarray(pixels).convert(mode).save(folder / f"a.{kind}")

        return make

    def row(folder: Path) -> None:
        value = {"key": "row", "config": Configuration().to_json(), "psnr": 30.0, "ms": 5.0, "megabytes": 1.0, "seconds": {"bake": 1.0}}
        (folder / "row.json").write_bytes(json_bytes(value | {"psnr_of_views": [30.0], "predicted": {"ms": 4.0}, "ssim": 0.9}))

    def kept(folder: Path) -> None:
        (folder / ".snerg").write_text("")
        write_arrays(folder / "key-stage-000000.npz", {"0.a": np.arange(20), "1.a": np.ones((3, 4), np.float32)})

    def survey(folder: Path) -> None:
        rates, two = Rates(**{one.name: 1.0 for one in fields(Rates)}), np.ones((2, 5), bool)
        nothing: Any = None
        looked = FieldProbe(
            nothing,
            nothing,
            np.ones((5, 3)),
            0.1,
            two[0],
            np.float64([2, 1]),
            two,
            two,
            (1, 2),
            np.ones(2),
            (np.ones((4, 3)), 0.1),
            0.1,
            rates,
            1.0,
        )
        field_probe_file.write_field_probe(folder / "survey.npz", looked, "mark")

    def read_field_probe(folder: Path) -> None:
        with reading(folder / "survey.npz", "delete it"):
            field_probe_file.checked(*field_probe_file.open_file(folder / "survey.npz"))

    def ply(folder: Path) -> None:
        head = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {a}\n" for a in "xyz")
        head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
        (folder / "a.ply").write_text(head + "".join(f"{i} 2 3 4 5 6\n" for i in range(3)))

    def move(folder: Path) -> None:
        (folder / "p.json").write_bytes(path_bytes(path_of_cameras(ring)))

    def binary_ply(folder: Path) -> None:
        head = (
            "ply\nformat binary_little_endian 1.0\nelement vertex 3\n" + "".join(f"property double {a}\n" for a in "xyz") + "end_header\n"
        )
        (folder / "a.ply").write_bytes(head.encode() + np.arange(9.0).tobytes())

    hashed, mlp = HashModelConfig(HashGrid(2, 4, 8, 2, 8), 8), MlpModelConfig(8, 3, 2, 3)
    lines = [{"step": i, "seconds": 0.5, "psnr": 20.0, "fraction": 0.1} for i in range(1, 6)]
    result = [
        Subject("transforms (instant-ngp)", lambda f: captures.write_ngp(f, ring), dataset, ("transforms.json", "images/000.png")),
        Subject("transforms (nerfstudio)", lambda f: captures.write_nerfstudio(f, ring), dataset, ("*.json", "*.ply")),
        Subject("cameras", lambda f: write_transforms(f / "c.json", ring, list("abcd")), lambda f: read_cameras(f / "c.json"), ("c.json",)),
        Subject("camera path", move, lambda f: read_path(f / "p.json"), ("p.json",)),
        Subject("LLFF", lambda f: captures.write_llff(f, facing, np.tile([2.0, 9.0], (4, 1))), dataset, ("*.npy",)),
        Subject("COLMAP, binary", lambda f: captures.write_colmap(f, ring, *points, model="PINHOLE"), dataset, ("sparse/0/*",)),
        Subject("COLMAP, text", lambda f: captures.write_colmap(f, ring, *points, model="PINHOLE", binary=False), dataset, ("sparse/0/*",)),
        Subject("points, text", ply, lambda f: read_ply(f / "a.ply"), ("a.ply",)),
        Subject("points, binary", binary_ply, lambda f: read_ply(f / "a.ply"), ("a.ply",)),
        Subject("mask", picture("png", "L"), lambda f: read_mask(f / "a.png", 20, 24), ("a.png",)),
        Subject("field, hash grid", lambda f: field(f, hashed, "deferred"), told, ("field.npz",)),
        Subject("field, MLP", lambda f: field(f, mlp, "sample"), told, ("field.npz",)),
        Subject("log", lambda f: (f / "log.jsonl").write_text("".join(json.dumps(v) + "\n" for v in lines)), read_log, ("log.jsonl",)),
        Subject(
            "checkpoint",
            lambda f: flax_checkpoint.write(f / "checkpoint_7", flax_checkpoint.tree(flax_checkpoint.networks(np.random.default_rng(0)))),
            lambda f: field_of(read_reference_checkpoint(f / "checkpoint_7"), ""),
            ("checkpoint_7",),
        ),
        Subject("reference layout", lambda f: write_reference(small, f / "r"), lambda f: read_reference(f / "r"), ("r/*",)),
        Subject("box", lambda f: (f / "b.json").write_bytes(json_bytes(Box.axis_aligned([0] * 3, [1] * 3).to_json())),
                lambda f: Box.read(f / "b.json"), ("b.json",)),
        Subject("page", lambda f: (f / "cameras.json").write_bytes(json_bytes(cameras_json(make_cameras()))),
                lambda f: page_cameras(f / "cameras.json"), ("cameras.json",)),
        Subject("study row", row, lambda f: read_row(f / "row.json"), ("row.json",)),
        Subject("survey", survey, read_field_probe, ("survey.npz",)),
        Subject("resume folder", kept, lambda f: list(ResumeCache(f, "key").read("stage")), ("*.npz",)),
    ]  # fmt: skip
    for codec in ("png", "webp", *(["jxl"] if find_spec("pillow_jxl") else []), "jpeg", "avif", "float"):
        files = ("s/scene.json",) if codec == "png" else ("s/*",)
        result.append(Subject(f"scene, {codec}", lambda f, codec=codec: scene(f, codec), shown, files))
    for kind, mode in (("png", "RGBA"), ("png", "P"), ("png", "1"), ("jpg", "RGB"), ("webp", "RGBA"), ("tiff", "RGB"), ("bmp", "RGB")):
        result.append(
            Subject(f"image, {kind} {mode}", picture(kind, mode), lambda f, kind=kind: read_image(f / f"a.{kind}"), (f"a.{kind}",))
        )
    return result


# Damage


def damaged(path: Path, draw: np.random.Generator) -> None:
    """Change a file in one of the ways that suit it."""
    data = path.read_bytes()
    kinds: list[Callable[[bytes, np.random.Generator], bytes]] = [flip, cut, splice, grow, zeros, integers]
    if path.suffix in (".json", ".jsonl"):
        kinds = [flip, cut, splice, *[edit_json] * 9]
    elif data[:2] == b"PK":
        kinds = [flip, cut, integers, *[edit_zip] * 6]
    elif data[:6] == b"\x93NUMPY":
        kinds = [flip, cut, *[edit_array] * 4, edit_header]
    elif path.suffix in (".txt", ".ply"):
        kinds += [edit_words] * 4
    try:
        path.write_bytes(kinds[draw.integers(len(kinds))](data, draw))
    except Exception:  # what was damaged before can no longer be edited
        path.write_bytes(flip(data, draw))


def flip(data: bytes, draw: np.random.Generator) -> bytes:
    """Some bits."""
    changed = bytearray(data)
    head = draw.random() < 0.5  # headers decide most
    for _ in range(int(draw.integers(1, 9))):
        if changed:
            changed[int(draw.integers(min(len(changed), 256) if head else len(changed)))] ^= 1 << int(draw.integers(8))
    return bytes(changed)


def cut(data: bytes, draw: np.random.Generator) -> bytes:
    """Cut short, sometimes to nothing."""
    return data[: int(draw.integers(len(data) + 1))]


def splice(data: bytes, draw: np.random.Generator) -> bytes:
    """A part taken out, or put in again elsewhere."""
    a, b = sorted(int(i) for i in draw.integers(len(data) + 1, size=2))
    at = int(draw.integers(len(data) + 1))
    return data[:a] + data[b:] if draw.random() < 0.5 else data[:at] + data[a : min(b, a + 4096)] + data[at:]


def grow(data: bytes, draw: np.random.Generator) -> bytes:
    """Noise behind."""
    return data + draw.bytes(int(draw.integers(1, 2000)))


def zeros(data: bytes, draw: np.random.Generator) -> bytes:
    """A run of zeros or ones."""
    a = int(draw.integers(len(data) + 1))
    return data[:a] + bytes([int(draw.integers(2)) * 255]) * int(draw.integers(1, 64)) + data[a + 64 :]


def integers(data: bytes, draw: np.random.Generator) -> bytes:
    """An extreme number in place of some bytes."""
    size = int(draw.choice([2, 4, 8]))
    value = int(draw.choice([0, 1, 2 ** (8 * size - 1) - 1, 2 ** (8 * size - 1) - 2, 2 ** (4 * size)])) & (2 ** (8 * size) - 1)
    at = int(draw.integers(min(len(data), 400) + 1))
    return data[:at] + value.to_bytes(size, "little" if draw.random() < 0.5 else "big") + data[at + size :]


def edit_words(data: bytes, draw: np.random.Generator) -> bytes:
    """Another word in place of one."""
    words = data.split(b" ")
    choices = [b"nan", b"inf", b"-1", b"99999999999999999999", b"1e400", b"", b"\xff\xfe", b"x" * 9000, b"0", b"\n", b"5 5 5"]
    words[int(draw.integers(len(words)))] = choices[int(draw.integers(len(choices)))]
    return b" ".join(words)


def edit_json(data: bytes, draw: np.random.Generator) -> bytes:
    """One to three values changed, swapped, deleted or nested; in a log, of one of its lines."""
    try:
        value = json.loads(data)
    except ValueError:
        lines = data.split(b"\n")
        at = int(draw.integers(max(len(lines) - 1, 1)))
        if len(lines) > 1 and lines[at][:1] == b"{" and lines[at][-1:] == b"}":
            try:
                json.loads(lines[at])
            except ValueError:
                return data
            lines[at] = edit_json(lines[at], draw).replace(b"\n", b" ")
        return b"\n".join(lines)
    for _ in range(int(draw.integers(1, 4))):
        value = edited(value, draw)
    text = json.dumps(value)
    return text.encode() if draw.random() < 0.97 else b"[" * 100_000 + text.encode()


def edited(value: Any, draw: np.random.Generator) -> Any:
    """A value with one place in it changed."""
    value = copy.deepcopy(value)
    places: list[tuple[Any, Any]] = []

    def collect(inner: Any) -> None:
        for key in list(inner) if isinstance(inner, dict) else range(len(inner)) if isinstance(inner, list) else ():
            places.append((inner, key))
            collect(inner[key])

    collect(value)
    if not places or draw.random() < 0.02:
        return EXTREMES[int(draw.integers(len(EXTREMES)))]
    top = [place for place in places if place[0] is value]
    chosen = top if draw.random() < 0.4 else places
    where, key = chosen[int(draw.integers(len(chosen)))]
    what = int(draw.integers(6))
    if what == 0:
        del where[key]
    elif what == 1:
        other, there = places[int(draw.integers(len(places)))]
        if isinstance(other, dict) or (isinstance(there, int) and there < len(other)):
            where[key] = copy.deepcopy(other.get(there) if isinstance(other, dict) else other[there])
    elif what == 2 and isinstance(where[key], int | float):
        where[key] = where[key] * float(draw.choice([-1, 0, 1e3, 1e9, 1e30, 1e-9])) + float(draw.choice([0, 0.5]))
    elif what == 3 and isinstance(where[key], list):
        where[key] = where[key] * int(draw.choice([0, 2, 3])) if draw.random() < 0.5 else where[key][:-1]
    else:
        where[key] = EXTREMES[int(draw.integers(len(EXTREMES)))]
    return value


def edit_array(data: bytes, draw: np.random.Generator) -> bytes:
    """An .npy of another shape or type, or with other values."""
    array = np.load(io.BytesIO(data))
    return saved(changed(array, draw))


def changed(array: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    """An array of another shape or type, or with other values."""
    with np.errstate(all="ignore"):
        what = int(draw.integers(7))
        if what == 0:
            return array[..., :-1] if array.ndim else array.reshape(1)
        if what == 1:
            return array.reshape(-1)
        if what == 2:
            return np.concatenate([array.reshape(-1)] * 2)
        if what == 3:
            kinds = ["f8", "f4", "f2", "i4", "u1", "?", "c8", "S3", "U2", ">f4"]
            return array.astype(kinds[int(draw.integers(len(kinds)))]) if array.dtype.kind in "fiub" else array.astype("S9")
        if what == 4:
            return array[None]
        if what == 5:
            return array[:0] if array.ndim else array
        array = array.copy()
        if array.size and array.dtype.kind == "f":
            array.reshape(-1)[int(draw.integers(array.size))] = draw.choice([np.nan, np.inf, -np.inf, 1e30, -1])
        return array


def saved(array: np.ndarray) -> bytes:
    """As an .npy."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def edit_header(data: bytes, draw: np.random.Generator) -> bytes:
    """Another shape or type in an .npy's header than in its data."""
    old = data[10:128]
    shapes = [b"(999999999,)", b"(-1, 3)", b"(1 << 40,)", b"((((((", b"(0, 1099511627776)", b"(2," * 30, b"(1e9,)", b"([],)", b"(True,)"]
    at = old.find(b"'shape': ")
    new = old[: at + 9] + shapes[int(draw.integers(len(shapes)))] + b", }"
    if draw.random() < 0.4:
        kinds = [b"|O", b"<f80", b"|V0", b"<U0", b"|b1", b"<M8", b"x" * 20, b"<f8,<f8"]
        new = old.replace(b"<f4", kinds[int(draw.integers(len(kinds)))]).replace(b"<f8", kinds[int(draw.integers(len(kinds)))])
    return data[:10] + new[: len(old)].ljust(len(old) - 1) + b"\n" + data[128:]


def edit_zip(data: bytes, draw: np.random.Generator) -> bytes:
    """An .npz with a member changed, deleted, doubled, renamed or unpacking to very much; or its JSON edited."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            members = {name: archive.read(name) for name in archive.namelist()}
    except Exception:  # damaged before
        return flip(data, draw)
    names = list(members)
    name = names[int(draw.integers(len(names)))]
    if "json.npy" in members and draw.random() < 0.6:
        value = edit_json(np.load(io.BytesIO(members["json.npy"])).tobytes(), draw)
        members["json.npy"] = saved(np.frombuffer(value, np.uint8))
    else:
        what = int(draw.integers(6))
        if what == 0:
            del members[name]
        elif what == 1:
            members[name] = edit_header(members[name], draw)
        elif what == 2:
            members[name] = members[names[int(draw.integers(len(names)))]]
        elif what == 3 and draw.random() < 0.1:
            members[name] = saved(np.zeros(2**26, np.uint8))
        elif what == 4:
            members[name + "x"] = members.pop(name)
        else:
            members[name] = saved(changed(np.load(io.BytesIO(members[name])), draw))
    buffer = io.BytesIO()
    methods = [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA]
    with zipfile.ZipFile(buffer, "w", methods[int(draw.integers(len(methods)))]) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return buffer.getvalue() if draw.random() < 0.9 else integers(buffer.getvalue(), draw)


# Running


def attempt(subject: Subject, template: Path, seed: int, number: int) -> tuple[str, str]:
    """(outcome, what was said) of input `number`."""
    from snerg.core.errors import SnergError

    draw = np.random.default_rng([seed, number])
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name) / "input"
        shutil.copytree(template, folder)
        files = sorted({path for pattern in subject.files for path in folder.glob(pattern) if path.is_file() and path.name != ".snerg"})
        for _ in range(1 if draw.random() < 0.8 else 2):
            damaged(files[int(draw.integers(len(files)))], draw)
        try:
            subject.read(folder)
        except SnergError as error:
            said = str(error)
            if "more memory than there is" in said:
                return "out of memory", said
            return ("refused", said) if 0 < len(said) <= 1000 and said.isprintable() else ("bad sentence", repr(said[:300]))
        except MemoryError:
            return "out of memory", traceback.format_exc()
        except BaseException:
            return "traceback", traceback.format_exc()
        return "accepted", ""


def worker(pipe: Any, seed: int, folder: str) -> None:
    """Take numbers, send outcomes."""
    warnings.simplefilter("ignore")
    known = subjects()
    templates = []
    for index, subject in enumerate(known):
        template = Path(folder) / f"{index}"
        template.mkdir()
        subject.make(template)
        templates.append(template)
        subject.read(template)  # valid, and what it imports is loaded before memory is limited
    with open("/proc/self/statm" if os.path.exists("/proc/self/statm") else os.devnull) as file:
        held = int((file.read() or "0").split()[0]) * resource.getpagesize()
    if held:
        resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    pipe.send(len(known))
    while (number := pipe.recv()) is not None:
        index = number % len(known)
        outcome, said = attempt(known[index], templates[index], seed, number)
        pipe.send((known[index].name, outcome, said))


class Worker:
    """A process that reads, started again where an input kills or stops it."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.start()

    def start(self) -> None:
        """Begin, and wait until it has made its files."""
        self.folder = tempfile.mkdtemp(prefix="fuzz-")
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=worker, args=(other, self.seed, self.folder), daemon=True)
        self.process.start()
        other.close()
        self.kinds = self.pipe.recv()

    def stop(self) -> None:
        """End it and delete its files."""
        self.process.kill()
        self.process.join()
        shutil.rmtree(self.folder, ignore_errors=True)

    def run(self, number: int) -> tuple[str, str, str]:
        """(kind, outcome, what was said)."""
        self.pipe.send(number)
        try:
            if self.pipe.poll(SECONDS):
                return self.pipe.recv()
            outcome = "timeout"
        except EOFError:
            outcome = "killed"
        self.stop()
        self.start()
        return f"kind {number % self.kinds}", outcome, ""


def fuzz(count: int, seed: int = 0, first: int = 0) -> Counter[str]:
    """Give readers `count` inputs and count the outcomes."""
    found: Counter[str] = Counter()
    runner, began = Worker(seed), time.monotonic()
    try:
        for number in range(first, first + count):
            name, outcome, said = runner.run(number)
            found[outcome] += 1
            if outcome not in GOOD:
                print(f"{number} ({name}): {outcome}\n{said}", flush=True)
            if (number + 1 - first) % EACH == 0:
                print(f"{number + 1 - first} inputs, {time.monotonic() - began:.0f} s", flush=True)
                runner.stop()  # decoders keep what they allocate: after some 30,000 inputs a worker's own memory was all that was left
                runner.start()
    finally:
        runner.stop()
    return found


def main() -> int:
    """The exit code."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=5000)
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--only", type=int, metavar="NUMBER", help="one input alone")
    given = options.parse_args()
    found = fuzz(given.count, given.seed) if given.only is None else fuzz(1, given.seed, given.only)
    print(f"{sum(found.values())} inputs: " + ", ".join(f"{n} {outcome}" for outcome, n in sorted(found.items())))
    return int(any(outcome not in GOOD for outcome in found))


if __name__ == "__main__":
    sys.exit(main())
