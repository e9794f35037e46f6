"""Import photographs with their cameras."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.data.dataset import Dataset, DatasetOptions, View
from ..core.data.load import read_dataset
from ..core.data.readers.camera_files import read_cameras
from ..core.data.readers.transforms import has_pictures
from ..core.geometry.camera import Camera
from ..core.io.images import quarter_turn
from ..core.io.json_files import read_edited_json
from ..core.jobs.task import Task, ThreadTask
from ..core.progress import Progress
from ..snerg_addon.bridge import add_background, add_box, add_points, set_camera, set_picture
from ..snerg_addon.dataset_notes import note_dataset
from ..snerg_addon.owner import blend_path
from ..snerg_addon.project import Project, project_of
from .import_operator import ImportOperator

DISPLAY_SIZE = 0.05  # size of a camera in the viewport, as a fraction of its distance from the box's centre
NOT_IN_BLENDER = (".avif", ".heic", ".heif", ".hif")  # suffixes of images that training reads and Blender does not
TITLES = {"train": "Training Views", "val": "Held-Out Views", "test": "Test Views"}


class SNERG_OT_import_dataset(ImportOperator, bpy.types.Operator):
    """Import photographs with their cameras: transforms.json, COLMAP, Metashape and others. Adds cameras, background images and a box"""

    bl_idname = "snerg.import_dataset"
    bl_label = "Import Dataset"
    bl_options = {"REGISTER"}
    step, label = "dataset", "Importing the dataset"
    kinds = ("dataset",)
    changes_file = True
    key, noun = "dataset", "dataset"
    accepted = "*.json;poses_bounds.npy;*.xml;*.csv;*.out"  # others, such as a COLMAP model, are folders

    def start(self, context: bpy.types.Context, project: Project) -> Task:
        """Read the dataset in a thread. Only `finish` changes the scene, so that one undo removes it all."""
        path, settings = self.path(), context.scene.snerg
        options = DatasetOptions(settings.test_every, settings.downscale)
        return ThreadTask(lambda progress: {"path": path, **read_splits(path, options, progress)})

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Add the cameras, the points and the box to the scene, and make the dataset the one to train on."""
        parts: list[Dataset] = result["parts"]
        bare: dict[str, tuple[Camera, ...]] = result["bare"]
        add_dataset(parts, bare, scene, result["path"].stem)
        scene.snerg.dataset = blend_path(result["path"])
        said = list(dict.fromkeys(remark for part in parts for remark in part.remarks()))
        project.note_remarks(project_of(scene).dataset, said)
        views = " and ".join(f"{len(part.views)} {TITLES.get(part.split, part.split).lower()}" for part in parts)
        note_dataset(project, result["path"], {part.split: len(part.views) for part in parts})
        alone = [f"{TITLES.get(split, split)} without pictures: {len(cameras)} cameras." for split, cameras in bare.items() if cameras]
        every = [view.camera for part in parts for view in part.views]
        unseen = unseen_images([view.image for part in parts for view in part.views])
        return " ".join([f"Imported {views} from {result['path']}.", *said, *alone, *limitations(every), *unseen])


def read_splits(path: Path, options: DatasetOptions, progress: Progress) -> dict[str, Any]:
    """{"parts": every split of a dataset, the training views first, "bare": the cameras of splits without any picture, by their names}.

    Raises SnergError where the training views, or another split that has pictures, cannot be read.
    """
    progress(0.0, "Reading the training views")
    parts, bare = [read_dataset(path, "train", options)], bare_splits(path)
    names = [name for name in parts[0].splits() if name != "train" and name not in bare]
    for index, name in enumerate(names):
        progress((index + 1) / (len(names) + 1), f"Reading the {TITLES.get(name, name).lower()}")
        parts.append(read_dataset(path, name, options))
    return {"parts": parts, "bare": bare}


