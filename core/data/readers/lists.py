"""Lists of a capture's pictures by split, which nerfstudio and Gaussian splatting read beside a COLMAP model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...errors import SnergError
from ...io.guard import check_file, reading
from ..image_resolver import plain

LISTS = {"train": "train_list.txt", "val": "validation_list.txt", "test": "test_list.txt"}  # nerfstudio's, in the dataset's folder
TEST = "test.txt"  # Gaussian splatting's, beside the model
MAX_BYTES = 2**26  # of a list


def listed(root: Path, model: Path, names: Sequence[str], left_out: Sequence[str]) -> dict[str, list[int]] | None:
    """The splits that files beside a model list, as numbers of its images `names`; None without such files.

    left_out: names of its other images. Where only held-out images are listed, the others are 'train'.
    Raises SnergError when a file names an image that is not there.
    """
    files = {split: root / name for split, name in LISTS.items() if (root / name).is_file()}
    if not files and (model / TEST).is_file():
        files = {"test": model / TEST}
    splits = {split: _numbers(file, names, left_out) for split, file in files.items()}
    splits = {split: numbers for split, numbers in splits.items() if numbers}
    if splits and "train" not in splits:
        held = {index for numbers in splits.values() for index in numbers}
        splits = {"train": [i for i in range(len(names)) if i not in held], **splits}
    return splits or None


def _numbers(file: Path, names: Sequence[str], left_out: Sequence[str]) -> list[int]:
    numbers: dict[str, int | None] = {**dict.fromkeys(map(plain, left_out)), **{plain(name): index for index, name in enumerate(names)}}
    check_file(file, MAX_BYTES)
    with reading(file, "write it again"):
        wanted = [line.strip() for line in file.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    unknown = [name for name in wanted if plain(name) not in numbers]
    if unknown:
        raise SnergError(f"{file} names {unknown[0]} and {len(unknown) - 1} more that are no images of the dataset; take them out.")
    return [number for name in wanted if (number := numbers[plain(name)]) is not None]
