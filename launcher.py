"""Run SNeRG's command line in a new Python process: `python launcher.py COMMAND ARGUMENT...`.

That process can import neither this folder (an extension is loaded as bl_ext.<repository>.<id>) nor the extension's wheels, so the
parent passes its import path in the variable SNERG_IMPORT_PATH (a JSON list).
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import sys
from pathlib import Path

IMPORT_PATH = "SNERG_IMPORT_PATH"
RENDER = "--render-job"  # in place of a command: Blender renders a dataset (snerg_addon/render_job.py)
JOB = "SNERG_JOB"  # the folder of the job that this process runs (core/jobs/folder.py); a job first waits for its turn


def load(root: Path, name: str = "snerg") -> None:
    """Make the folder `root` importable as the package `name`, whatever its path."""
    spec = importlib.util.spec_from_file_location(name, root / "__init__.py", submodule_search_locations=[str(root)])
    if spec is None or spec.loader is None:
        raise ImportError(f"{root} is not a Python package")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)


def main() -> int:
    """Run the command and return the exit code."""
    own = str(Path(__file__).parent)  # Python puts the script's folder first, but core/ and operators/ are no top-level packages
    sys.path[:] = [entry for entry in sys.path if entry != own]
    for entry in json.loads(os.environ.get(IMPORT_PATH, "[]")):
        if entry not in sys.path and entry != own:
            sys.path.append(entry)
    load(Path(__file__).resolve().parent)
    if os.environ.get(JOB) and (stopped := importlib.import_module("snerg.core.jobs.protocol").await_turn()):
        return int(stopped)
    if sys.argv[-1] == RENDER:
        return int(importlib.import_module("snerg.snerg_addon.render_job").main())
    code: int = importlib.import_module("snerg.core.start").main(sys.argv[1:])
    return code


if __name__ == "__main__":
    sys.exit(main())