def bare_splits(path: Path) -> dict[str, tuple[Camera, ...]]:
    """The cameras of each transforms_<split>.json of the folder `path`, but for training, that lists no picture which exists.

    BlenderNeRF, for one, writes test cameras without pictures. Raises SnergError where such cameras are damaged.
    """
    found = {}
    for file in sorted(path.glob("transforms_*.json")):
        split = file.stem.removeprefix("transforms_")
        if split != "train" and not has_pictures(file):
            found[split] = read_cameras(file) if read_edited_json(file)["frames"] else ()
    return found


def add_dataset(parts: list[Dataset], bare: dict[str, tuple[Camera, ...]], scene: bpy.types.Scene, name: str) -> None:
    """Add a collection with the cameras of each split and the points, and the box. The scene takes the most common resolution.

    bare: cameras of splits without pictures.
    """
    first, top = parts[0], bpy.data.collections.new(name)
    scene.collection.children.link(top)
    set_picture(scene, most_common([view.camera for part in parts for view in part.views]))
    box = first.suggested_box()
    middle = box.box_to_world[:3, 3]
    for part in parts:
        group = bpy.data.collections.new(TITLES.get(part.split, part.split))
        top.children.link(group)
        cameras = [add_view(view, group, scene, middle) for view in part.views]
        if part is first:
            scene.camera = cameras[0]
    for split, alone in bare.items():
        group = bpy.data.collections.new(TITLES.get(split, split))
        top.children.link(group)
        for camera in alone:
            add_camera(camera, camera.name, group, middle)
    if first.points is not None and len(first.points):
        add_points("Points", first.points, first.colours, top)
    add_box(box, scene)


def add_view(view: View, collection: bpy.types.Collection, scene: bpy.types.Scene, middle: np.ndarray) -> bpy.types.Object:
    """Add a camera with its image as the background. middle: the box's centre [3]."""
    camera = add_camera(view.camera, Path(view.camera.name).stem or view.image.stem, collection, middle)
    turn = quarter_turn(view.image) if view.upright else (0, False)
    add_background(camera, view.image, scene, (view.camera.width, view.camera.height), turn)
    return camera


def add_camera(source: Camera, name: str, collection: bpy.types.Collection, middle: np.ndarray) -> bpy.types.Object:
    """Add a camera with the pose and the projection of `source`. middle: the box's centre [3]."""
    data = bpy.data.cameras.new(name)
    camera = bpy.data.objects.new(name, data)
    collection.objects.link(camera)
    set_camera(camera, source)
    data.display_size = max(DISPLAY_SIZE * float(np.linalg.norm(source.position - middle)), 1e-4)
    return camera


def most_common(cameras: list[Camera]) -> Camera:
    """The first camera with the resolution that most cameras have."""
    sizes = Counter((camera.width, camera.height) for camera in cameras)
    size = sizes.most_common(1)[0][0]
    return next(camera for camera in cameras if (camera.width, camera.height) == size)


def unseen_images(images: list[Path]) -> list[str]:
    """A sentence about images that Blender cannot show as backgrounds; none where it shows all."""
    count = sum(image.suffix.lower() in NOT_IN_BLENDER for image in images)
    return [f"{count} images are AVIF or HEIC, which Blender does not show as backgrounds; training reads them."] if count else []


def limitations(cameras: list[Camera]) -> list[str]:
    """Sentences about what Blender cannot show of these cameras."""
    sentences = []
    wide = sum(camera.is_wide for camera in cameras)
    if wide:
        sentences.append(f"{wide} are panoramic, which only Cycles and SNeRG render; the viewport shows their view as a perspective one.")
    distorted = sum(camera.distortion is not None for camera in cameras)
    if distorted:
        sentences.append(
            f"{distorted} have a lens with distortion, which Blender cameras lack: images and scene do not line up at the edges; "
            "training and evaluation use the distortion."
        )
    common = most_common(cameras)
    others = sum((camera.width, camera.height) != (common.width, common.height) for camera in cameras)
    if others:
        sentences.append(f"{others} have another resolution than the scene's, {common.width} x {common.height}.")
    return sentences
