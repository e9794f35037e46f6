"""The verbs: what the command line and Blender's operators do, one function each.

Every function takes paths and keyword settings and `progress(fraction, message)`, and returns what it did as JSON
values. What would be in the way is found before hours of work, not after.
"""

from __future__ import annotations

import json
import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .capture.camera import Camera
from .capture.dataset import Dataset, read_dataset
from .capture.images import over_white, png_bytes, to_uint8
from .capture.readers.transforms import read_cameras
from .errors import SnergError
from .export.bundle import viewer_files, write_bundle
from .export.reference import is_reference, read_params, read_reference, write_reference
from .export.scene import is_scene, read_scene, write_scene
from .field.checkpoint import is_field, read_field, write_field
from .field.reference_checkpoint import field_of, find_checkpoint, read_reference_checkpoint
from .files import MARK, check_replaceable, json_bytes, new_folder, read_json
from .grid.box import Box
from .grid.march import Frame, MarchSettings, march, tables_of
from .grid.snerg import Snerg
from .study.metrics import mean_psnr, mse, ssim

if TYPE_CHECKING:
    from .field.field import Field

Progress = Callable[[float, str], None]
Result = dict[str, Any]
RESOLUTION = 512
SAMPLES = 4
WHITE = (1.0, 1.0, 1.0)


def silent(fraction: float, message: str, /) -> None:
    """Progress that nobody watches."""


def within(progress: Progress, start: float, end: float) -> Progress:
    """Progress of a part of the work, from `start` to `end` of the whole."""
    return lambda fraction, message: progress(start + (end - start) * min(max(fraction, 0.0), 1.0), message)


def train_field(
    dataset: Path,
    out: Path,
    preset: str = "fast",
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    progress: Progress = silent,
) -> Result:
    """Train a field on a dataset's train split (JAX); an unfinished training with the same settings goes on where it stopped.

    minutes or steps: how long; the preset's own time when neither is given. Raises SnergError on bad input or when the
    training goes wrong, Cancelled when `progress` does; then `out` holds the field as far as it got.
    """
    check_out(out, "field", dataset)
    with needs_jax():
        from .field.settings import PRESETS
        from .field.train import train
    if preset not in PRESETS:
        raise SnergError(f"There is no preset {preset!r}; choose one of {', '.join(PRESETS)}.")
    settings = replace(PRESETS[preset], seed=seed)
    if steps is not None:
        settings = replace(settings, steps=steps, seconds=None)
    elif minutes is not None:
        settings = replace(settings, seconds=60 * minutes)
    views = read_dataset(dataset, "train")
    resume = _unfinished(out, settings, views)
    field = train(views, settings, out, progress, resume=resume)
    return {
        "field": str(out),
        "views": len(views.views),
        "resumed": resume,
        "steps": field.about.get("steps"),
        "seconds": field.about.get("seconds"),
        "psnr": field.about.get("psnr_training_rays"),
        "bytes": folder_bytes(out),
    }


def _unfinished(out: Path, settings: Any, dataset: Dataset) -> bool:
    """Whether `out` holds a training with just these settings and images that was stopped before its end."""
    if not is_field(out):
        return False
    try:
        field = read_field(out)
    except SnergError:
        return False  # damaged: begin anew
    same = field.about.get("settings") == json.loads(json_bytes(asdict(settings)))
    if not same or field.dataset != str(dataset.root.resolve()) or len(field.cameras) != len(dataset.cameras):
        return False
    about = field.about
    done = about.get("steps", 0) / settings.steps if settings.steps else about.get("seconds", 0) / (settings.seconds or math.inf)
    return bool(done < 1)


def import_source(source: Path, out: Path, progress: Progress = silent) -> Result:
    """Bring in a field (ours, or a reference checkpoint) or a baked scene (ours, or in the reference layout).

    Raises SnergError when `source` is neither, or damaged.
    """
    kind = kind_of(source)
    check_out(out, {"reference scene": "scene", "page": "scene", "checkpoint": "field"}.get(kind, kind), source)
    if kind == "reference scene":
        write_scene(read_reference(source, within(progress, 0, 0.5)), out, within(progress, 0.5, 1))
    elif kind in ("scene", "page"):
        write_scene(any_scene(source), out, progress)
    elif kind == "field":
        write_field(read_field(source), out)
    elif kind == "checkpoint":
        write_field(field_of(read_reference_checkpoint(source), str(source)), out)
    else:
        raise SnergError(f"{source} is a {kind}, which needs no import; give a field, a checkpoint or a baked scene.")
    progress(1.0, "Imported")
    return {"imported": kind, "to": str(out), **info(out)}


