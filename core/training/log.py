"""The log of a training, one JSON object a line, from which learning curves are drawn, also while it runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ..errors import SnergError
from ..io.files import MARK, cannot_write, write_bytes
from ..io.guard import check_file, reading
from ..io.schema import number, whole

FILE = "log.jsonl"
MAX_STEP = 2**53
NUMBERS = {"seconds", "fraction", "loss", "psnr", "held_out_psnr", "rate", "samples", "rays"}
MAX_BYTES = 2**26


class Log:
    """Appends lines to FOLDER/log.jsonl. step: the step at which the training begins or is resumed; later lines, which a killed training
    logged after its last save, are removed first.

    Raises SnergError when the folder cannot be written.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self.path = folder / FILE
        kept = [line for line in read_log(folder) if line["step"] <= step] if step else []
        write_bytes(folder / MARK, b"Written by SNeRG for Blender.\n")  # first: an unmarked folder is not ours to go on in
        write_bytes(self.path, b"".join(_line(values) for values in kept))

    def add(self, **values: Any) -> None:
        """Add a line, whole unless the machine stops in the middle of it; needs a whole number `step`."""
        try:
            with open(self.path, "ab") as file:
                file.write(_line(values))
        except OSError as error:
            raise cannot_write(self.path, error) from error


def _line(values: dict[str, Any]) -> bytes:
    try:
        return (json.dumps(values, allow_nan=False) + "\n").encode()
    except ValueError as error:
        raise SnergError(f"The training log would hold a value that is not finite ({error}); nothing was written.") from error


def read_log(folder: Path) -> list[dict[str, Any]]:
    """The lines of a training's log in order; [] when there is no log. An incomplete line, left by a crash or still being written, is
    omitted.

    Lines about training have step, seconds, fraction, loss, psnr (dB, of training rays), rate, samples and rays; lines about held-out
    views have step, seconds and held_out_psnr (dB, mean of the views). Raises SnergError when the file cannot be read.
    """
    path = folder / FILE
    with reading(path, "delete it"):
        if not path.exists():
            return []
        check_file(path, MAX_BYTES)
        data = path.read_bytes()
    lines = []
    for text in data.split(b"\n")[:-1]:
        try:
            value = json.loads(text)
            whole(value["step"], "step", 0, MAX_STEP)
            for name in NUMBERS & value.keys():
                number(value[name], name)
        except (ValueError, RecursionError, TypeError, KeyError, AttributeError):
            continue
        if isinstance(value, dict):
            lines.append(value)
    return lines
