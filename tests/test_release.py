"""`make release` refuses what must not be released."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))
import release  # noqa: E402

sys.path.remove(str(ROOT / "tools"))


def write(root: Path, version: str, package: str, heading: str) -> Path:
    """A repository with a manifest, a package and a changelog."""
    (root / "blender_manifest.toml").write_text(f'version = "{version}"\n')
    (root / "pyproject.toml").write_text(f'[project]\nversion = "{package}"\n')
    (root / "CHANGELOG.md").write_text(f"# Changelog\n\n## {heading}\n")
    return root


def test_a_dated_version_is_released(tmp_path):
    assert release.version_of(write(tmp_path, "0.2.0", "0.2.0", "0.2.0 — 2026-11-27 — one house")) == "0.2.0"


@pytest.mark.parametrize(
    ("package", "heading", "said"),
    [
        ("0.1.0", "0.2.0 — 2026-11-27", "pyproject.toml 0.1.0"),
        ("0.2.0", "0.2.0", "date it"),
        ("0.2.0", "Unreleased — one house", "date it"),
        ("0.2.0", "0.1.0 — 2026-11-27", "date it"),
    ],
)
def test_versions_that_differ_or_have_no_date_are_refused(tmp_path, package, heading, said):
    with pytest.raises(SystemExit, match=said):
        release.version_of(write(tmp_path, "0.2.0", package, heading))


def zipped(path: Path, version: str, *names: str) -> Path:
    """A zip with a manifest that lists one wheel."""
    with zipfile.ZipFile(path, "w") as opened:
        opened.writestr("blender_manifest.toml", f'version = "{version}"\nwheels = ["./wheels/a.whl"]\n')
        for name in names:
            opened.writestr(name, "")
    return path


def test_a_zip_that_is_not_whole_is_refused(tmp_path):
    files = [name for name in release.NEEDED if name != "blender_manifest.toml"]
    release.check_zip(zipped(tmp_path / "good.zip", "0.2.0", *files, "wheels/a.whl"), "0.2.0")
    for names, version, said in (
        (files[1:], "0.2.0", "lacks"),
        (files, "0.2.0", "lacks the wheel"),
        ([*files, "wheels/a.whl", "core/__pycache__/a.pyc"], "0.2.0", "__pycache__"),
        ([*files, "wheels/a.whl"], "0.1.0", "has version"),
    ):
        with pytest.raises(SystemExit, match=said):
            release.check_zip(zipped(tmp_path / "bad.zip", version, *names), "0.2.0")


def test_checksums_are_those_of_sha256sum(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"")
    assert release.checksums([tmp_path / "a.zip"]) == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855  a.zip\n"
