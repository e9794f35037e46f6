"""A disk that fails at the k-th write, rename, flush or new folder, to put into any save."""

from __future__ import annotations

import builtins
import contextlib
import errno
import io
import os
from collections.abc import Callable, Iterator
from typing import Any
from unittest.mock import patch

from snerg.core.io import files

CALLS = ("replace", "rename", "fsync", "mkdir", "ftruncate", "write", "sendfile")  # of os


class Faults:
    """Counts the calls that change the disk; the one numbered `at`, from 0, fails as on a full disk. None fails where it is None."""

    def __init__(self, at: int | None = None) -> None:
        self.at, self.count, self.kind = at, 0, ""

    def failing(self, kind: str) -> bool:
        """Count a call; whether it is to fail."""
        self.count += 1
        if self.count - 1 == self.at:
            self.kind = kind
        return self.count - 1 == self.at

    def check(self, kind: str) -> None:
        """Count a call. Raises OSError when it is to fail."""
        if self.failing(kind):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    @contextlib.contextmanager
    def injected(self) -> Iterator[None]:
        """Every call of Python code that goes through open(), os or the swap of two folders."""
        opened, exchange = builtins.open, files._exchange

        def wrap(kind: str, call: Callable[..., Any]) -> Callable[..., Any]:
            def wrapped(*args: Any, **kwargs: Any) -> Any:
                self.check(kind)
                return call(*args, **kwargs)

            return wrapped

        def open_(file: Any, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
            result = opened(file, mode, *args, **kwargs)
            return _File(result, self) if set(mode) & set("wax+") and not isinstance(file, int) else result

        with contextlib.ExitStack() as stack:
            for name in CALLS:
                if hasattr(os, name):
                    stack.enter_context(patch.object(os, name, wrap(name, getattr(os, name))))
            stack.enter_context(patch.object(builtins, "open", open_))
            stack.enter_context(patch.object(io, "open", open_))
            # A system that refuses to swap in one step says so; renames follow.
            stack.enter_context(patch.object(files, "_exchange", lambda a, b: not self.failing("exchange") and exchange(a, b)))
            yield


class _File:
    """An open file whose writes, and whose last one in closing, may fail."""

    def __init__(self, file: Any, faults: Faults) -> None:
        self._file, self._faults, self._dirty = file, faults, False

    def write(self, data: Any) -> int:
        self._faults.check("write")
        self._dirty = True
        return int(self._file.write(data))

    def flush(self) -> None:
        self._faults.check("flush")
        self._dirty = False
        self._file.flush()

    def close(self) -> None:
        self._file.close()
        if self._dirty:  # the buffer is written now
            self._dirty = False
            self._faults.check("close")

    def __enter__(self) -> _File:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
