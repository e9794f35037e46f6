"""Annotations of a scene: texts at points of it, which a web page shows as labels."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import SnergError
from ..io.guard import reading
from ..io.json_files import read_edited_json
from ..io.schema import number, record, text

MAX_TEXT = 500  # characters: a label that is longer hides the scene
MAX_ANNOTATIONS = 200  # labels of a page: more find no room


@dataclass(frozen=True)
class Annotation:
    """A text at a point. Raises SnergError for an empty or too long text."""

    text: str
    position: tuple[float, float, float]  # in the world of the scene, Blender's axes
    camera: str = ""  # the name of the camera to fly to; empty for none

    def __post_init__(self) -> None:
        if not self.text.strip():
            raise SnergError(f"The annotation at {self.position} has no text; write one, or leave it out.")
        if len(self.text) > MAX_TEXT:
            raise SnergError(f"The annotation {self.text[:30]!r}... has {len(self.text)} characters; a label holds {MAX_TEXT}.")

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        return {"text": self.text, "position": list(self.position), **({"camera": self.camera} if self.camera else {})}

    def moved(self, transform: Any) -> Annotation:
        """The annotation in another world. transform: [4, 4], from this one."""
        x, y, z = (np.asarray(transform) @ [*self.position, 1.0])[:3].tolist()
        return Annotation(self.text, (x, y, z), self.camera)


def read_annotations(path: str | os.PathLike[str]) -> tuple[Annotation, ...]:
    """The annotations of a JSON file: {"annotations": [{"text": "Window", "position": [x, y, z], "camera": "Front"}, ...]}.

    Positions are in the world of the scene; "camera" may be left out. Raises SnergError when the file is not one of annotations.
    """
    with reading(Path(path), "correct it"):
        values = record(read_edited_json(Path(path)), "it")["annotations"]
        if not isinstance(values, list) or len(values) > MAX_ANNOTATIONS:
            raise ValueError(f"its annotations must be a list of at most {MAX_ANNOTATIONS}")
        return tuple(_annotation(record(value, f"annotation {index}"), index) for index, value in enumerate(values, 1))


def _annotation(value: dict[str, Any], index: int) -> Annotation:
    position = value["position"]
    if not isinstance(position, list) or len(position) != 3:
        raise ValueError(f"the position of annotation {index} must be three numbers")
    x, y, z = (number(each, f"the position of annotation {index}") for each in position)
    return Annotation(text(value["text"], f"the text of annotation {index}"), (x, y, z), text(value.get("camera", ""), "a camera"))


def annotations_json(annotations: Sequence[Annotation]) -> dict[str, Any]:
    """The value of annotations.json, which `read_annotations` and the page read."""
    return {"format": "snerg-annotations", "version": 1, "annotations": [annotation.to_json() for annotation in annotations]}


def with_known_cameras(annotations: Sequence[Annotation], names: Sequence[str]) -> tuple[tuple[Annotation, ...], list[str]]:
    """The annotations, without the cameras that a page does not list; and the names of those."""
    missing = sorted({annotation.camera for annotation in annotations} - {*names, ""})
    kept = tuple(Annotation(a.text, a.position, "" if a.camera in missing else a.camera) for a in annotations)
    return kept, missing
