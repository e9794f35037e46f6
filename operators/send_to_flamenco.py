"""Send frames, bakes or a study to a Flamenco render farm."""

from __future__ import annotations

import contextlib
import re
import shlex
import time
import zlib
from pathlib import Path
from typing import Any

import bpy

from ..core.errors import SnergError
from ..core.io.files import write_bytes
from ..core.jobs.task import Task, ThreadTask
from ..snerg_addon import flamenco
from ..snerg_addon.preferences import flamenco_url
from ..snerg_addon.project import Project
from ..snerg_addon.scene_object import snerg_objects
from .bake import box_to_bake, finishing_arguments
from .farm_frames import frame_numbers
from .study import study_folder, study_options, target_options
from .task_operator import MISSING, TaskOperator

WORKS = (
    ("FRAMES", "Frames", "Render frames with the SNeRG engine, from a copy of the file as it is now"),
    ("BAKES", "Bakes", "Bake the field at several resolutions, each into a version of its own"),
    ("STUDY", "Study", "Measure the study of the Study panel in parts, then write its report"),
)


class SNERG_OT_send_to_flamenco(TaskOperator, bpy.types.Operator):
    """Send frames, bakes or a study to a Flamenco render farm, whose workers see the .blend file and its project at the same paths"""

    bl_idname = "snerg.send_to_flamenco"
    bl_label = "Send to Flamenco"
    bl_options = {"REGISTER"}
    step, label = "farm", "Sending to Flamenco"

    work: bpy.props.EnumProperty(name="Work", description="What the farm does", items=WORKS)  # type: ignore[valid-type]
    frames: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Frames", description="Frames to render, such as 1-30 or 3,5-10. Empty: the scene's range"
    )
    chunk_size: bpy.props.IntProperty(name="Frames a Task", description="Frames that one task renders", default=5, min=1)  # type: ignore[valid-type]
    video: bpy.props.BoolProperty(name="Video", description="Make a video of the frames at the end", default=True)  # type: ignore[valid-type]
    resolutions: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Resolutions", description="Voxels along the longest side, one number a bake, such as 128, 256. Empty: the Bake panel's"
    )
    parts: bpy.props.IntProperty(name="Parts", description="Tasks that measure the study", default=4, min=1, soft_max=64)  # type: ignore[valid-type]
    in_window = False  # whether the artist was asked in a dialog

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for the settings in a dialog; without a window, send the job and wait."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        self.in_window = True
        return set(context.window_manager.invoke_props_dialog(self, confirm_text="Send"))

    def draw(self, context: bpy.types.Context) -> None:
        """The settings of the work that is chosen."""
        self.layout.use_property_split = True
        self.layout.prop(self, "work")
        for name in {"FRAMES": ("frames", "chunk_size", "video"), "BAKES": ("resolutions",), "STUDY": ("parts",)}[self.work]:
            self.layout.prop(self, name, placeholder=placeholder(context.scene, name)) if name in ASKED else self.layout.prop(self, name)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Send the job: in the background after the dialog, else wait for the Manager's answer."""
        return TaskOperator.invoke(self, context, None) if self.in_window else TaskOperator.execute(self, context)

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """A thread that sends the job."""
        url = flamenco_url()
        if not url:
            raise SnergError("No Flamenco Manager is named; give its URL in the add-on's preferences.")
        flamenco.check_url(url)
        makers = {"FRAMES": frames_job, "BAKES": bakes_job, "STUDY": study_job}
        name, settings, made = makers[self.work](self, context, project)

        def send(_progress: Any) -> dict[str, Any]:
            try:
                return flamenco.submit(url, name, settings)
            except BaseException:
                for path in made:
                    with contextlib.suppress(OSError):
                        path.rmdir() if path.is_dir() else path.unlink()
                raise

        return ThreadTask(send, "Waiting for the Manager")

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Say where the job is. Warns of paths that the workers may not see."""
        if outside := result.get("outside"):
            self.report({"WARNING"}, f"{', '.join(outside)} lies outside of the farm's shared storage, {result['storage']}")
        return f"Sent {result['name']!r} to the farm; see {result['url']}"


ASKED = ("frames", "resolutions")


def placeholder(scene: bpy.types.Scene, name: str) -> str:
    """What an empty setting stands for."""
    return f"{scene.frame_start}-{scene.frame_end}" if name == "frames" else str(scene.snerg.resolution)


def frames_job(operator: Any, context: bpy.types.Context, project: Project) -> tuple[str, dict[str, Any], list[Path]]:
    """The name and the settings of a job of frames, and the copy of the file that it renders. Raises SnergError where it has none."""
    scene, render = context.scene, context.scene.render
    if not bpy.data.filepath:
        raise SnergError("The file was never saved, so that its paths lead nowhere on the farm; save it first.")
    if next(snerg_objects(scene), None) is None:
        raise SnergError("The scene has no SNeRG object, so that the farm would render nothing; bake or add a scene.")
    if render.is_movie_format:
        raise SnergError("The farm renders images, and the scene's file format is a video; choose an image format in Output.")
    frames = operator.frames.strip() or f"{scene.frame_start}-{scene.frame_end}"
    try:
        frame_numbers(frames)
    except ValueError as error:
        raise SnergError(f"{error}; give frames such as 1-30 or 3,5-10.") from error
    path = Path(bpy.path.abspath(render.filepath)).absolute()
    copy = file_copy(project)
    settings = {
        "work": "frames",
        "frames": frames,
        "chunk_size": operator.chunk_size,
        "blendfile": str(copy),
        "scene": scene.name,
        "render_output": str((path if render.filepath.endswith(("/", "\\")) else path.parent) / "{timestamp}" / "######"),
        "video": operator.video,
        "fps": render.fps / render.fps_base,
        "image_file_extension": render.file_extension,
    }
    return f"{Path(bpy.data.filepath).stem}: frames {frames}", settings, [copy]


def file_copy(project: Project) -> Path:
    """A copy of the file as it is now, in the project: tasks that start later render the same.

    Raises SnergError where it cannot be saved.
    """
    path = project.folder / "farm" / f"{Path(bpy.data.filepath).stem}-{time.strftime('%Y%m%d-%H%M%S')}.blend"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.save_as_mainfile(filepath=str(path), copy=True, check_existing=False)
    except (OSError, RuntimeError) as error:
        raise SnergError(f"Cannot write {path} ({str(error).strip()}); choose a project folder that you can write to.") from error
    return path


def bakes_job(operator: Any, context: bpy.types.Context, project: Project) -> tuple[str, dict[str, Any], list[Path]]:
    """The name and the settings of a job of bakes, and the folders of the new versions."""
    need_field(project)
    text = operator.resolutions.strip() or str(context.scene.snerg.resolution)
    words = [word for word in re.split(r"[\s,;]+", text) if word]
    if not all(word.isdecimal() and int(word) > 1 for word in words):
        raise SnergError(f"{text!r} are no resolutions; give numbers of voxels, such as 128, 256.")
    settings = {"work": "bakes", "field": str(project.field), "box": kept_box(context, project), "options": bake_options(context)}
    made = [project.new_version("scene") for _ in words]
    for folder, resolution in zip(made, words, strict=True):
        project.note_settings(folder, ["--resolution", resolution, *shlex.split(settings["options"])])
    bakes = ", ".join(f"{folder.name}={resolution}" for folder, resolution in zip(made, words, strict=True))
    return f"{project.folder.name}: bakes {', '.join(words)}", {**settings, "out": str(made[0].parent), "bakes": bakes}, made


def study_job(operator: Any, context: bpy.types.Context, project: Project) -> tuple[str, dict[str, Any], list[Path]]:
    """The name and the settings of a job of a study."""
    need_field(project)
    folder, box = study_folder(context, project)
    settings = {"work": "study", "field": str(project.field), "out": str(folder), "box": str(box or ""), "parts": operator.parts}
    settings |= {"options": shlex.join(study_options(context)), "report_options": shlex.join(target_options(context))}
    return f"{project.folder.name}: study", settings, []


def need_field(project: Project) -> None:
    """Raise SnergError where the project has no field."""
    if not project.has("field"):
        raise SnergError(f"{MISSING['field']}.")


def kept_box(context: bpy.types.Context, project: Project) -> str:
    """The file of the current box, which later changes of the box leave as it is; '' where the whole domain is baked."""
    box = box_to_bake(context, project)
    if box is None:
        return ""
    path = project.folder / "boxes" / f"{zlib.crc32(box):08x}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, box)
    return str(path)


def bake_options(context: bpy.types.Context) -> str:
    """The command-line options for the Bake panel's settings, apart from resolution and box."""
    settings = context.scene.snerg
    return " ".join([f"--samples {settings.samples}", *finishing_arguments(settings)])
