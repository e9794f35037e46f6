"""What the readers of photogrammetry tools have in common: each lists photographs with their poses and lenses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...errors import SnergError
from ...geometry.distortion import Distortion
from ...io.guard import check_file, reading
from ..dataset import DatasetOptions, Source, View
from ..depth import DepthFile
from ..image_resolver import check_distinct, find_image, scaled_to, size_for
from ..left_out import LeftOut, about_one_view
from ..masks import mask_of

TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # from OpenCV's camera axes (right, down, ahead) to (right, up, back)
MAX_XML_BYTES = 2**28  # about 200,000 cameras of Metashape


@dataclass(frozen=True, eq=False)
class Photograph:
    """One photograph as a tool lists it. Lengths are in pixels of `size`; where that is None, in the picture's larger side, or with
    `in_pixels` in the picture's own pixels."""

    name: str  # of its picture, as the tool writes it: a path, a file name, or a file name without its suffix
    pose: NDArray[Any]  # [4, 4] float64, camera-to-world, OpenGL's axes
    focal: tuple[float, float]  # along x and y
    centre: tuple[float, float]  # principal point from the top left corner; from the middle of the picture where `size` is None
    size: tuple[float, float] | None = None  # (width, height) that the lens was found for; None: of any picture
    in_pixels: bool = False
    distortion: Distortion | None = None
    projection: str = "perspective"
    depth: DepthFile | None = None


Listed = tuple[str, Callable[[], Photograph]]  # (what the listing calls it, which begins messages; reads it)


def read_photographs(file: Path, folder: Path, listed: Iterable[Listed], options: DatasetOptions, **source: Any) -> Source:
    """The dataset of the photographs that a tool lists. A photograph without a picture is left out and counted.

    file: the listing, which messages name. folder: of the pictures. source: further fields of Source. Raises SnergError when no picture
    is there, two photographs have one picture, or none can be used.
    """
    views, named, left_out, missing = [], [], LeftOut(), []
    for where, read in listed:
        with left_out.reading():
            with about_one_view():
                photograph = read()
            image = find_image(folder, photograph.name, where)
            if image is None:
                missing.append(photograph.name)
                continue
            with about_one_view():
                views.append(_view(photograph, image, where, source["root"]))
            named.append((photograph.name, image))
    if missing and not views and not left_out.errors:
        raise SnergError(f"{file} lists {len(missing)} images, such as {missing[0]}, of which {folder} has none; put them there.")
    left_out.check(views)
    if not views:
        raise SnergError(f"{file} lists no photograph with a pose; align the photographs and export it again.")
    check_distinct(named, str(file))
    notes = (*source.pop("notes", ()), *left_out.notes())
    return Source(
        views=tuple(views), photographs=True, factor=options.downscale, skipped_frames=len(missing), notes=notes, **source
    )  # fmt: skip


def _view(photograph: Photograph, image: Path, where: str, root: Path) -> View:
    if photograph.size is None:
        size, upright = size_for(image, (1.0, 1.0))
        given, unit = (float(size[0]), float(size[1])), 1.0 if photograph.in_pixels else float(max(size))
    else:
        size, upright = size_for(image, photograph.size)
        given, unit = photograph.size, 1.0
    middle = (0.0, 0.0) if photograph.size is not None else (given[0] / 2, given[1] / 2)
    camera = scaled_to(
        size,
        given,
        where,
        focal=(photograph.focal[0] * unit, photograph.focal[1] * unit),
        centre=(middle[0] + photograph.centre[0] * unit, middle[1] + photograph.centre[1] * unit),
        camera_to_world=photograph.pose,
        name=image.stem,
        distortion=photograph.distortion,
        projection=photograph.projection,
    )
    return View(camera, image, mask_of(root, image.name, image, where), upright=upright, depth=photograph.depth)


def read_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file. Raises SnergError when it is damaged, or declares entities, which could fill the memory (hard case 61)."""
    check_file(path, MAX_XML_BYTES)
    with reading(path, "export it again"):
        data = path.read_bytes()
        if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
            raise ValueError("it declares a document type or entities, which no exporter of cameras does")
        return ElementTree.fromstring(data)


def numbers(text: str | None, count: int, what: str) -> NDArray[Any]:
    """The numbers in a text, separated by white space, [count] float64. Raises SnergError, which names `what`, for other text."""
    try:
        values = np.array((text or "").split(), np.float64)
    except ValueError as error:
        raise SnergError(f"{what} is {text!r:.80}, not {count} numbers; export it again.") from error
    if len(values) != count:
        raise SnergError(f"{what} has {len(values)} numbers instead of {count}; export it again.")
    if not np.isfinite(values).all():
        raise SnergError(f"{what} is not finite; export it again.")
    return values


def brown(k: Iterable[float], p1: float, p2: float) -> Distortion | None:
    """Brown's lens with the radial factors of r^2, r^4, r^6, r^8 and OpenCV's tangential p1, p2; None where all are 0."""
    values = (*k, p1, p2)
    return Distortion("nerfstudio", values) if any(values) else None