def bake_scene(
    field: Path,
    out: Path,
    resolution: int = RESOLUTION,
    box: Path | None = None,
    samples: int = SAMPLES,
    refine: bool = True,
    progress: Progress = silent,
) -> Result:
    """Bake a field inside a box into a scene (JAX), then refine its view-dependence network on the training images.

    resolution: voxels along the box's longest side. box: a JSON file (see Box.from_json); all that the field holds when
    None. samples: a voxel. Raises SnergError on bad input, Cancelled when `progress` does; then `out` is as it was.
    """
    check_out(out, "scene", field)
    source = read_field(field)
    volume = Box.read(box) if box is not None else source.domain.world_box()
    dataset = _images_to_refine_on(source) if refine else None
    snerg, seconds = bake_field(source, volume, resolution, samples, dataset, progress)
    write_scene(snerg, out, within(progress, 0.97, 1.0))
    about = snerg.about
    result = {"seconds": seconds, "refined": "psnr_after" in about.get("refine", {}), **info(out)}
    return result | ({"warning": about["bake"]["warning"]} if "warning" in about.get("bake", {}) else {})


def bake_field(
    field: Field, box: Box, resolution: int, samples: int, dataset: Dataset | None, progress: Progress = silent
) -> tuple[Snerg, dict[str, float]]:
    """Bake, and refine where there is a dataset; returns the scene and the seconds that each took (JAX)."""
    with needs_jax():
        from .grid.bake import BakeSettings, bake
        from .grid.refine import RefineSettings, refine
    began = time.perf_counter()
    share = 0.97 if dataset is None else 0.7
    snerg = bake(field, box, field.cameras, BakeSettings(resolution=resolution, samples=samples), within(progress, 0, share))
    seconds = {"bake": time.perf_counter() - began}
    if dataset is not None:
        began = time.perf_counter()
        snerg, _ = refine(snerg, dataset, RefineSettings(), within(progress, share, 0.97))
        seconds["refine"] = time.perf_counter() - began
    return snerg, {name: round(value, 2) for name, value in seconds.items()}


def _images_to_refine_on(field: Field) -> Dataset | None:
    """The images that the field was trained on, or None where there is nothing to refine or it was imported."""
    if field.network is None or not field.dataset:
        return None
    if not Path(field.dataset).exists():
        raise SnergError(
            f"The dataset that the field was trained on is no longer at {field.dataset}; put it back, or bake with --no-refine."
        )
    return read_dataset(Path(field.dataset), "train")


def evaluate(target: Path, dataset: Path, split: str = "test", progress: Progress = silent) -> Result:
    """Quality of a field or a scene on a dataset's split, over white: PSNR of the mean error, mean SSIM, seconds a view.

    PSNR is None when every pixel agrees. Raises SnergError when `target` is neither, or the dataset is unusable.
    """
    views = read_dataset(dataset, split)
    kind, render = renderer_of(target)
    score = Score()
    count = len(views.views)
    for index, camera in enumerate(views.cameras):
        began = time.perf_counter()
        frame = render(camera, within(progress, index / count, (index + 1) / count))
        score.add(frame.over(WHITE), over_white(views.read(index)), time.perf_counter() - began)
        progress((index + 1) / count, f"View {index + 1} of {count}: {score.text()}")
    return {"kind": kind, "target": str(target), "dataset": str(dataset), "split": split, **score.result()}


class Score:
    """Errors of the views seen so far."""

    def __init__(self) -> None:
        self.errors: list[float] = []
        self.likeness: list[float] = []
        self.seconds: list[float] = []

    def add(self, picture: np.ndarray, truth: np.ndarray, seconds: float = 0.0) -> None:
        """A view [H, W, 3] and what it should be."""
        self.errors.append(mse(picture, truth))
        self.likeness.append(ssim(picture, truth))
        self.seconds.append(seconds)

    def result(self) -> Result:
        """{"psnr", "ssim", "seconds_per_view", "views"}; psnr is None where it is infinite (hard case 30)."""
        decibels = mean_psnr(self.errors)
        return {
            "psnr": round(decibels, 4) if math.isfinite(decibels) else None,
            "ssim": round(float(np.mean(self.likeness)), 5),
            "seconds_per_view": round(float(np.mean(self.seconds)), 4),
            "views": len(self.errors),
        }

    def text(self) -> str:
        """For a progress line."""
        decibels = mean_psnr(self.errors)
        return f"{decibels:.2f} dB" if math.isfinite(decibels) else "identical"


