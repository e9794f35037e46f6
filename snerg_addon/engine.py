"""The render engine SNeRG: F12, animations and background renders of SNeRG objects, by the marcher that `snerg render` uses."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from dataclasses import dataclass, replace

import bpy
import numpy as np

from ..core.errors import Cancelled, SnergError
from ..core.geometry.camera import Camera
from ..core.io.images import linear_to_srgb, srgb_to_linear
from ..core.nerf.frame import Frame
from ..core.progress import Progress
from ..core.rendering.render import render_scene
from ..core.scene.scene import Scene
from .bridge import camera_from_blender, resolution
from .render_evaluation import hand_over
from .scene_object import is_snerg_object, placed_camera, snerg_objects, source_of
from .viewport.loading import cached

COVERAGE = "Coverage"  # alpha, which Combined has only with a transparent film; a pass 'Alpha' would displace the compositor's own Alpha
OBJECT_INDEX = "Object Index" if bpy.app.version >= (5, 0) else "IndexOB"  # Blender's own name for the pass
BAND = 64  # rows of pixels that are rendered, and shown, together
SURFACE = 0.5  # the alpha above which an object is a surface, which has an object index
NO_DEPTH = 1e10  # what Blender's depth pass has where nothing is
PASSES = {
    "Combined": ("RGBA", "COLOR", ""),
    COVERAGE: ("X", "VALUE", ""),
    "Depth": ("Z", "VALUE", "use_pass_z"),
    OBJECT_INDEX: ("X", "VALUE", "use_pass_object_index"),
}
"""The engine's passes: their channels, their kind, and the view layer's setting that asks for them; '': always there."""


@dataclass(frozen=True)
class Placed:
    """An object of a frame: its scene, the camera as it stands to that, its scale, its pass index, and whether it is a holdout, which cuts
    a hole into what is behind it."""

    scene: Scene
    camera: Camera
    scale: float
    index: int
    holdout: bool = False


class SNERG_RE_engine(bpy.types.RenderEngine):
    """Renders the baked scenes of SNeRG objects, and nothing else."""

    bl_idname = "SNERG"
    bl_label = "SNeRG"
    bl_use_preview = False
    bl_use_gpu_context = False
    bl_use_eevee_viewport = True  # Material Preview shows the meshes, by EEVEE

    def update_render_passes(self, scene: bpy.types.Scene | None = None, renderlayer: bpy.types.ViewLayer | None = None) -> None:
        """The passes that a view layer asks for, by which the compositor knows them."""
        for name, (channels, kind, wanted) in PASSES.items():
            if not wanted or getattr(renderlayer, wanted, False):
                self.register_pass(scene, renderlayer, name, len(channels), channels, kind)

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """One view layer of one frame."""
        if hand_over(depsgraph, self.frame_set):
            return
        try:
            self._render(depsgraph)
        except Cancelled:
            pass
        except SnergError as error:
            self.report({"ERROR"}, str(error))
        except Exception as error:
            traceback.print_exception(error)
            self.report({"ERROR"}, f"The render went wrong ({type(error).__name__}: {error}); Blender's console says where.")

    def _render(self, depsgraph: bpy.types.Depsgraph) -> None:
        scene = self._rendered_as(depsgraph.scene_eval)
        if scene.camera is None:
            raise SnergError(f"The scene {scene.name!r} has no camera; add one, or choose one in the scene's properties.")
        camera = bordered(camera_from_blender(scene.camera, scene, depsgraph), scene.render)
        things = list(placed(depsgraph, camera))
        background = None if depsgraph.scene_eval.render.film_transparent else world_colour(scene)
        for top in range(0, camera.height, BAND):
            band = rows_of(camera, top, min(BAND, camera.height - top))
            tell = self._tell(top, camera.height)
            frames = [render_scene(thing.scene, rows_of(thing.camera, top, band.height), progress=tell) for thing in things]
            self._write(depsgraph.view_layer_eval.name, camera.height - top - band.height, merged(frames, things, band), background)
            self.update_progress((top + band.height) / camera.height)

    def _rendered_as(self, scene: bpy.types.Scene) -> bpy.types.Scene:
        """The scene whose camera and size apply: the one this is composited with, unless the size that is rendered is not its size."""
        first = scene.snerg.follows
        if first is None or resolution(first) != (self.resolution_x, self.resolution_y):
            return scene
        if missing := sorted({thing.name for thing in shown_in(first)} - {thing.name for thing in scene.objects}):
            self.report({"WARNING"}, f"Not composited, because added later: {', '.join(missing)}; use Composite with This Render again.")
        return first

    def _tell(self, top: int, height: int) -> Progress:
        def tell(fraction: float, text: str, /) -> None:
            if self.test_break():
                raise Cancelled("Stopped as you asked.")
            self.update_progress((top + fraction * BAND) / height)

        return tell

    def _write(self, layer: str, bottom: int, picture: Picture, background: np.ndarray | None) -> None:
        """A band of rows into the render result, whose first row is the lowest."""
        height, width = picture.alpha.shape
        result = self.begin_result(0, bottom, width, height, layer=layer)
        values = {"Combined": picture.linear(background), COVERAGE: picture.alpha, "Depth": picture.depth, OBJECT_INDEX: picture.index}
        for part in result.layers[0].passes:
            if part.name in values:
                part.rect.foreach_set(np.ascontiguousarray(values[part.name][::-1], np.float32).reshape(-1))
        self.end_result(result)

    def view_update(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Nothing: the viewport draws SNeRG objects in every mode (viewport/draw.py)."""

    def view_draw(self, context: bpy.types.Context, depsgraph: bpy.types.Depsgraph) -> None:
        """Nothing; see `view_update`."""


