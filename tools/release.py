"""Build a release: the extension's zips for every platform and Python, each built and validated by Blender's own tool.

Refuses, before anything is built, when the versions differ or the changelog has no dated section for this version. Writes the zips
and SHA256SUMS to build/release.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import shutil
import sys
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path

from build_extension import PLATFORMS, PYTHONS, ROOT, build

OUT = ROOT / "build" / "release"
NEEDED = (
    "__init__.py",
    "blender_manifest.toml",
    "LICENSE",
    "core/cli.py",
    "operators/train.py",
    "snerg_addon/bridge.py",
    "viewer/dist/path.js",
    "viewer/dist/viewer.js",
    "viewer/dist/optional/annotations.js",
    "viewer/dist/optional/benchmark.js",
    "viewer/dist/optional/measure.js",
    "viewer/dist/optional/vr.js",
    "viewer/index.html",
    "viewer/page.css",
)
MOST_MEGABYTES = 200  # of one zip; the six of version 0.1.0 have 101 to 152, of which JAX and SciPy are two thirds


def version_of(root: Path) -> str:
    """The version that the manifest and pyproject.toml agree on and the changelog dates. Exits with one sentence otherwise."""
    version = str(tomllib.loads((root / "blender_manifest.toml").read_text())["version"])
    package = str(tomllib.loads((root / "pyproject.toml").read_text())["project"]["version"])
    if package != version:
        sys.exit(f"blender_manifest.toml has version {version}, pyproject.toml {package}; make them equal.")
    if not re.search(rf"^## {re.escape(version)} . \d{{4}}-\d{{2}}-\d{{2}}\b", (root / "CHANGELOG.md").read_text(), re.MULTILINE):
        sys.exit(f"CHANGELOG.md has no section '## {version} — YYYY-MM-DD'; date it before the release.")
    return version


def check_zip(path: Path, version: str) -> None:
    """Exit with one sentence when a zip lacks a file, holds a file of Python's cache, has another version or is too large."""
    with zipfile.ZipFile(path) as opened:
        names = opened.namelist()
        manifest = tomllib.loads(opened.read("blender_manifest.toml").decode())
    missing = [name for name in NEEDED if name not in names]
    if missing:
        sys.exit(f"{path.name} lacks {', '.join(missing)}; run `make setup` and build it again.")
    if cached := [name for name in names if "__pycache__" in name]:
        sys.exit(f"{path.name} holds {cached[0]}, which is no part of the extension.")
    if lost := [wheel for wheel in manifest.get("wheels", []) if wheel.removeprefix("./") not in names]:
        sys.exit(f"{path.name} lacks the wheel {lost[0]}.")
    if manifest["version"] != version:
        sys.exit(f"{path.name} has version {manifest['version']}, not {version}.")
    if path.stat().st_size > MOST_MEGABYTES * 1e6:
        sys.exit(f"{path.name} has {path.stat().st_size / 1e6:.0f} MB; at most {MOST_MEGABYTES} are expected.")


def checksums(paths: Sequence[Path]) -> str:
    """Lines as `sha256sum` writes them."""
    return "".join(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in paths)


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--platform", action="append", choices=sorted(PLATFORMS), help="only this one; may be repeated (default: all)")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for the zips (default: build/release)")
    parser.add_argument("--blender", default="", help="a Blender to build and validate with, instead of the bpy module")
    options = parser.parse_args(arguments)
    version = version_of(ROOT)
    shutil.rmtree(options.out, ignore_errors=True)
    zips = []
    for platform in options.platform or sorted(PLATFORMS):
        for python in sorted(PYTHONS):
            zips.append(build(PYTHONS[python], platform, options.out, options.blender))
            check_zip(zips[-1], version)
            print(f"{zips[-1]} ({zips[-1].stat().st_size / 1e6:.0f} MB)")
    (options.out / "SHA256SUMS").write_text(checksums(zips))


if __name__ == "__main__":
    main()
