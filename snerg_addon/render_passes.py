"""Passes of a rendered dataset besides the picture: depth, normals, and the light on diffuse and on glossy surfaces.

Depth and normals are of the surface behind the centre of each pixel: a second render with one sample there, since the picture's samples
lie anywhere in the pixel. Light is of the picture's own samples. All are OpenEXR, read back from Blender's render result.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..core.data.depth import FARTHEST
from ..core.data.depth import PASSES as PASS_KEYS
from ..core.errors import SnergError
from ..core.io.exr import has_openimageio, read_channels, write_channels

PASSES = ("depth", *PASS_KEYS)
ENGINES = ("CYCLES", "BLENDER_EEVEE", "BLENDER_EEVEE_NEXT")  # that give all of them
SURFACE = ("depth", "normal")  # of the pixel's centre
LAYER_PASSES = {  # of a view layer, that a pass is made from
    "depth": ("z",),
    "normal": ("z", "normal"),
    "diffuse": ("diffuse_direct", "diffuse_indirect", "diffuse_color", "emit"),
    "glossy": ("glossy_direct", "glossy_indirect", "glossy_color"),
}
SHORT_NAMES = {  # of passes in OpenEXR files up to Blender 4.5
    "Diffuse Direct": "DiffDir", "Diffuse Indirect": "DiffInd", "Diffuse Color": "DiffCol", "Emission": "Emit",
    "Glossy Direct": "GlossDir", "Glossy Indirect": "GlossInd", "Glossy Color": "GlossCol",
}  # fmt: skip
FILE_SETTINGS = ("media_type", "file_format", "color_mode", "color_depth", "exr_codec", "use_exr_interleave")  # media_type changes others
CENTRE_WIDTH = 0.01  # pixels: the narrowest filter, so that the sample lies in the pixel's centre
MEANINGS = {
    "depth": "distance along the camera's axis in scene units, 0 where there is no surface",
    "normal": "unit vectors in the scene's axes, 0 where there is no surface",
    "diffuse": "linear premultiplied light: diffuse (direct + indirect) * colour + emission",
    "glossy": "linear premultiplied light: glossy (direct + indirect) * colour",
}  # as recorded in the dataset


def check_passes(passes: Sequence[str]) -> None:
    """Raise SnergError where passes are chosen that cannot be written."""
    unknown = [name for name in passes if name not in PASSES]
    if unknown:
        raise SnergError(f"There is no pass {unknown[0]!r} to render; choose from {', '.join(PASSES)}.")
    if passes and not has_openimageio():
        raise SnergError("Depth and light passes need OpenImageIO, which this Blender lacks; turn them off, or use Blender of blender.org.")


def pass_files(part: Path, split: str, passes: Sequence[str]) -> dict[str, Path]:
    """The file of each pass of a view, by the pass's name. split: the view's path in the dataset, without suffix."""
    return {name: part / name / f"{split}.exr" for name in passes}


def frame_extra(split: str, passes: Sequence[str]) -> dict[str, str]:
    """The keys of a view's frame that name its passes."""
    return {PASS_KEYS.get(name, "depth_file_path"): f"./{name}/{split}.exr" for name in passes}


def file_extra(passes: Sequence[str]) -> dict[str, Any]:
    """The keys of a transforms file that say what its passes hold. depth_unit_scale_factor is nerfstudio's: scene units a stored unit."""
    units = {"depth_unit_scale_factor": 1.0, "is_euclidean_depth": False} if "depth" in passes else {}
    return {**units, "snerg_passes": {name: MEANINGS[name] for name in passes}} if passes else {}


def enable_light(scene: bpy.types.Scene, passes: Sequence[str]) -> None:
    """Let the picture's render keep the light passes that are among `passes`. scene: a copy that may be changed."""
    _enable(scene, [name for name in passes if name not in SURFACE])


def write_passes(scene: bpy.types.Scene, files: Mapping[str, Path], render: Callable[[], object]) -> None:
    """Write the passes of the view that was just rendered from `scene`, a copy that may be changed.

    files: of `pass_files`. render: renders the scene again, without a file. Raises SnergError where a pass cannot be written, and
    RuntimeError where Blender cannot render.
    """
    light = {name: path for name, path in files.items() if name not in SURFACE}
    if light:
        channels = _rendered(scene)
        for name, path in light.items():
            _write_light(channels, name, path)
    surface = {name: path for name, path in files.items() if name in SURFACE}
    if surface:
        with _centre_samples(scene):
            _enable(scene, list(surface))
            render()
            channels = _rendered(scene)
        _write_surface(channels, surface)


def _enable(scene: bpy.types.Scene, passes: Sequence[str]) -> None:
    for layer in scene.view_layers:
        for name in passes:
            for part in LAYER_PASSES[name]:
                setattr(layer, f"use_pass_{part}", True)