def shown_in(scene: bpy.types.Scene) -> Iterator[bpy.types.Object]:
    """The SNeRG objects of a scene that render."""
    return (thing for thing in snerg_objects(scene) if not thing.hide_render)


@dataclass(frozen=True, eq=False)
class Picture:
    """Rows of a frame: colour [H, W, 3] display-referred and premultiplied; [H, W]: alpha, what is left of the background (1 - alpha, less
    where a holdout is), depth along the view axis and pass index."""

    colour: np.ndarray
    alpha: np.ndarray
    behind: np.ndarray
    depth: np.ndarray
    index: np.ndarray

    def linear(self, background: np.ndarray | None) -> np.ndarray:
        """[H, W, 4] scene-linear and premultiplied, as Blender keeps it; over a display-referred colour [3] where there is one.

        Translucent colours are laid over the background as they are displayed, as the web page does it, and converted once.
        """
        shown, alpha = self.colour, self.alpha[..., None]
        if background is not None:
            shown, alpha = shown + self.behind[..., None] * background, alpha + self.behind[..., None]
        straight = np.clip(shown / np.maximum(alpha, 1e-6), 0, 1)
        return np.concatenate([srgb_to_linear(straight) * alpha, alpha], axis=-1)


def bordered(camera: Camera, render: bpy.types.RenderSettings) -> Camera:
    """The part of a camera's picture that the render border leaves."""
    if not render.use_border:
        return camera
    left, right = (int(edge * camera.width) for edge in (render.border_min_x, render.border_max_x))
    bottom, top = (int(edge * camera.height) for edge in (render.border_min_y, render.border_max_y))
    centre = camera.centre[0] - left, camera.centre[1] - (camera.height - top)
    return replace(camera, width=max(right - left, 1), height=max(top - bottom, 1), centre=centre)


def rows_of(camera: Camera, top: int, count: int) -> Camera:
    """`count` rows of a camera's picture, from row `top`."""
    return replace(camera, height=count, centre=(camera.centre[0], camera.centre[1] - top))


