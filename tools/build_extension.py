"""Build the installable extension: one zip for each Python that Blender brings and each platform.

Two Pythons cannot share a zip. Blender unpacks, of several wheels of one package that fit, the newest; and the
wheel of JAX itself fits every Python, so that Blender 5.0 (NumPy 1.26, JAX 0.7.1) would get the JAX of Blender 5.2.
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "build" / "extension"
CODE = ("core", "operators", "snerg_addon", "farm")
PAGE = ("index.html", "page.css", "dist/viewer.js", "dist/optional")  # of the web viewer: what an exported page is made of
FILES = ("__init__.py", "py.typed", "launcher.py", "LICENSE", "README.md", "CHANGELOG.md")
LEFT_OUT = shutil.ignore_patterns("__pycache__", "node_modules", ".*", "*.egg-info", "*.pyc")
TRAINING = ("jax", "jaxlib", "ml_dtypes", "opt_einsum", "scipy", "optax", "absl-py", "pillow", "msgpack")  # Blender brings NumPy
PLOTS = ("matplotlib", "contourpy", "cycler", "fonttools", "kiwisolver", "packaging", "pyparsing", "python-dateutil", "tzdata")
REPORT = ("jinja2", "markupsafe")
WHEELS = (*TRAINING, *PLOTS, *REPORT)


@dataclass(frozen=True)
class Python:
    """A Python that Blender brings: from `blender_min` on, before `blender_max`."""

    version: str
    blender_min: str
    blender_max: str = ""

    @property
    def tag(self) -> str:
        """'py311'"""
        return "py" + self.version.replace(".", "")


PYTHONS = {python.version: python for python in (Python("3.11", "4.5.0", "5.1.0"), Python("3.13", "5.1.0"))}
PLATFORMS = {  # as Blender calls them, and the tags of wheels that run there, newest first
    "linux-x64": [*(f"manylinux_2_{n}_x86_64" for n in (28, 27, 17)), "manylinux2014_x86_64"],
    "windows-x64": ["win_amd64"],
    "macos-arm64": [f"macosx_{n}_0_{machine}" for n in (14, 13, 12, 11) for machine in ("arm64", "universal2")],
}


def this_platform() -> str:
    """The platform that this runs on, by Blender's name for it."""
    system = {"Linux": "linux", "Windows": "windows", "Darwin": "macos"}.get(platform.system(), platform.system().lower())
    machine = {"x86_64": "x64", "AMD64": "x64", "aarch64": "arm64"}.get(platform.machine(), platform.machine())
    return f"{system}-{machine}"


def pinned(python: Python) -> list[str]:
    """'jax==0.7.1', ... : the versions that requirements.txt pins for a Python."""
    found = {}
    for line in (ROOT / "requirements.txt").read_text().splitlines():
        text = line.partition("#")[0].strip()
        if text:
            requirement = Requirement(text)
            if requirement.marker is None or requirement.marker.evaluate({"python_version": python.version}):
                found[requirement.name] = f"{requirement.name}{requirement.specifier}"
    missing = [name for name in WHEELS if name not in found]
    if missing:
        sys.exit(f"requirements.txt pins no {', '.join(missing)} for Python {python.version}.")
    return [found[name] for name in WHEELS]


def download(python: Python, target: str) -> list[Path]:
    """The wheels for a Python and platform, from the package index or from an earlier build."""
    folder = ROOT / "build" / "wheels" / f"{python.tag}-{target}"
    abi = "cp" + python.version.replace(".", "")
    tags = [argument for tag in PLATFORMS[target] for argument in ("--platform", tag)]
    abis = [argument for name in (abi, "abi3", "none") for argument in ("--abi", name)]
    wanted = pinned(python)
    stamp = folder / "wanted.txt"
    if not stamp.is_file() or stamp.read_text() != "\n".join(wanted):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        pip = [sys.executable, "-m", "pip", "download", "--disable-pip-version-check", "-q", "--no-deps", "--only-binary=:all:"]
        versions = ["--python-version", python.version, "--implementation", "cp"]
        subprocess.run([*pip, *versions, *tags, *abis, "--dest", str(folder), *wanted], check=True)
        stamp.write_text("\n".join(wanted))
    return sorted(folder.glob("*.whl"))


