"""The frames of a task of a render farm (farm/snerg.js)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import bpy


class SNERG_OT_farm_frames(bpy.types.Operator):
    """Before a task renders: keep the frames that are there whole, and delete those that a killed task left half written"""

    bl_idname = "snerg.farm_frames"
    bl_label = "Frames of a Farm"
    bl_options = {"INTERNAL"}

    frames: bpy.props.StringProperty(description="The frames, such as 1-5,8")  # type: ignore[valid-type]
    check: bpy.props.BoolProperty(description="Fail where a frame is missing or damaged, and change nothing")  # type: ignore[valid-type]

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Sets the scene to skip frames that are there. An error ends Blender where it runs with --python-exit-code."""
        render = context.scene.render
        if render.is_movie_format:
            self.report({"ERROR"}, "A farm renders images, and the scene's file format is a video; choose an image format.")
            return {"CANCELLED"}
        paths = {frame: Path(render.frame_path(frame=frame)) for frame in frame_numbers(self.frames)}
        bad = {frame: path for frame, path in paths.items() if not is_whole(path)}
        if self.check:
            if bad:
                names = ", ".join(str(frame) for frame in sorted(bad))
                self.report(
                    {"ERROR"}, f"Frames are missing or damaged in {next(iter(bad.values())).parent}: {names}; run their tasks again."
                )
                return {"CANCELLED"}
            self.report({"INFO"}, f"All {len(paths)} frames are there")
            return {"FINISHED"}
        for path in bad.values():
            path.unlink(missing_ok=True)
        render.use_overwrite = render.use_placeholder = False
        return {"FINISHED"}


def frame_numbers(text: str) -> list[int]:
    """The frames of '1-5,8', in order. Raises ValueError on anything else."""
    found: set[int] = set()
    for part in text.split(","):
        ends = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", part)
        if ends is None:
            raise ValueError(f"{part!r} is no frame and no range of frames")
        found.update(range(int(ends[1]), int(ends[2] or ends[1]) + 1))
    return sorted(found)


def is_whole(path: Path) -> bool:
    """Whether a file is there and is an image that can be read to its end."""
    if not path.is_file():
        return False
    import OpenImageIO  # Blender brings it

    image: Any = OpenImageIO.ImageInput.open(str(path))  # None where it is no image, whatever its types say
    if image is None:
        OpenImageIO.geterror()  # else it is printed at the end
        return False
    try:
        return image.read_image() is not None and not image.has_error
    finally:
        image.geterror()
        image.close()