def renderer_of(target: Path) -> tuple[str, Callable[[Camera, Progress], Frame]]:
    """("field" or "scene", a function from a camera to its picture). Raises SnergError when `target` is neither."""
    kind = kind_of(target)
    if kind in ("field", "checkpoint"):
        with needs_jax():
            import jax  # noqa: F401  # evaluating a field compiles it

            from .field.render import render_field
        field = read_field(target) if kind == "field" else field_of(read_reference_checkpoint(target), str(target))
        return "field", lambda camera, progress: render_field(field, camera, progress)
    if kind in ("scene", "reference scene", "page"):
        snerg = any_scene(target)
        tables_of(snerg)  # once a scene, not a view
        return "scene", lambda camera, progress: march(snerg, camera, MarchSettings(), progress)
    raise SnergError(f"{target} is a {kind}; give a field or a baked scene.")


def render_views(
    scene: Path,
    cameras: Path,
    out: Path,
    width: int | None = None,
    height: int | None = None,
    progress: Progress = silent,
) -> Result:
    """March a scene from each camera of a transforms file into PNGs with straight alpha, one a camera.

    width, height: pixels, in place of the cameras' own; with one of them the other keeps the shape. Raises SnergError on
    bad input, Cancelled when `progress` does; then `out` is as it was.
    """
    check_out(out, "pictures", scene, cameras)
    views = [resized(camera, width, height) for camera in read_cameras(cameras)]
    snerg = any_scene(scene)
    names = file_names([camera.name for camera in views])
    tables_of(snerg)
    began = time.perf_counter()
    with new_folder(out) as folder:
        for index, (camera, name) in enumerate(zip(views, names, strict=True)):
            part = within(progress, index / len(views), (index + 1) / len(views))
            frame = march(snerg, camera, MarchSettings(), part)
            (folder / f"{name}.png").write_bytes(png_bytes(to_uint8(frame.straight())))
            part(1.0, f"View {index + 1} of {len(views)}")
    seconds = time.perf_counter() - began
    return {
        "out": str(out),
        "views": len(views),
        "files": [f"{name}.png" for name in names],
        "seconds_per_view": round(seconds / len(views), 4),
    }


def resized(camera: Camera, width: int | None, height: int | None) -> Camera:
    """The camera at another size in pixels; one side alone keeps the shape."""
    if width is None and height is None:
        return camera
    if height is None:
        height = max(1, round(camera.height * (width or 1) / camera.width))
    if width is None:
        width = max(1, round(camera.width * height / camera.height))
    return camera.resized(width, height)


def file_names(names: Sequence[str]) -> list[str]:
    """A plain file name a camera, numbered where they would collide."""
    plain = [re.sub(r"[^\w.-]+", "_", name).strip("._") for name in names]
    if all(plain) and len({name.lower() for name in plain}) == len(plain):
        return plain
    return [f"{index:03d}_{name}".rstrip("_") for index, name in enumerate(plain)]


def export_reference(scene: Path, out: Path, progress: Progress = silent) -> Result:
    """Write a scene in the reference PNG layout, which the published viewer opens."""
    check_out(out, "reference scene", scene)
    write_reference(any_scene(scene), out, None, progress)
    return {"out": str(out), **info(out)}


def bundle_scene(scene: Path, out: Path, cameras: Path | None = None, single_file: bool = False, progress: Progress = silent) -> Result:
    """Write a web page that shows a scene: a folder for any static server, or one .html when `single_file`.

    cameras: a transforms file whose cameras the page lists.
    """
    check_out(out, "page", scene, *([cameras] if cameras else []))
    viewer_files()
    views = read_cameras(cameras) if cameras else ()
    written = write_bundle(any_scene(scene), views, out, single_file=single_file, progress=progress)
    return {"out": str(out), "page": str(out / "index.html"), "cameras": len(views), **written}


def info(path: Path, progress: Progress = silent) -> Result:
    """What a dataset, field, checkpoint or scene is: its sizes, blocks, megabytes and the effects that it carries.

    Raises SnergError when it is none of these.
    """
    kind = kind_of(path)
    about = {
        "dataset": _dataset_info,
        "field": lambda p: _field_info(read_field(p)),
        "checkpoint": lambda p: _field_info(field_of(read_reference_checkpoint(p), str(p))),
        "scene": lambda p: _scene_info(read_scene(p)),
        "reference scene": _reference_info,
        "page": _page_info,
    }[kind](path)
    return {"kind": kind, "path": str(path), **about, "megabytes": round(folder_bytes(path) / 1e6, 3)}


