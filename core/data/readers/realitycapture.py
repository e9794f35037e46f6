"""Reads what RealityCapture (now RealityScan) exports: 'Internal/External camera parameters' (.csv), or an .xmp beside each photograph.

Lengths are in units of the picture's larger side; a focal length is given for film 36 mm wide. In the table the rotation is
Rz(-heading) Rx(pitch) Ry(roll) with OpenGL's axes, as nerfstudio reads it; in .xmp it is world-to-camera, row by row, with OpenCV's.
The lens is Brown's with k1 .. k4, t1, t2, of which t2, t1 are OpenCV's p1, p2 (calibration.xml, which is part of the program).
"""

from __future__ import annotations

import csv
import io
import math
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...geometry.distortion import Distortion
from ...io.guard import check_file, reading
from ..dataset import DatasetOptions, Source
from ..image_resolver import image_folder, images_in
from ..left_out import UnsupportedLens
from .photographs import TO_OPENGL, Listed, Photograph, brown, numbers, read_photographs, read_xml

FILM = 36.0  # mm, the width for which focal lengths are given
NAMES = {"heading": ("heading", "yaw"), "f": ("f", "f_35mm"), "px": ("px", "px_norm"), "py": ("py", "py_norm")}  # of columns, by version
NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
LENS = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")  # columns that may be missing, for 0
SPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
MARK = b"capturingreality.com/ns/xcr"  # in each .xmp that the program wrote
MAX_TABLE_BYTES = 2**26  # about 200,000 cameras
SIDECARS = "*.[xX][mM][pP]"
BROWN = ("perspective", "brown3", "brown3t2", "brown4", "brown4t2")  # lens models of .xmp


def find_table(path: Path) -> Path | None:
    """The table of cameras at a path, or the first in a folder; None where there is none."""
    files = [path] if path.is_file() and path.suffix.lower() == ".csv" else sorted(path.glob("*.[cC][sS][vV]")) if path.is_dir() else []
    return next((file for file in files if _is_table(file)), None)


def _is_table(file: Path) -> bool:
    with open(file, "rb") as data:
        lines = data.read(4096).lstrip(b"\xef\xbb\xbf").splitlines()
    return any(line.startswith(b"#name,") for line in lines[:2])  # the number of cameras may come first


def sidecars(path: Path) -> list[Path]:
    """The .xmp files of RealityCapture in a folder or its folder of images; none where it has no such files."""
    folder = _sidecar_folder(path)
    return [] if folder is None else sorted(folder.glob(SIDECARS))


def _sidecar_folder(path: Path) -> Path | None:
    """The folder with them, known by one of them: the panel asks at every redraw, and sorting thousands would take tens of milliseconds."""
    if not path.is_dir():
        return None
    for folder in (path, *(path / name for name in ("images", "input", "photos"))):
        one = next(folder.glob(SIDECARS), None) if folder.is_dir() else None
        if one is not None:
            with open(one, "rb") as data:
                if MARK in data.read(4096):
                    return folder
    return None


def is_realitycapture(path: Path) -> bool:
    """Whether a path is a table of cameras of RealityCapture, or a folder with one or with its .xmp files."""
    return find_table(path) is not None or _sidecar_folder(path) is not None


def read_realitycapture(path: Path, options: DatasetOptions) -> Source:
    """Read the cameras that RealityCapture exported and find their photographs beside the table, in a folder such as 'images'.

    Where there is no table, the .xmp files are read. Raises SnergError when the table lacks a column, or as `read_photographs` does.
    """
    table = find_table(path)
    listed: list[Listed]
    if table is None:
        files = sidecars(path)
        if not files:
            raise SnergError(f"{path} has no cameras of RealityCapture; export 'Internal/External camera parameters'.")
        listed = [(str(file), partial(_sidecar, file)) for file in files]
        root, folder, factor = path, files[0].parent, options.downscale
        unposed = len(images_in(folder, str(path))) - len(files)
        notes = (f"{unposed} photographs in {folder} have no .xmp, since they were not aligned; they are left out.",) if unposed > 0 else ()
        return read_photographs(folder, folder, listed, options, root=root, kind="realitycapture", notes=notes)
    root = table.parent
    folder, factor = image_folder(root, options.downscale, str(table))
    listed = [(f"{table}, {row.get('name')},", partial(_row, row)) for row in _rows(table)]
    reduced = DatasetOptions(options.holdout, factor)
    return read_photographs(table, folder, listed, reduced, root=root, kind="realitycapture")


