"""Reads the cameras that Agisoft Metashape exports as XML (File, Export, Export Cameras).

A camera's transform is camera-to-chunk with OpenCV's axes. Lens by Metashape's manual, appendix 'Camera models': with x, y the ideal
coordinates and r their length, x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y, the pixel column is
w / 2 + cx + x' (f + b1) + y' b2, the row h / 2 + cy + y' f. p1 and p2 are OpenCV's p2 and p1. A fisheye's x, y have the length of the
angle from the axis in place of its tangent.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from ...errors import SnergError
from ...geometry.camera import panorama_focal
from ...geometry.distortion import Distortion
from ..dataset import DatasetOptions, Source
from ..image_resolver import image_folder
from ..left_out import UnsupportedLens
from .photographs import TO_OPENGL, Listed, Photograph, brown, numbers, read_photographs, read_xml

HEAD = 4096  # bytes at the start of a file by which it is recognised
FISHEYES = ("fisheye", "equidistant_fisheye")
PANORAMAS = ("spherical", "equirectangular")
MODEL = "{} has the lens model {}, which is not supported; export undistorted photographs (File, Export, Convert Images)."
SLIGHT = 1.0  # pixels: terms that move no pixel farther are taken as 0 without a word


@dataclass(frozen=True, eq=False)
class Sensor:
    """What one of Metashape's sensors says: a lens that photographs share. Lengths are in pixels."""

    size: tuple[float, float]
    focal: tuple[float, float]
    centre: tuple[float, float]
    distortion: Distortion | None
    projection: str = "perspective"


def find_file(path: Path) -> Path | None:
    """The file of Metashape's cameras at a path, or the first in a folder; None where there is none."""
    files = [path] if path.is_file() and path.suffix.lower() == ".xml" else sorted(path.glob("*.[xX][mM][lL]")) if path.is_dir() else []
    return next((file for file in files if _is_cameras(file)), None)


def _is_cameras(file: Path) -> bool:
    with open(file, "rb") as data:
        head = data.read(HEAD)
    return b"<document" in head and b"<chunk" in head


def is_metashape(path: Path) -> bool:
    """Whether a path is a file of cameras of Metashape, or a folder that holds one."""
    return find_file(path) is not None


def read_metashape(path: Path, options: DatasetOptions) -> Source:
    """Read Metashape's cameras and find their photographs beside the file, in a folder such as 'images'.

    Of several chunks and components, which have coordinates of their own, the one with the most cameras is read, and said. Cameras
    without a pose and those that are disabled are left out, and counted. Raises SnergError as `read_photographs` does.
    """
    file = find_file(path)
    if file is None:
        raise SnergError(f"{path} has no cameras of Metashape; export them as XML (File, Export, Export Cameras).")
    chunk, notes = _largest_chunk(file, read_xml(file))
    sensors = {str(sensor.get("id")): sensor for sensor in chunk.iterfind("sensors/sensor")}
    posed = _posed(chunk)
    cameras, others = _largest_component(posed)
    total = sum(1 for _ in chunk.iter("camera"))
    if total > len(posed):
        notes += (f"{total - len(posed)} of the {total} cameras in {file} have no pose or are disabled; they are left out.",)
    if others:
        notes += (f"{others} cameras in {file} belong to other components, which are not aligned with the largest; they are left out.",)
    notes += tuple(note for sensor in sensors.values() if (note := _ignored(f"{file}, sensor {sensor.get('label')},", sensor)))
    folder, factor = image_folder(file.parent, options.downscale, str(file))
    listed: list[Listed] = [(f"{file}, camera {camera.get('label')},", partial(_photograph, camera, sensors)) for camera in cameras]
    reduced = DatasetOptions(options.holdout, factor)
    return read_photographs(file, folder, listed, reduced, root=file.parent, kind="metashape", notes=notes)


def _largest_chunk(file: Path, document: Element) -> tuple[Element, tuple[str, ...]]:
    chunks = list(document.iter("chunk"))
    if not chunks:
        raise SnergError(f"{file} has no chunk; export the cameras from Metashape again.")
    chosen = max(chunks, key=lambda chunk: len(_posed(chunk)))
    if len(chunks) == 1:
        return chosen, ()
    return chosen, (f"There are {len(chunks)} chunks in {file}: {chosen.get('label')}, which has the most cameras, is read.",)


def _posed(chunk: Element) -> list[Element]:
    """The cameras of a chunk, those in groups included, that have a pose and are not disabled."""
    return [c for c in chunk.iter("camera") if c.find("transform") is not None and c.get("enabled", "1").lower() not in ("0", "false")]