@contextmanager
def _centre_samples(scene: bpy.types.Scene) -> Iterator[None]:
    """The scene with one sample a pixel, in its centre."""
    wanted: list[tuple[Any, str, Any]] = [(scene.render, "filter_size", CENTRE_WIDTH)]
    if scene.render.engine == "CYCLES":
        one = {
            "samples": 1,
            "use_adaptive_sampling": False,
            "use_denoising": False,
            "use_sample_subset": False,  # Cycles keeps depth at sample 0 alone, which a subset may lack
            "sample_offset": 0,
            "pixel_filter_type": "BOX",
            "filter_width": CENTRE_WIDTH,
        }
        wanted += [(scene.cycles, name, value) for name, value in one.items() if hasattr(scene.cycles, name)]
    elif hasattr(scene, "eevee"):
        wanted.append((scene.eevee, "taa_render_samples", 1))
    before = [(thing, name, getattr(thing, name)) for thing, name, _ in wanted]
    try:
        for thing, name, value in wanted:
            setattr(thing, name, value)
        yield
    finally:
        for thing, name, value in before:
            setattr(thing, name, value)


def _rendered(scene: bpy.types.Scene) -> dict[str, np.ndarray]:
    """The channels of the first view layer of Blender's render result, float32 [H, W], by name."""
    image = scene.render.image_settings
    result = next((image for image in bpy.data.images if image.type == "RENDER_RESULT"), None)  # an artist's image may have its name
    if result is None:
        raise SnergError("Blender keeps no render result to take depth from; turn the passes off.")
    before = [(name, getattr(image, name)) for name in FILE_SETTINGS if hasattr(image, name)]
    try:
        with tempfile.TemporaryDirectory(prefix="snerg-") as room:  # the project's path may hold braces, which Blender fills in
            if hasattr(image, "media_type"):
                image.media_type = "MULTI_LAYER_IMAGE"
            image.file_format = "OPEN_EXR_MULTILAYER"
            image.color_depth, image.exr_codec = "32", "NONE"
            if hasattr(image, "use_exr_interleave"):
                image.use_exr_interleave = True  # one part: Blender 5.0 cannot write several with a pixel aspect other than 1
            result.save_render(str(Path(room) / "layers.exr"), scene=scene)
            channels = read_channels(Path(room) / "layers.exr")
    except RuntimeError as error:
        raise SnergError(f"Blender could not write its passes ({str(error).strip()}); see whether the disk is full.") from error
    finally:
        for name, value in before:
            setattr(image, name, value)
    layer = next((layer.name for layer in scene.view_layers if layer.use), scene.view_layers[0].name)
    return {name.removeprefix(f"{layer}."): values for name, values in channels.items() if name.startswith(f"{layer}.")}


def _write_surface(channels: dict[str, np.ndarray], files: Mapping[str, Path]) -> None:
    depth = channels.get("Depth.Z", channels.get("Depth.V"))
    if depth is None:
        raise SnergError("The render engine gives no depth; render with Cycles or EEVEE, or turn depth and normals off.")
    there = np.isfinite(depth) & (depth > 0) & (depth < FARTHEST) & (channels["Combined.A"] > 0)
    if "depth" in files:
        write_channels(files["depth"], {"Y": np.where(there, depth, 0)})  # Y: the one channel that OpenCV reads as well
    if "normal" in files:
        parts = [channels[f"Normal.{axis}"] for axis in "XYZ" if f"Normal.{axis}" in channels]
        if len(parts) < 3:
            raise SnergError("The render engine gives no normals; render with Cycles or EEVEE, or turn normals off.")
        normal = np.stack(parts, axis=-1)
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = np.where(there[..., None] & (length > 0), normal / np.where(length > 0, length, 1), 0)
        write_channels(files["normal"], {name: normal[..., index] for index, name in enumerate("RGB")}, half=True)


def _write_light(channels: dict[str, np.ndarray], name: str, path: Path) -> None:
    """(direct + indirect) * colour of diffuse or glossy surfaces, with emission on diffuse ones, and the picture's alpha."""
    kind = name.capitalize()
    direct, indirect, colour = (_colour(channels, f"{kind} {part}") for part in ("Direct", "Indirect", "Color"))
    if direct is None or colour is None:
        raise SnergError(f"The render engine gives no {name} light; render with Cycles or EEVEE, or turn light passes off.")
    light = (direct + (0 if indirect is None else indirect)) * colour  # EEVEE has no indirect light of its own
    emission = _colour(channels, "Emission") if name == "diffuse" else None
    light = np.nan_to_num(light + (0 if emission is None else emission), posinf=0, neginf=0)
    written = {part: np.clip(light[..., index], 0, np.finfo(np.float16).max) for index, part in enumerate("RGB")}
    write_channels(path, {**written, "A": channels["Combined.A"]}, half=True)


def _colour(channels: dict[str, np.ndarray], name: str) -> np.ndarray | None:
    """A pass of colours [H, W, 3]; None where the engine has none."""
    for known in (name, SHORT_NAMES.get(name, name)):
        parts = [channels[f"{known}.{part}"] for part in "RGB" if f"{known}.{part}" in channels]
        if len(parts) == 3:
            return np.stack(parts, axis=-1)
    return None