def _rows(table: Path) -> list[dict[str, str]]:
    """The rows of a table by column, under the names in NEEDED. Raises SnergError when a column is missing."""
    check_file(table, MAX_TABLE_BYTES)
    with reading(table, "export it again"):
        lines = table.read_text(encoding="utf-8-sig").splitlines()
        start = next(i for i, line in enumerate(lines) if line.startswith("#name,"))
        rows = list(csv.reader(io.StringIO("\n".join(lines[start:]))))
    columns = [column.strip().lower().removeprefix("#") for column in rows[0]]
    columns = [next((name for name, others in NAMES.items() if column in others), column) for column in columns]
    missing = [name for name in NEEDED if name not in columns]
    if missing:
        raise SnergError(f"{table} has no column {missing[0]}; export 'Internal/External camera parameters' from RealityCapture.")
    return [dict(zip(columns, (value.strip() for value in row), strict=False)) for row in rows[1:] if row]


def _row(row: dict[str, str]) -> Photograph:
    where = f"The camera {row['name']} of RealityCapture"
    value = {name: float(numbers(row.get(name) or "0", 1, f"{where}: its {name}")[0]) for name in (*NEEDED[1:], *LENS)}
    pose = np.eye(4)
    pose[:3, :3] = turned(*(math.radians(value[name]) for name in ("heading", "pitch", "roll")))
    pose[:3, 3] = value["x"], value["y"], value["alt"]
    lens = brown([value[f"k{i}"] for i in range(1, 5)], value["t2"], value["t1"])
    return Photograph(row["name"], pose, (value["f"] / FILM,) * 2, (value["px"], value["py"]), distortion=lens)


def turned(heading: float, pitch: float, roll: float) -> NDArray[Any]:
    """The rotation [3, 3] Rz(-heading) Rx(pitch) Ry(roll), angles in radians: camera-to-world with OpenGL's axes."""
    (ch, cp, cr), (sh, sp, sr) = np.cos([-heading, pitch, roll]), np.sin([-heading, pitch, roll])
    around_z = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    around_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    around_y = np.array([[cr, 0, sr], [0, 1, 0], [-sr, 0, cr]])
    return np.asarray(around_z @ around_x @ around_y)


def _sidecar(file: Path) -> Photograph:
    """What one .xmp says. Raises UnsupportedLens, and SnergError when a value is missing or no number."""
    place = next((e for e in read_xml(file).iter() if any(key.startswith(SPACE) for key in e.attrib)), None)
    if place is None or _text(place, "Rotation") is None:
        raise SnergError(f"{file} has no pose; export the metadata (XMP) of aligned photographs from RealityCapture.")
    world_to_camera = numbers(_text(place, "Rotation"), 9, f"{file}: its Rotation").reshape(3, 3)
    pose = np.eye(4)
    pose[:3, :3] = world_to_camera.T @ TO_OPENGL[:3, :3]
    pose[:3, 3] = numbers(_text(place, "Position"), 3, f"{file}: its Position")
    focal = float(numbers(_text(place, "FocalLength35mm"), 1, f"{file}: its FocalLength35mm")[0]) / FILM
    centre = [float(numbers(_text(place, f"PrincipalPoint{axis}") or "0", 1, f"{file}: its principal point")[0]) for axis in "UV"]
    aspect = float(numbers(_text(place, "AspectRatio") or "1", 1, f"{file}: its AspectRatio")[0])
    return Photograph(file.stem, pose, (focal, focal * aspect), (centre[0], centre[1]), distortion=_lens(place, file))


def _lens(place: Element, file: Path) -> Distortion | None:
    text = _text(place, "DistortionCoeficients")  # the program's own spelling
    values = numbers(text, 6, f"{file}: its DistortionCoeficients") if text is not None else np.zeros(6)
    model = _text(place, "DistortionModel") or "brown3"
    if model not in BROWN and values.any():
        raise UnsupportedLens(f"{file} has the lens model {model}, which is not supported; choose Brown3 in the alignment's settings.")
    *radial, t1, t2 = (float(v) for v in values)
    return brown(radial, t2, t1)


def _text(place: Element, name: str) -> str | None:
    """A value of an .xmp, which is an attribute or an element."""
    return place.get(SPACE + name) or place.findtext(SPACE + name)