def _largest_component(cameras: list[Element]) -> tuple[list[Element], int]:
    """(the cameras of the component that has the most, how many belong to others)."""
    if not cameras:
        return [], 0
    chosen = Counter(camera.get("component_id") for camera in cameras).most_common(1)[0][0]
    kept = [camera for camera in cameras if camera.get("component_id") == chosen]
    return kept, len(cameras) - len(kept)


def _photograph(camera: Element, sensors: dict[str, Element]) -> Photograph:
    """What the file says of one camera. Raises UnsupportedLens, and SnergError when a value is missing or no number."""
    where = f"The camera {camera.get('label')} of Metashape"
    sensor = sensors.get(str(camera.get("sensor_id")))
    if sensor is None:
        raise SnergError(f"{where} has no sensor in the file; export the cameras again.")
    pose = numbers(camera.findtext("transform"), 16, f"{where}: its transform").reshape(4, 4) @ TO_OPENGL
    lens = _sensor(where, sensor)
    return Photograph(
        str(camera.get("label", "")), pose, lens.focal, lens.centre, lens.size, distortion=lens.distortion, projection=lens.projection
    )


def _calibration(sensor: Element) -> Element | None:
    """The calibration that the alignment found, else the one that it began with."""
    found = sensor.findall("calibration")
    return next((c for c in found if c.get("class") == "adjusted"), found[0] if found else None)


def _sensor(where: str, sensor: Element) -> Sensor:
    calibration = _calibration(sensor)
    source = sensor if calibration is None or calibration.find("resolution") is None else calibration
    resolution = source.find("resolution")
    if resolution is None:
        raise SnergError(f"{where} has a sensor without a resolution; export the cameras again.")
    size = float(_attribute(resolution, "width", where)), float(_attribute(resolution, "height", where))
    kind = str(sensor.get("type", "frame"))
    if kind in PANORAMAS:
        return _panorama(size)
    if calibration is None:
        raise SnergError(f"{where} has a sensor without a calibration; align the photographs and export the cameras again.")
    if kind not in ("frame", *FISHEYES):
        raise UnsupportedLens(MODEL.format(where, kind))
    term = _terms(calibration, where)
    if any(term[name] for name in ("p3", "p4")):
        raise UnsupportedLens(MODEL.format(where, f"{kind} with P3 and P4"))
    radial = [term[name] for name in ("k1", "k2", "k3", "k4")]
    distortion = Distortion("fisheye", tuple(radial)) if kind in FISHEYES else brown(radial, term["p2"], term["p1"])
    centre = size[0] / 2 + term["cx"], size[1] / 2 + term["cy"]
    return Sensor(size, (term["f"] + term["b1"], term["f"]), centre, distortion)


def _panorama(size: tuple[float, float]) -> Sensor:
    return Sensor(size, panorama_focal(*size), (size[0] / 2, size[1] / 2), None, "equirectangular")


def _ignored(where: str, sensor: Element) -> str:
    """A sentence that names terms of a sensor's calibration that the lens model lacks, where they move a pixel by more than SLIGHT."""
    calibration = _calibration(sensor)
    resolution = sensor.find("resolution")
    if calibration is None or resolution is None or sensor.get("type", "frame") not in ("frame", *FISHEYES):
        return ""
    try:
        term = _terms(calibration, where)
        corner = np.hypot(float(resolution.get("width", 0)), float(resolution.get("height", 0))) / 2 / term["f"]
    except (SnergError, ValueError, ZeroDivisionError):
        return ""  # its photographs are left out, with the reason
    moved = {"B2": abs(term["b2"]) * corner}
    if sensor.get("type") in FISHEYES:
        moved["P1 and P2"] = 3 * max(abs(term["p1"]), abs(term["p2"])) * corner**2 * term["f"]
    named = [name for name, pixels in moved.items() if pixels > SLIGHT]
    return f"{where} has {' and '.join(named)}, which are taken as 0." if named else ""


def _terms(calibration: Element, where: str) -> dict[str, float]:
    """The terms of a calibration by name, 0 where they are missing. Raises SnergError when f is missing or one is no number."""
    if calibration.find("f") is None:
        raise SnergError(f"{where} has a calibration without f; export the cameras again.")
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    found = {name: calibration.findtext(name) for name in names}
    return {name: 0.0 if text is None else float(numbers(text, 1, f"{where}: its {name}")[0]) for name, text in found.items()}


def _attribute(element: Element, name: str, where: str) -> Any:
    return numbers(element.get(name), 1, f"{where}: its sensor's {name}")[0]
