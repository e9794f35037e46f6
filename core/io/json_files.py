"""JSON in files: what is read, also as people edit it, and the bytes to write."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from ..errors import SnergError
from .guard import check_file, reading, why

MAX_JSON_BYTES = 2**25  # about 30,000 cameras; parsed JSON takes up to thirty times its size in memory
COMMENT = re.compile(r'("(?:[^"\\]|\\.)*")|//[^\n]*|/\*.*?\*/', re.DOTALL)  # a string, which stays, or a comment


def read_json(path: Path) -> Any:
    """The value of a JSON file. Raises SnergError when it is missing, not a regular file, larger than MAX_JSON_BYTES, or not JSON."""
    check_file(path, MAX_JSON_BYTES)
    with reading(path, "write it again"):
        text = path.read_bytes()
        try:
            return json.loads(text.decode("utf-8"))
        except (ValueError, RecursionError) as error:
            raise SnergError(f"{path} is not valid JSON ({why(error)}); write it again.") from error


def read_edited_json(path: Path) -> Any:
    """As `read_json`, for files that people edit: with a byte order mark, in UTF-16, or with comments as in C (instant-ngp reads them)."""
    check_file(path, MAX_JSON_BYTES)
    with reading(path, "write it again"):
        data = path.read_bytes()
        try:
            encoding = "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
            text = data.decode(encoding)
            try:
                return json.loads(text)
            except ValueError:
                return json.loads(COMMENT.sub(lambda match: match[1] or " ", text))
        except (ValueError, RecursionError) as error:
            raise SnergError(f"{path} is not valid JSON ({why(error)}); write it again.") from error


def json_bytes(value: Any) -> bytes:
    """A value as JSON, UTF-8. Raises SnergError when it contains NaN or infinity, which JSON does not have (hard case 59)."""
    try:
        return (json.dumps(value, allow_nan=False, indent=1) + "\n").encode()
    except ValueError as error:
        raise SnergError(f"A value that would be written is not finite ({error}); nothing was written.") from error
