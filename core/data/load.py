"""Reads a dataset: finds the reader of its format, orients its world, and selects a split."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.guard import reading
from .dataset import HELD_OUT, Dataset, DatasetOptions, Source, View
from .orient import orient
from .readers import colmap, llff, transforms
from .readers.others import check_supported
from .training_box import training_box

DEFAULT_OPTIONS = DatasetOptions()


def read_dataset(path: str | os.PathLike[str], split: str = "train", options: DatasetOptions = DEFAULT_OPTIONS) -> Dataset:
    """One split of a capture: a transforms file or its folder, an LLFF folder (poses_bounds.npy), or a COLMAP model with its images.

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
    """Read the dataset at `path` with the reader of its format: transforms, LLFF or COLMAP, tried in this order.

    The result is in the source's own world, not oriented. Raises SnergError when no reader recognises it, or as the reader does.
    """
    if not path.exists():
        raise SnergError(f"The dataset {path} does not exist; check the path.")
    if transforms.is_transforms(path):
        return transforms.read_transforms(path, split, options)
    if llff.is_llff(path):
        return llff.read_llff(path, options)
    if colmap.is_colmap(path):
        return colmap.read_colmap(path, options)
    check_supported(path)
    raise SnergError(
        f"{path} is no dataset: it has no transforms.json, no transforms_train.json, no poses_bounds.npy and no COLMAP model in sparse/0."
    )


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
        )
    return splits[split], tuple(sorted(names, key=lambda n: n != "train"))