def stage(folder: Path, manifest: str, wheels: Sequence[Path]) -> None:
    """Lay out what goes into the zip."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in FILES:
        shutil.copy2(ROOT / name, folder / name)
    for name in CODE:
        shutil.copytree(ROOT / name, folder / name, ignore=LEFT_OUT)
    for name in PAGE:
        path = ROOT / "viewer" / name
        if path.exists():
            (folder / "viewer" / name).parent.mkdir(parents=True, exist_ok=True)
            (shutil.copytree if path.is_dir() else shutil.copy2)(path, folder / "viewer" / name)
    if wheels:
        (folder / "wheels").mkdir()
        for wheel in wheels:
            shutil.copy2(wheel, folder / "wheels" / wheel.name)
    (folder / "blender_manifest.toml").write_text(manifest)


def manifest_for(python: Python | None, target: str, wheels: Sequence[Path]) -> str:
    """The manifest with what depends on the Python and the platform filled in."""
    text = (ROOT / "blender_manifest.toml").read_text()
    if python is None:
        return text
    lines = [f'platforms = ["{target}"]', "wheels = [", *(f'  "./wheels/{wheel.name}",' for wheel in wheels), "]"]
    if python.blender_max:
        lines.insert(0, f'blender_version_max = "{python.blender_max}"')
    head, table, tail = text.partition("[permissions]")
    filled = head.replace('blender_version_min = "4.5.0"', f'blender_version_min = "{python.blender_min}"')
    result = filled + "\n".join(lines) + "\n\n" + table + tail
    tomllib.loads(result)
    return result


def blender_command(blender: str) -> list[str]:
    """What runs Blender's own extension tool: a Blender, or the file of the bpy module that is that tool."""
    if blender:
        return [blender, "--factory-startup", "--command", "extension"]
    spec = importlib.util.find_spec("bpy")
    folders = list(spec.submodule_search_locations or []) if spec else []
    tools = [path for folder in folders for path in Path(folder).glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")]
    if not tools:
        sys.exit("Neither Blender nor the bpy module is here; run `make setup`, or give --blender PATH.")
    return [sys.executable, str(tools[0])]


def build(python: Python | None, target: str, out: Path, blender: str = "") -> Path:
    """Build and validate one zip; without a Python, the light one that has no wheels and uses what is installed."""
    wheels = download(python, target) if python else []
    version = tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"]
    kind = f"{python.tag}-{target.replace('-', '_')}" if python else "light"
    zipped = out / f"snerg_addon-{version}-{kind}.zip"
    folder = out / f"stage-{kind}"
    out.mkdir(parents=True, exist_ok=True)
    stage(folder, manifest_for(python, target, wheels), wheels)
    tool = blender_command(blender)
    run(*tool, "build", "--source-dir", str(folder), "--output-filepath", str(zipped))
    run(*tool, "validate", str(zipped))
    shutil.rmtree(folder)
    return zipped


def run(*command: str) -> None:
    """Run it quietly; end with what it said when it fails."""
    result = subprocess.run(command, capture_output=True, text=True)
    if result.returncode:
        sys.exit(f"{' '.join(command)} failed:\n{result.stdout}{result.stderr}")


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", choices=sorted(PYTHONS), help="a Python that Blender brings; both by default")
    parser.add_argument("--platform", action="append", choices=sorted(PLATFORMS), help="this platform by default")
    parser.add_argument("--no-wheels", action="store_true", help="one light zip that uses the packages installed in Blender's Python")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for the zips")
    parser.add_argument("--blender", default="", help="a Blender to build and validate with, instead of the bpy module")
    options = parser.parse_args(arguments)
    if not (ROOT / "viewer" / "dist" / "viewer.js").is_file():
        print("The web viewer is not built (run `make setup`): this extension will not export web pages.", file=sys.stderr)
    if options.no_wheels:
        print(build(None, "", options.out, options.blender))
        return
    targets = options.platform or [this_platform()]
    if targets[0] not in PLATFORMS:
        parser.error(f"there is no build for {targets[0]}; choose one with --platform")
    for target in targets:
        for version in options.python or sorted(PYTHONS):
            zipped = build(PYTHONS[version], target, options.out, options.blender)
            print(f"{zipped} ({zipped.stat().st_size / 1e6:.0f} MB)")


if __name__ == "__main__":
    main()
