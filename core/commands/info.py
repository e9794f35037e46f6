"""`snerg info`: describes the dataset, field, checkpoint or scene at a path."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..artifact import Result, artifact_at, kind_of, open_field
from ..data.coverage import coverage
from ..data.dataset import Dataset
from ..data.depth import PASSES
from ..data.load import read_dataset, read_split
from ..errors import SnergError
from ..export.reference import read_reference
from ..export.reference_params import read_params
from ..export.scene_files import codec_of, is_scene, read_scene
from ..geometry.camera import Camera
from ..io.files import folder_bytes
from ..io.generation import one_generation
from ..io.guard import reading
from ..io.json_files import read_json
from ..io.schema import record
from ..nerf.field import Field
from ..progress import Progress, silent
from ..scene.scene import Scene
from ..training.decisions import forward_facing
from ..training.devices import device_report
from ..training.training_folder import trainings_beside
from .command import Command
from .options import artifact


def info(path: Path, progress: Progress = silent) -> Result:
    """The kind of what lies at `path`, its size in megabytes, and what describes its kind: views and box of a dataset, settings and
    decisions of a field, voxels, blocks and effects of a scene.

    Raises SnergError when `path` is no dataset, field, checkpoint or scene.
    """
    place = artifact_at(path)
    return one_generation(place, lambda: _info(place))


def _info(path: Path) -> Result:
    kind = kind_of(path)
    about = {
        "dataset": _dataset_info,
        "field": lambda p: _field_info(open_field(p)) | _unfinished(p),
        "checkpoint": lambda p: _field_info(open_field(p)),
        "scene": _stored_info,
        "reference scene": _reference_info,
        "page": _page_info,
    }[kind](path)
    return {"kind": kind, "path": str(path), **about, "megabytes": round(folder_bytes(path) / 1e6, 3)}


def _dataset_info(path: Path) -> Result:
    train = read_dataset(path, "train")
    opened = [train, *(read_split(train, split) for split in train.splits() if split != "train")]
    cameras = [camera for part in opened for camera in part.cameras]
    transparent = has_alpha(train.read(0))
    decision, _ = forward_facing("auto", train.cameras, train.points, train.bounds, transparent)
    box = train.suggested_box()
    measured = coverage(box, train.cameras, train.points)
    lenses = sorted({camera.distortion.model for camera in cameras if camera.distortion})
    return {
        "source": train.kind,
        "splits": {part.split: len(part.views) for part in opened},
        "views": len(cameras),
        "sizes": [list(size) for size in sorted({(camera.width, camera.height) for camera in cameras})],
        "alpha": transparent,
        "masks": sum(view.mask is not None for part in opened for view in part.views),
        "depth": _depth_info(opened),
        "passes": {name: sum(name in v.passes for part in opened for v in part.views) for name in PASSES},
        "projections": sorted({camera.projection for camera in cameras}),
        "distortion": lenses,
        "points": 0 if train.points is None else len(train.points),
        "bounds": None if train.bounds is None else [float(train.bounds[:, 0].min()), float(train.bounds[:, 1].max())],
        "box": train.box.to_json() if train.box else None,
        "suggested_box": box.to_json(),
        "suggested_size": [round(float(side), 4) for side in box.size],
        "box_origin": train.box_origin,
        "box_rays": round(measured.rays, 4),
        "box_seen": round(measured.seen, 4),
        "box_points": None if measured.points is None else round(measured.points, 4),
        "forward_facing": decision.chosen,
        "evidence": decision.evidence,
        "without_image": train.skipped_frames,
        "notes": train.remarks(),
    }


def _depth_info(parts: list[Dataset]) -> Result | None:
    """How many views have a depth image, how many name one that is missing, and the depth in the first, in world units; None without."""
    named = [(part, index, view.depth) for part in parts for index, view in enumerate(part.views) if view.depth is not None]
    if not named:
        return None
    there = [(part, index) for part, index, file in named if file.path.is_file()]
    try:
        values, problem = there[0][0].depth(there[0][1]) if there else None, {}
    except SnergError as error:  # the dataset can be trained on without its depth
        values, problem = None, {"problem": str(error)}
    found = values[np.isfinite(values)] if values is not None else np.zeros(0)
    return {
        **problem,
        "views": len(there),
        "missing": len(named) - len(there),
        "stored": "along the ray" if named[0][2].along_ray else "along the axis",
        "unit": named[0][2].unit,
        "first_view": [round(float(found.min()), 4), round(float(found.max()), 4)] if found.size else None,
    }


def has_alpha(image: NDArray[Any]) -> bool:
    """Whether any pixel of an image [H, W, 3 or 4] uint8 is not opaque."""
    return image.shape[-1] == 4 and bool((image[..., 3] < 255).any())


def _field_info(field: Field) -> Result:
    box = field.domain.world_box()
    return {
        "family": type(field.family).__name__,
        "views": len(field.cameras),
        "dataset": field.dataset,
        "steps": field.about.get("steps"),
        "seconds": field.about.get("seconds"),
        "box": box.to_json(),
        "view_dependence": field.view,
        "ndc": field.ndc is not None,
        "decisions": field.about.get("decisions", []),
        "effects": {"view_dependence": field.view != "diffuse"},
    }


def _unfinished(path: Path) -> Result:
    """The unfinished trainings that will replace a field (see training_folder), if there are any."""
    found = trainings_beside(path)
    return {"unfinished_trainings": found} if found else {}


def _stored_info(path: Path) -> Result:
    snerg = read_scene(path)
    codec = codec_of(path)
    more = ("" if codec.lossless else f", quality {codec.quality}") + (", half features" if codec.half_features else "")
    return {"codec": codec.name + more if snerg.quantised else "float", **_scene_info(snerg)}


def _scene_info(snerg: Scene) -> Result:
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
    return {
        "single_file": False,
        "cameras": [camera.name for camera in page_cameras(path / "cameras.json")],
        **_stored_info(path / "scene"),
    }


def page_cameras(path: Path) -> tuple[Camera, ...]:
    """The cameras that a web page lists. Raises SnergError when the file is damaged."""
    value = read_json(path)
    with reading(path, "write the page again"):
        return tuple(Camera.from_json(camera) for camera in record(value, "the file")["cameras"])


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `snerg info`."""
    parser.add_argument("path", type=artifact, nargs="?", metavar="PATH")
    parser.add_argument("--devices", action="store_true", help="list the devices that training uses")


def run(options: argparse.Namespace, progress: Progress) -> Result:
    """Run `snerg info`. Raises SnergError without a path and without --devices."""
    if options.devices:
        return device_report()
    if options.path is None:
        raise SnergError("There is nothing to describe; give a path, or --devices.")
    return info(options.path, progress)


COMMAND = Command("info", "describe a dataset, field, checkpoint or scene, or the devices that training uses", add_options, run)
