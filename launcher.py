"""Run SNeRG's command line in a Python of its own: `python launcher.py VERB ARG...`.

Blender's Python knows neither this folder (an extension is loaded as bl_ext.<repository>.<id>) nor where the
extension's wheels were unpacked, so the parent hands over its import path in SNERG_IMPORT_PATH (JSON list).
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path

IMPORT_PATH = "SNERG_IMPORT_PATH"


def load(root: Path, name: str = "snerg") -> None:
    """Make the folder `root` importable as the package `name`, wherever it lies and whatever it is called."""
    spec = importlib.util.spec_from_file_location(name, root / "__init__.py", submodule_search_locations=[str(root)])
    if spec is None or spec.loader is None:
        raise ImportError(f"{root} is not a Python package")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)


def main() -> int:
    """The command line's exit code."""
    own = str(Path(__file__).parent)  # Python puts the script's folder first, where core/ and operators/ are no top-level packages
    sys.path[:] = [entry for entry in sys.path if entry != own]
    for entry in json.loads(os.environ.get(IMPORT_PATH, "[]")):
        if entry not in sys.path and entry != own:
            sys.path.append(entry)
    load(Path(__file__).resolve().parent)
    code: int = importlib.import_module("snerg.core.start").main(sys.argv[1:])
    return code


if __name__ == "__main__":
    sys.exit(main())