def placed(depsgraph: bpy.types.Depsgraph, camera: Camera) -> Iterator[Placed]:
    """What of SNeRG objects, instances too, is in a frame. Raises SnergError where one cannot be rendered."""
    layer = depsgraph.view_layer
    for instance in depsgraph.object_instances:
        thing = instance.object
        if not is_snerg_object(thing) or not instance.show_self or not thing.visible_camera:
            continue
        if thing.original.indirect_only_get(view_layer=layer):
            continue
        matrix = np.array(instance.matrix_world, np.float64)
        scene = cached(source_of(thing.original))
        moved, scale = placed_camera(thing.name, scene, matrix, camera)
        holdout = thing.is_holdout or thing.original.holdout_get(view_layer=layer)
        yield Placed(scene, moved, scale, thing.pass_index, holdout)


def merged(frames: list[Frame], things: list[Placed], camera: Camera) -> Picture:
    """The objects' frames over each other, at each pixel the nearest first. The object index is that of the nearest surface, which has an
    alpha above SURFACE; depth is the mean of all that is seen."""
    shape = camera.height, camera.width
    if not frames:
        return Picture(np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape), np.full(shape, NO_DEPTH), np.zeros(shape))
    depths = np.stack([frame.depth * thing.scale for frame, thing in zip(frames, things, strict=True)])
    order = np.argsort(depths, axis=0, kind="stable")

    def sorted_(values: list[np.ndarray]) -> np.ndarray:
        stacked = np.stack(values)
        rows = order.reshape(*order.shape, *(1,) * (stacked.ndim - order.ndim))
        return np.take_along_axis(stacked, rows, axis=0)

    colours, alphas = sorted_([frame.colour for frame in frames]), sorted_([frame.alpha for frame in frames])
    indices = sorted_([np.full(shape, thing.index) for thing in things])
    seen = sorted_([np.full(shape, not thing.holdout) for thing in things])
    depths = np.take_along_axis(depths, order, axis=0)
    colour, alpha, transmittance = np.zeros((*shape, 3)), np.zeros(shape), np.ones(shape)
    depth, weight = np.zeros(shape), np.zeros(shape)
    for each in range(len(frames)):
        part = transmittance * alphas[each]
        colour += np.where(seen[each], transmittance, 0)[..., None] * colours[each]
        alpha += np.where(seen[each], part, 0)
        depth += np.where(part > 0, part * np.where(np.isfinite(depths[each]), depths[each], 0), 0)
        weight += part
        transmittance = transmittance * (1 - alphas[each])
    mean = np.where(weight > 0, depth / np.maximum(weight, 1e-6) * axis_cosines(camera), NO_DEPTH)
    surface = alphas > SURFACE
    index = np.where(surface.any(axis=0), np.take_along_axis(indices, surface.argmax(axis=0)[None], axis=0)[0], 0)
    return Picture(colour, alpha, transmittance, mean, index)


def axis_cosines(camera: Camera) -> np.ndarray:
    """[H, W]: what a length along a pixel's ray is along the view axis."""
    _, directions = camera.rays()
    return camera.cosines(directions).reshape(camera.height, camera.width)


def world_colour(scene: bpy.types.Scene) -> np.ndarray:
    """What stands behind everything, display-referred [3]: the world's colour, black where there is none."""
    return linear_to_srgb(np.clip(np.array(scene.world.color if scene.world else (0, 0, 0), np.float64), 0, 1))


def panels() -> list[type[bpy.types.Panel]]:
    """Blender's own panels that its simple engines have: size, border, output, lens, colour management and passes."""
    return [panel for panel in bpy.types.Panel.__subclasses__() if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ())]


def add_panels() -> None:
    """Show those panels with this engine too."""
    for panel in panels():
        panel.COMPAT_ENGINES.add(SNERG_RE_engine.bl_idname)


def remove_panels() -> None:
    """Undo `add_panels`."""
    for panel in panels():
        panel.COMPAT_ENGINES.discard(SNERG_RE_engine.bl_idname)
