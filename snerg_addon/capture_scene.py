"""The copy of a scene that a dataset is rendered from: its film, its look, its one view layer, and no keys on what is set."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import bpy

from ..core.data.dataset import DatasetOptions
from ..core.errors import SnergError
from .render_evaluation import evaluate_render, keep_layer, linked_copy

SET = ("render.", "view_settings.", "display_settings.", "frame_")
"""Where the settings begin that a dataset sets or records: keys and drivers there are removed from the copy."""


@dataclass(frozen=True)
class CaptureSettings:
    """What of a scene a dataset shows, and which of its views are for testing."""

    test_every: int = DatasetOptions.holdout  # every n-th view is held out for testing; 0 holds none out
    test_cameras: tuple[str, ...] = field(default=())  # full names of the cameras that are for testing, in place of `test_every`
    view_layer: str = ""  # its name; empty: the scene's first
    scene_look: bool = False  # the scene's view transform, look, exposure and gamma, in place of Standard without any
    passes: tuple[str, ...] = ("depth",)  # written beside the pictures (see render_passes)


@contextmanager
def capture_scene(scene: bpy.types.Scene, settings: CaptureSettings | None = None) -> Iterator[bpy.types.Scene]:
    """A linked copy of the scene with the settings for rendering datasets, deleted at the end.

    Film transparent, no dither, compositing, motion blur or border, one view layer, and the view transform Standard unless the settings
    keep the scene's own: each would change the colours or the alpha (hard cases 7, 8). The artist's own scene keeps its settings,
    whatever happens. Raises SnergError where the view layer or the view transform does not exist.
    """
    settings = settings or CaptureSettings()
    with linked_copy(scene) as copy, unkeyed(copy):
        render, image = copy.render, copy.render.image_settings
        keep_layer(copy, settings.view_layer)
        render.film_transparent = True
        render.use_border = render.use_multiview = render.use_stamp = False
        render.use_compositing = render.use_sequencer = render.use_motion_blur = False
        render.dither_intensity = 0.0
        render.use_file_extension, render.use_overwrite, render.use_placeholder = False, True, False
        if hasattr(image, "media_type"):
            image.media_type = "IMAGE"
        image.file_format, image.color_mode, image.color_depth = "PNG", "RGBA", "8"
        image.color_management = "FOLLOW_SCENE"
        image.compression = 50
        if settings.scene_look:
            _own_view(scene, copy)
        else:
            _standard_view(copy)
        yield copy


def layer_warning(scene: bpy.types.Scene, name: str) -> str:
    """A sentence about what other view layers would render; '' where the one that is rendered was chosen, or is the only one."""
    layers = [layer.name for layer in scene.view_layers if layer.use]
    first = scene.view_layers[0].name
    if name or len(layers) < 2:
        return ""
    others = ", ".join(repr(layer) for layer in layers if layer != first)
    return f"The dataset shows the view layer {first!r} and not {others}; choose another under View Layer."


@contextmanager
def unkeyed(copy: bpy.types.Scene) -> Iterator[None]:
    """Remove the keys and drivers that would undo what is set on a copied scene (see SET), from copies of its actions."""
    data, made = copy.animation_data, []
    if data is not None:
        for driver in [driver for driver in data.drivers if driver.data_path.startswith(SET)]:
            data.drivers.remove(driver)
        for owner in [data, *(strip for track in data.nla_tracks for strip in track.strips)]:
            if owner.action is not None:
                slot = getattr(owner, "action_slot_handle", None)
                owner.action = owner.action.copy()
                made.append(owner.action)
                if slot is not None and owner.action_slot_handle != slot:
                    owner.action_slot_handle = slot
                remove_curves(owner.action)
    try:
        yield
    finally:
        for action in made:
            bpy.data.actions.remove(action)


def remove_curves(action: bpy.types.Action) -> None:
    """Remove the curves of an action whose paths begin as SET says."""
    owners: list[Any] = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    for owner in owners:
        for curve in [curve for curve in owner.fcurves if curve.data_path.startswith(SET)]:
            owner.fcurves.remove(curve)


def _own_view(scene: bpy.types.Scene, copy: bpy.types.Scene) -> None:
    """Keep the scene's view, with the exposure and gamma of its frame: a dataset has one look."""
    if scene.animation_data is not None:
        view = copy.view_settings
        view.exposure, view.gamma = evaluate_render(
            scene, lambda depsgraph: (depsgraph.scene_eval.view_settings.exposure, depsgraph.scene_eval.view_settings.gamma)
        )


def _standard_view(scene: bpy.types.Scene) -> None:
    """Set the view transform Standard for sRGB. Raises SnergError where the colour configuration has none."""
    view = scene.view_settings
    try:
        scene.display_settings.display_device = "sRGB"
        view.view_transform = "Standard"
        view.look = "None"
    except TypeError as error:  # a custom OCIO configuration without these names
        raise SnergError(
            "The colour configuration has no view transform 'Standard' for sRGB; start Blender without the OCIO variable."
        ) from error
    view.exposure, view.gamma = 0.0, 1.0
    view.use_curve_mapping = False
    for name in ("use_white_balance", "use_hdr_view"):
        if hasattr(view, name):
            setattr(view, name, False)


def colour_settings(scene: bpy.types.Scene) -> dict[str, Any]:
    """The settings that decide a render's colours, as recorded in the dataset. JSON values."""
    view = scene.view_settings
    return {
        "engine": scene.render.engine,
        "blender": bpy.app.version_string,
        "view_layer": scene.view_layers[0].name,
        "display_device": scene.display_settings.display_device,
        "view_transform": view.view_transform,
        "look": view.look,
        "exposure": view.exposure,
        "gamma": view.gamma,
        "dither": scene.render.dither_intensity,
        "film_transparent": scene.render.film_transparent,
    }