def kind_of(path: Path) -> str:
    """'scene', 'field', 'reference scene', 'page', 'dataset' or 'checkpoint'. Raises SnergError when it is none of these."""
    if not path.exists():
        raise SnergError(f"{path} does not exist; check the path.")
    if path.is_dir() and is_scene(path):
        return "scene"
    if (path.is_dir() and is_field(path)) or path.suffix == ".npz":
        return "field"
    if path.is_dir() and is_reference(path):
        return "reference scene"
    if (path / "index.html").is_file() and (path / MARK).is_file():
        return "page"
    if path.suffix == ".json" or (path.is_dir() and any(path.glob("transforms*.json"))):
        return "dataset"
    if find_checkpoint(path) is not None:
        return "checkpoint"
    raise SnergError(f"{path} is no dataset, field, checkpoint or baked scene.")


def any_scene(path: Path) -> Snerg:
    """A baked scene of ours, in a folder or in a web page's, or one in the reference layout."""
    kind = kind_of(path)
    if kind == "page" and is_scene(path / "scene"):
        return read_scene(path / "scene")
    if kind == "scene":
        return read_scene(path)
    if kind == "reference scene":
        return read_reference(path)
    raise SnergError(f"{path} is a {kind}, not a baked scene; bake or import one first.")


def _dataset_info(path: Path) -> Result:
    splits = [p.stem.removeprefix("transforms_") for p in sorted(path.glob("transforms_*.json"))] if path.is_dir() else []
    opened = [read_dataset(path, split) for split in splits or ["train"]]
    first = opened[0]
    sizes = sorted({(c.width, c.height) for d in opened for c in d.cameras})
    return {
        "splits": {d.split: len(d.views) for d in opened},
        "views": sum(len(d.views) for d in opened),
        "sizes": [list(size) for size in sizes],
        "alpha": first.read(0).shape[-1] == 4,
        "box": first.box.to_json() if first.box else None,
    }


def _field_info(field: Field) -> Result:
    box = field.domain.world_box()
    return {
        "family": type(field.family).__name__,
        "views": len(field.cameras),
        "dataset": field.dataset,
        "steps": field.about.get("steps"),
        "seconds": field.about.get("seconds"),
        "box": box.to_json(),
        "effects": {"view_dependence": field.network is not None},
    }


def _scene_info(snerg: Snerg) -> Result:
    return {
        "voxels": list(snerg.shape),
        "voxel_size": float(snerg.voxel_size),
        "blocks": len(snerg.cells),
        "blocks_in_grid": int(snerg.indirection.size),
        "memory_megabytes": round(snerg.cells.nbytes / 1e6, 3),
        "box": snerg.box.to_json(),
        "effects": snerg.effects,
        "about": snerg.about,
    }


def _reference_info(path: Path) -> Result:
    params = read_params(path)
    return {"atlas_cells": list(params.atlas), **_scene_info(read_reference(path))}


def _page_info(path: Path) -> Result:
    if not is_scene(path / "scene"):
        return {"single_file": True}
    cameras = read_json(path / "cameras.json")["cameras"]
    return {"single_file": False, "cameras": [camera["name"] for camera in cameras], **_scene_info(read_scene(path / "scene"))}


def folder_bytes(path: Path) -> int:
    """Bytes of a file, or of all files in a folder."""
    return path.stat().st_size if path.is_file() else sum(p.stat().st_size for p in path.rglob("*") if p.is_file())


def check_out(out: Path, kind: str, *sources: Path) -> None:
    """Raise SnergError when results of a kind could not go to `out`, or would replace what took long to make."""
    there = out.resolve()
    for source in sources:
        other = source.resolve()
        if there == other or there in other.parents:
            raise SnergError(f"Writing to {out} would replace {source}, which it is made from; choose another folder.")
    check_replaceable(out.absolute())
    if out.is_dir() and any(out.iterdir()):
        for old, found in (("dataset", any(out.glob("transforms*.json"))), ("field", is_field(out))):
            if found and old != kind:
                raise SnergError(f"The folder {out} holds a {old}; choose another, so that it is not replaced.")


@contextmanager
def needs_jax() -> Iterator[None]:
    """Turn a missing JAX into a sentence."""
    try:
        yield
    except ImportError as error:
        if "jax" not in str(error):
            raise
        raise SnergError("Training and baking need JAX, which is not installed in this Python: run 'pip install jax'.") from error
