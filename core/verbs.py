"""The verbs: what the command line and Blender's operators do, one function each.

Every function takes paths and keyword settings and `progress(fraction, message)`, and returns what it did as JSON
values. What would be in the way is found before hours of work, not after.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from .capture.camera import Camera
from .capture.dataset import Dataset, DatasetOptions, read_dataset
from .capture.images import png_bytes, to_uint8
from .capture.readers.transforms import read_cameras
from .describe import Result, any_field, any_scene, folder_bytes, info, kind_of
from .errors import SnergError, needs_jax
from .evaluate import background_of, evaluate, options_of, ready_scene, trained
from .export.bundle import viewer_files, write_bundle
from .export.codecs import CodecSettings
from .export.reference import reference_files, write_reference
from .export.scene import PNG, check_storable, codec_of, is_current, is_scene, scene_files, write_scene
from .field.checkpoint import is_field, read_field, write_field
from .field.setting_names import with_values
from .field.settings import PRESETS, TrainSettings, suited_to_time
from .field.training_folder import FINISHED, NEW, UNFINISHED, finish, training_folder
from .files import check_replaceable, discard, new_folder, one_generation
from .grid.bake import BakeSettings, check_lengths
from .grid.box import Box
from .grid.march import MarchSettings, march
from .grid.snerg import Snerg
from .lock import one_writer, writes_out
from .progress import Note, Progress, silent, within

if TYPE_CHECKING:
    from .field.field import Field

__all__ = ["bake_scene", "bundle_scene", "evaluate", "export_reference", "import_source", "info", "render_views", "train_field"]
EIGHTH, BAKE, MARCH = DatasetOptions(), BakeSettings(), MarchSettings()


def train_field(
    dataset: Path,
    out: Path,
    preset: str = "fast",
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    options: DatasetOptions = EIGHTH,
    values: Mapping[str, str] | None = None,
    progress: Progress = silent,
) -> Result:
    """Train a field on a dataset's train split (JAX); an unfinished training with the same settings goes on where it stopped.

    minutes or steps: how long; the preset's own time when neither is given. options: how to read the dataset. values:
    settings by name, in place of the preset's (see with_values). Another field at `out` stays there until this training is
    finished, and takes place beside it until then (see training_folder). Raises SnergError on bad input or when the training
    goes wrong, Cancelled when `progress` does; then the field as far as it got is kept, to go on with.
    """
    check_out(out, "field", dataset)
    settings = settings_of(preset, minutes, steps, seed, values or {})
    with needs_jax():
        from .field.train import train, writes
    with one_writer(out, "a training") if writes() else nullcontext():
        views = read_dataset(dataset, "train", options)
        folder, state = training_folder(out, settings, views)
        if folder != out and state != FINISHED:
            progress(0.0, Note(f"{out} holds another field, which stays as it is until this training is finished."))
        field = read_field(folder) if state == FINISHED else train(views, settings, folder, progress, resume=state == UNFINISHED)
        if folder != out and writes():
            finish(folder, out)
        return _trained(out, field, len(views.views), resumed=state != NEW)


def _trained(out: Path, field: Field, views: int, resumed: bool) -> Result:
    """What there is to say of a training."""
    about = field.about
    return {
        "field": str(out),
        "views": views,
        "resumed": resumed,
        "steps": about.get("steps"),
        "seconds": about.get("seconds"),
        "psnr": about.get("psnr_training_rays"),
        "psnr_held_out": about.get("psnr_held_out_rays"),
        "view_dependence": field.view,
        "ndc": field.ndc is not None,
        "decisions": about.get("decisions", []),
        "bytes": one_generation(out, lambda: folder_bytes(out)),
    }


def settings_of(preset: str, minutes: float | None, steps: int | None, seed: int, values: Mapping[str, str]) -> TrainSettings:
    """A preset with some settings changed. Raises SnergError on a name or a value that there is not."""
    if preset not in PRESETS:
        raise SnergError(f"There is no preset {preset!r}; choose one of {', '.join(PRESETS)}.")
    settings = replace(PRESETS[preset], seed=seed)
    if steps is not None:
        settings = replace(settings, steps=steps, seconds=None)
    elif minutes is not None:
        settings = replace(settings, steps=None, seconds=60 * minutes)
    return with_values(suited_to_time(settings), values)


@writes_out("an import")
def import_source(source: Path, out: Path, progress: Progress = silent) -> Result:
    """Bring in a field (ours, or a reference checkpoint) or a baked scene (ours, or in the reference layout).

    Raises SnergError when `source` is neither, or damaged.
    """
    kind = kind_of(source)
    check_out(out, {"reference scene": "scene", "page": "scene", "checkpoint": "field"}.get(kind, kind), source)
    if kind in ("scene", "page", "reference scene"):
        write_scene(any_scene(source, within(progress, 0, 0.5)), out, within(progress, 0.5, 1))
    elif kind in ("field", "checkpoint"):
        field = any_field(source)
        with new_folder(out) as folder:  # so that the log of a training that was there before goes with its field
            write_field(field, folder)
    else:
        raise SnergError(f"{source} is a {kind}, which needs no import; give a field, a checkpoint or a baked scene.")
    progress(1.0, "Imported")
    return {"imported": kind, "to": str(out), **info(out)}


@writes_out("a bake")
def bake_scene(
    field: Path,
    out: Path,
    settings: BakeSettings = BAKE,
    box: Path | None = None,
    refine: bool = True,
    progress: Progress = silent,
    codec: CodecSettings = PNG,
) -> Result:
    """Bake a field inside a box into a scene (JAX), then refine its view-dependence network on the training images.

    box: a JSON file (see Box.from_json); all that the field holds when None. Raises SnergError on bad input, and for settings
    that change nothing in this field; Cancelled when `progress` does. Then `out` is as it was, and what is finished lies in a
    folder beside it (.NAME.bake), from which the same bake goes on when it is started again.
    """
    check_out(out, "scene", field)
    check_storable(settings.quantise, codec)
    source = read_field(field)
    _check_settings(settings, source)
    volume = Box.read(box) if box is not None else source.domain.world_box()
    dataset = _images_to_refine_on(source) if refine and settings.network else None
    unfinished = out.absolute().with_name(f".{out.absolute().name}.bake")
    snerg, seconds = bake_field(source, volume, settings, dataset, progress, unfinished)
    write_scene(snerg, out, within(progress, 0.97, 1.0), codec)
    discard(unfinished)
    about = snerg.about
    result = {"seconds": seconds, "refined": "psnr_after" in about.get("refine", {}), **info(out)}
    return result | ({"warning": about["bake"]["warning"]} if "warning" in about.get("bake", {}) else {})


def _check_settings(settings: BakeSettings, field: Field) -> None:
    check_lengths(settings, field)
    if not settings.network and field.network is None:
        raise SnergError("The field is diffuse: it has no network to leave out; bake it without --no-network.")
    if not settings.visibility and not field.cameras:
        raise SnergError("The field knows no cameras, so that all of it is kept in any case; bake it without --no-visibility.")


def bake_field(
    field: Field,
    box: Box,
    settings: BakeSettings,
    dataset: Dataset | None,
    progress: Progress = silent,
    resume: Path | None = None,
) -> tuple[Snerg, dict[str, float]]:
    """Bake, and refine where there is a dataset; returns the scene and the seconds that each took (JAX).

    resume: see grid.bake.bake.
    """
    with needs_jax():
        from .grid.bake import bake
        from .grid.refine import RefineSettings, refine
    began = time.perf_counter()
    share = 0.97 if dataset is None else 0.7
    snerg = bake(field, box, field.cameras, settings, within(progress, 0, share), resume)
    known = trained(field.about)
    decided = {"decisions": field.about.get("decisions", [])}
    snerg = replace(snerg, about={**snerg.about, "trained": known | decided})
    seconds = {"bake": time.perf_counter() - began}
    if dataset is not None:
        began = time.perf_counter()
        snerg, _ = refine(snerg, dataset, RefineSettings(background=background_of(known)), within(progress, share, 0.97))
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
    return read_dataset(Path(field.dataset), "train", options_of(trained(field.about)))


@writes_out("a rendering")
def render_views(
    scene: Path,
    cameras: Path,
    out: Path,
    width: int | None = None,
    height: int | None = None,
    progress: Progress = silent,
    settings: MarchSettings = MARCH,
) -> Result:
    """March a scene from each camera of a transforms file into PNGs with straight alpha, one a camera.

    width, height: pixels, in place of the cameras' own; with one of them the other keeps the shape. Raises SnergError on
    bad input, Cancelled when `progress` does; then `out` is as it was.
    """
    check_out(out, "pictures", scene, cameras)
    views = [resized(camera, width, height) for camera in read_cameras(cameras)]
    snerg = ready_scene(scene, settings)
    names = file_names([camera.name for camera in views])
    began = time.perf_counter()
    with new_folder(out) as folder:
        for index, (camera, name) in enumerate(zip(views, names, strict=True)):
            part = within(progress, index / len(views), (index + 1) / len(views))
            frame = march(snerg, camera, settings, part)
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


@writes_out("an export")
def export_reference(scene: Path, out: Path, progress: Progress = silent) -> Result:
    """Write a scene in the reference PNG layout, which the published viewer opens."""
    check_out(out, "reference scene", scene)
    write_reference(published(scene), out, None, progress)
    return {"out": str(out), **info(out)}


def published(scene: Path) -> Snerg:
    """A baked scene to publish. Raises SnergError where it takes a file from elsewhere, through a link."""

    def read() -> Snerg:
        for folder in (scene, scene / "scene"):  # a folder of ours, a web page's
            if is_scene(folder):
                scene_files(folder)
        if kind_of(scene) == "reference scene":
            reference_files(scene)
        return any_scene(scene)

    return one_generation(scene, read)


@writes_out("a bundle")
def bundle_scene(
    scene: Path,
    out: Path,
    cameras: Path | None = None,
    single_file: bool = False,
    progress: Progress = silent,
    codec: CodecSettings | None = None,
) -> Result:
    """Write a web page that shows a scene: a folder for any static server, or one .html when `single_file`.

    cameras: a transforms file whose cameras the page lists. codec: of the scene's pictures; the scene's own when None.
    """
    check_out(out, "page", scene, *([cameras] if cameras else []))
    viewer_files()
    views = read_cameras(cameras) if cameras else ()

    def opened() -> tuple[Snerg, CodecSettings | None]:
        stored = codec_of(scene) if kind_of(scene) == "scene" and is_current(scene) else None
        return published(scene), stored

    snerg, stored = one_generation(scene, opened)
    source = scene if stored is not None and codec in (None, stored) else None
    codec = codec or stored or PNG
    written = write_bundle(snerg, views, out, single_file=single_file, progress=progress, codec=codec, source=source)
    return {"out": str(out), "page": str(out / "index.html"), "cameras": len(views), "codec": codec.name, **written}


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
