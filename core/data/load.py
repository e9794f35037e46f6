"""Reads a dataset: finds the reader of its format, orients its world, and selects a split."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import reading
from .dataset import HELD_OUT, Dataset, DatasetOptions, Source, View
from .masks import unused_masks
from .orient import orient
from .readers import bundler, colmap, llff, metashape, polycam, realitycapture, record3d, sdfstudio, splats, transforms
from .readers.others import check_supported
from .training_box import training_box

DEFAULT_OPTIONS = DatasetOptions()
Reader = tuple[Callable[[Path], bool], Callable[[Path, str, DatasetOptions], Source]]
READERS: tuple[Reader, ...] = (  # (whether it knows the format of a path, its reader), in the order in which they are tried
    (splats.is_splat_file, lambda path, _, options: splats.read_splats(path, options)),  # else it would pass for a transforms file
    (sdfstudio.is_sdfstudio, sdfstudio.read_sdfstudio),
    (transforms.is_transforms, transforms.read_transforms),
    (llff.is_llff, lambda path, _, options: llff.read_llff(path, options)),
    (colmap.is_colmap, lambda path, _, options: colmap.read_colmap(path, options)),
    (polycam.is_polycam, lambda path, _, options: polycam.read_polycam(path, options)),
    (record3d.is_record3d, lambda path, _, options: record3d.read_record3d(path, options)),
    (metashape.is_metashape, lambda path, _, options: metashape.read_metashape(path, options)),
    (realitycapture.is_realitycapture, lambda path, _, options: realitycapture.read_realitycapture(path, options)),
    (bundler.is_bundler, lambda path, _, options: bundler.read_bundler(path, options)),
    (splats.is_splats, lambda path, _, options: splats.read_splats(path, options)),  # last: a result may lie in its capture's folder
)


def read_dataset(path: str | os.PathLike[str], split: str = "train", options: DatasetOptions = DEFAULT_OPTIONS) -> Dataset:
    """One split of a capture: a transforms file or its folder, an LLFF folder (poses_bounds.npy), a COLMAP model with its images, or what
    Polycam, Record3D, Metashape, RealityCapture or Gaussian splatting export (see docs/captures.md).

    Reads the header of each image, not its pixels. Raises SnergError when there is no such dataset or split, or an image, pose or lens
    is missing or invalid.
    """
    with reading(Path(path), "write it again", f"The dataset {path}"):
        return _read_dataset(Path(path), split, options)


def read_split(dataset: Dataset, split: str) -> Dataset:
    """Another split of the capture that `dataset` is a split of. Nothing that was read for `dataset` is read again.

    Raises SnergError as `read_dataset` does.
    """
    source = dataset.source
    if source is None or (source.splits is not None and split not in source.splits):
        return read_dataset(dataset.root, split, dataset.options)  # it has a file of its own, or there is no such split
    return _dataset(source, split, dataset.options, dataset.source_to_world)


def _read_dataset(path: Path, split: str, options: DatasetOptions) -> Dataset:
    source = read_source(path, split, options)
    if len(source.names) < 2 and (said := unused_masks(source.root, source.views)):  # else they may be of other splits
        source = replace(source, notes=(*source.notes, said))
    _split(source, split, options)  # before it is oriented, which needs several views
    source, similarity = orient(source) if source.photographs else (source, np.eye(4))
    found = training_box(source, pictures=split == "train")
    source = replace(source, box=found.box, box_origin=found.origin, opaque_box=found.opaque)
    return _dataset(source, split, options, similarity)


def _dataset(source: Source, split: str, options: DatasetOptions, similarity: NDArray[Any]) -> Dataset:
    """One split of an oriented source; similarity: [4, 4], from the source's original world to the oriented one."""
    chosen, names = _split(source, split, options)
    return Dataset(
        root=source.root,
        split=split,
        views=tuple(_reduced(source.views[i], source.factor) for i in chosen),
        box=source.box,
        box_origin=source.box_origin,
        opaque_box=source.opaque_box,
        points=source.points,
        colours=source.colours,
        bounds=source.bounds[chosen] if source.bounds is not None else None,
        source_to_world=similarity,
        options=options,
        kind=source.kind,
        split_names=names,
        skipped_frames=source.skipped_frames,
        notes=source.notes,
        source=source,
    )


def _reduced(view: View, factor: int) -> View:
    """A view whose camera has its image's size, changed to the size reduced by `factor` at which the image is trained on."""
    camera = view.camera
    return replace(view, camera=camera.reduced(factor), factor=factor, image_size=(camera.width, camera.height))


def read_source(path: Path, split: str, options: DatasetOptions) -> Source:
    """Read the dataset at `path` with the first of READERS that knows its format.

    The result is in the source's own world, not oriented. Raises SnergError when no reader recognises it, or as the reader does.
    """
    if not path.exists():
        raise SnergError(f"The dataset {path} does not exist; check the path.")
    for recognises, read in READERS:
        if recognises(path):
            return read(path, split, options)
    check_supported(path)
    raise SnergError(
        f"{path} is no dataset: it has no transforms.json, no transforms_train.json, no poses_bounds.npy, no COLMAP model in sparse/0, "
        "and no cameras of Polycam, Record3D, Metashape, RealityCapture or Bundler."
    )


def is_capture(path: Path) -> bool:
    """Whether one of READERS knows the format of a capture at `path`. Raises OSError when a folder or file may not be read."""
    return any(recognises(path) for recognises, _ in READERS)


def _split(source: Source, split: str, options: DatasetOptions) -> tuple[list[int], tuple[str, ...]]:
    """The indices of a split's views, and the names of all splits. Raises SnergError that lists the splits, or for too few views."""
    everything = range(len(source.views))
    if source.splits is not None:
        splits, names = source.splits, source.names or tuple(source.splits)
    elif options.holdout and len(source.views) > 2:
        held = [i for i in everything if i % options.holdout == 0]
        kept = [i for i in everything if i % options.holdout]
        splits, names = {"train": kept, **dict.fromkeys(HELD_OUT, held)}, ("train", "val")
    else:
        splits, names = {"train": list(everything)}, ("train",)
    if not splits.get(split):
        raise SnergError(f"The dataset {source.root} has no split {split!r}; it has the splits {', '.join(sorted(names))}.")
    if split == "train" and len(splits[split]) < 2:
        raise SnergError(
            f"The dataset {source.root} has {len(splits[split])} image to train on; a scene needs several, from different places."
            + "".join(f" {note}" for note in source.notes[-1:])
        )
    return splits[split], tuple(sorted(names, key=lambda n: n != "train"))
