"""Somebody's capture to cameras, points and a box in the scene."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.data.dataset import Dataset, DatasetOptions, View
from ..core.data.load import read_dataset
from ..core.geometry.camera import Camera
from ..snerg_addon.activity import Thought, Work
from ..snerg_addon.bridge import add_background, add_box, add_points, set_camera, set_picture
from ..snerg_addon.owner import shown
from ..snerg_addon.project import Project
from .import_verb import ImportVerb

SHOWN = 0.05  # a camera's size in the viewport, as a part of how far it stands from the middle
TITLES = {"train": "Training Views", "val": "Held-Out Views", "test": "Test Views"}


class SNERG_OT_import_dataset(ImportVerb, bpy.types.Operator):
    """Open photographs with their cameras (transforms.json, LLFF or COLMAP): each camera with its picture behind it, and the box"""

    bl_idname = "snerg.import_dataset"
    bl_label = "Import Dataset"
    bl_options = {"REGISTER", "UNDO"}
    step, label = "dataset", "Importing the dataset"
    key, what = "dataset", "dataset"
    accepted = "*.json;poses_bounds.npy"  # a COLMAP model is a folder

    def start(self, context: bpy.types.Context, project: Project) -> Work:
        """Read in a thread; the scene is touched only at the end, all at once, so that one undo takes it back."""
        path, settings = self.path(), context.scene.snerg
        options = DatasetOptions(settings.test_every, settings.downscale)
        return Thought(lambda progress: {"path": path, "parts": read_splits(path, options, progress)})

    def finish(self, scene: bpy.types.Scene, project: Project, result: dict[str, Any]) -> str:
        """Put it into the scene, and make it the dataset to train on."""
        parts: list[Dataset] = result["parts"]
        add_dataset(parts, scene, result["path"].stem)
        scene.snerg.dataset = shown(result["path"])
        views = " and ".join(f"{len(part.views)} {TITLES.get(part.split, part.split).lower()}" for part in parts)
        return " ".join([f"Imported {views} from {result['path']}.", *shortcomings([v.camera for p in parts for v in p.views])])


def read_splits(path: Path, options: DatasetOptions, progress: Callable[[float, str], None]) -> list[Dataset]:
    """Every split of a dataset, the training views first. Raises SnergError when one cannot be read."""
    progress(0.0, "Reading the training views")
    parts = [read_dataset(path, "train", options)]
    names = [name for name in parts[0].splits() if name != "train"]
    for index, name in enumerate(names):
        progress((index + 1) / (len(names) + 1), f"Reading the {TITLES.get(name, name).lower()}")
        parts.append(read_dataset(path, name, options))
    return parts


def add_dataset(parts: list[Dataset], scene: bpy.types.Scene, name: str) -> None:
    """A collection with the cameras of each split, and the points; the box; the scene takes the commonest picture's size."""
    first, top = parts[0], bpy.data.collections.new(name)
    scene.collection.children.link(top)
    set_picture(scene, commonest([view.camera for part in parts for view in part.views]))
    box = first.suggested_box()
    middle = box.box_to_world[:3, 3]
    for part in parts:
        group = bpy.data.collections.new(TITLES.get(part.split, part.split))
        top.children.link(group)
        cameras = [add_view(view, group, scene, middle) for view in part.views]
        if part is first:
            scene.camera = cameras[0]
    if first.points is not None and len(first.points):
        add_points("Points", first.points, first.colours, top)
    add_box(box, scene)


def add_view(view: View, collection: bpy.types.Collection, scene: bpy.types.Scene, middle: np.ndarray) -> bpy.types.Object:
    """A camera with its picture behind it."""
    name = Path(view.camera.name).stem or view.image.stem
    data = bpy.data.cameras.new(name)
    camera = bpy.data.objects.new(name, data)
    collection.objects.link(camera)
    set_camera(camera, view.camera)
    add_background(camera, view.image, scene, (view.camera.width, view.camera.height))
    data.display_size = max(SHOWN * float(np.linalg.norm(view.camera.position - middle)), 1e-4)
    return camera


def commonest(cameras: list[Camera]) -> Camera:
    """The first camera of the picture size that most have."""
    sizes = Counter((camera.width, camera.height) for camera in cameras)
    size = sizes.most_common(1)[0][0]
    return next(camera for camera in cameras if (camera.width, camera.height) == size)


def shortcomings(cameras: list[Camera]) -> list[str]:
    """What Blender cannot show of these cameras, in sentences."""
    told = []
    bent = sum(camera.distortion is not None for camera in cameras)
    if bent:
        told.append(
            f"{bent} have a lens with distortion, which a Blender camera cannot show: towards the edges, pictures and scene do not meet; "
            "training and evaluation go by the lens."
        )
    usual = commonest(cameras)
    others = sum((camera.width, camera.height) != (usual.width, usual.height) for camera in cameras)
    if others:
        told.append(f"{others} have another picture size than the scene's, {usual.width} x {usual.height}.")
    return told
