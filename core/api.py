"""The stages as functions on objects: what `import snerg` offers (docs/scripting.md). Each imports what it needs when it is called."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from .baking.bake import BakeSettings
from .baking.bake_field import bake_field
from .baking.finish import Finishing
from .commands.bake import check_settings, training_images
from .commands.check_out import check_out
from .commands.train import train_field
from .data.dataset import Dataset
from .errors import SnergError, needs_jax
from .export.bundle import write_bundle
from .export.codecs import CodecSettings
from .export.reference import write_reference
from .export.scene_files import check_storable, write_scene
from .geometry.box import Box
from .geometry.camera import Camera
from .geometry.camera_path import CameraPath
from .io.lock import one_writer
from .nerf.checkpoint import read_field
from .nerf.field import Field
from .nerf.frame import Frame
from .progress import Progress, silent, within
from .rendering.render import MarchSettings, render_scene
from .scene.scene import Scene
from .study.evaluate import measure_into, target_of

Place = str | os.PathLike[str]


def train(
    dataset: Dataset,
    out: Place,
    preset: str = "fast",
    *,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    settings: Mapping[str, Any] | None = None,
    progress: Progress = silent,
) -> Field:
    """Train a field on a dataset's train split and keep it in the folder `out` (JAX); a training that was stopped there goes on.

    preset: "fast", "mlp" or "paper" (docs/settings.md). minutes or steps: how long; the preset's own time when neither is given.
    settings: other settings by name, such as {"rate": 0.01}. progress: called with (fraction, text), may raise Cancelled. Raises
    SnergError on bad input, and when the loss stays non-finite.
    """
    values = {name: str(value) for name, value in (settings or {}).items()}
    train_field(dataset.root, Path(out), preset, minutes, steps, seed, dataset.options, values, progress)
    return read_field(Path(out))


def bake(
    field: Field,
    out: Place | None = None,
    *,
    box: Box | None = None,
    resolution: int | None = None,
    settings: BakeSettings | None = None,
    refine: bool = True,
    fit: bool = False,
    prune: float = 0.0,
    codec: str = "png",
    quality: int | None = None,
    progress: Progress = silent,
) -> Scene:
    """Bake a field inside a box into a scene (section 5 of the paper; JAX), and write it to the folder `out` if one is given.

    box: all that the field holds when None. resolution: voxels along the longest side, in place of that of `settings`. refine:
    fine-tune the view-dependence network on the training images. fit: fit the voxels to them, which takes longer. prune: drop voxels
    whose share of every training pixel is smaller, 0 to 1. codec, quality: of the pictures in `out`, see `export_scene`.
    Raises SnergError on bad input, and for settings that change nothing in this field; Cancelled when `progress` does.
    """
    chosen = settings or BakeSettings()
    chosen = chosen if resolution is None else replace(chosen, resolution=resolution)
    check_settings(chosen, field)
    stored = _codec(codec, quality)
    check_storable(chosen.quantise, stored)
    if out is not None:
        check_out(Path(out), "scene")
    finishing = Finishing(refine and chosen.network, fit, prune)
    dataset = training_images(field, finishing)
    scene, _ = bake_field(field, box or field.domain.world_box(), chosen, dataset, within(progress, 0, 0.97), finishing=finishing)
    if out is not None:
        export_scene(scene, out, codec=codec, quality=quality, progress=within(progress, 0.97, 1))
    return scene


def render(source: Scene | Field, camera: Camera, *, settings: MarchSettings | None = None, progress: Progress = silent) -> Frame:
    """Render a scene (NumPy alone, section 5.2) or a field (JAX) from a camera: colour, alpha and depth, float32.

    settings: of a scene's march. Raises SnergError when they are given for a field, Cancelled when `progress` does.
    """
    if isinstance(source, Scene):
        return render_scene(source, camera, settings or MarchSettings(), progress)
    if settings is not None:
        raise SnergError("These settings are for baked scenes; bake the field first, or leave them out.")
    with needs_jax():
        from .nerf.render import render_field
    return render_field(source, camera, progress)


def evaluate(source: Scene | Field, views: Dataset, *, out: Place | None = None, progress: Progress = silent) -> dict[str, Any]:
    """Measure a scene or a field on views, best those that training did not see: `read_dataset(path, "test")`.

    Returns {"psnr": mean of the views' dB; "psnr_pooled": dB of their mean squared error; "ssim": mean; "seconds_per_view"; "views"}; the
    PSNRs are None where nothing differs. out: a folder for each picture and a sheet of them beside the truth.
    Raises SnergError when the images cannot be read.
    """
    return measure_into(target_of(source), views, None if out is None else Path(out), progress)


def export_scene(
    scene: Scene,
    out: Place,
    *,
    published: bool = False,
    codec: str = "png",
    quality: int | None = None,
    progress: Progress = silent,
) -> Path:
    """Write a scene's atlas, indirection grid and network to a folder, whole or not at all, and return that.

    published: in the PNG layout of the published viewer, in place of ours. codec: "png", "webp" or "jxl" (lossless), "jpeg", "avif" or
    "h264", with a quality of 1 to 100. Raises SnergError when the folder cannot be written or holds other files.
    """
    folder = Path(out)
    if published and (codec, quality) != ("png", None):
        raise SnergError("The published layout has PNGs alone; leave out the codec.")
    check_out(folder, "reference scene" if published else "scene")
    with one_writer(folder, "an export"):
        if published:
            write_reference(scene, folder, None, progress)
        else:
            write_scene(scene, folder, progress, _codec(codec, quality))
    return folder


def export_web(
    scene: Scene,
    out: Place,
    cameras: Sequence[Camera] = (),
    *,
    single_file: bool = False,
    codec: str = "png",
    quality: int | None = None,
    path: CameraPath | None = None,
    progress: Progress = silent,
) -> Path:
    """Write a scene as a web page that any browser opens, and return its index.html.

    cameras: what the page lists to jump to; it opens at the first. single_file: one .html that opens from the disk, in place of a
    folder for a web server. path: that the page can play.
    Raises SnergError when the folder cannot be written or browsers could not show the scene.
    """
    folder = Path(out)
    check_out(folder, "page")
    with one_writer(folder, "an export"):
        write_bundle(scene, tuple(cameras), folder, single_file=single_file, progress=progress, codec=_codec(codec, quality), path=path)
    return folder / "index.html"


def _codec(name: str, quality: int | None) -> CodecSettings:
    return CodecSettings(name) if quality is None else CodecSettings(name, quality)
