"""A viewport's picture by the NumPy marcher, in a thread: coarse, then refined. For scenes that the graphics card does not march."""

from __future__ import annotations

import os
import threading
import traceback
from dataclasses import dataclass

import numpy as np

from ...core.errors import Cancelled, SnergError
from ...core.geometry.camera import Camera
from ...core.nerf.frame import Frame
from ...core.progress import Progress
from ...core.rendering.render import MarchSettings, render_scene
from ...core.scene.scene import Scene

REDUCTIONS = (8, 4, 2, 1)  # of the picture's width and height, one after the other
BATCH = 4096  # rays at a time: the window waits for the thread's steps, which are shorter than with the fastest batch
FARTHEST = 1e9  # world units: device coordinates reach to infinity, which no texture holds
_one = threading.Lock()  # held while a picture is marched: the marcher itself uses all cores but one


@dataclass(frozen=True, eq=False)
class View:
    """What is to be drawn. key: other bytes for another picture. camera: to the scene as it was baked, whose units are `scale` world
    units. shift: what is added to the depth along its view axis, in the scene's units."""

    key: bytes
    scene: Scene
    camera: Camera
    scale: float
    shift: float = 0.0


class SlowPicture:
    """The picture of the view that was last asked for, as far as it is marched. problem: why there is none, one sentence."""

    def __init__(self) -> None:
        self.problem = ""
        self._asked: View | None = None
        self._ready: tuple[np.ndarray, np.ndarray] | None = None
        self._thread: threading.Thread | None = None
        self._lock = threading.Lock()

    @property
    def done(self) -> bool:
        """Whether nothing more is to come."""
        return self._thread is None

    def ask(self, view: View) -> None:
        """March this view from now on; the same as the last: nothing new happens. The coarsest picture of the view before is finished, so
        that a view that never rests shows something too."""
        with self._lock:
            if self._asked is not None and self._asked.key == view.key:
                return
            self._asked, self.problem = view, ""
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Stop within tenths of a second."""
        with self._lock:
            self._asked = None

    def take(self) -> tuple[np.ndarray, np.ndarray] | None:
        """The best picture since the last call, None where there is none: premultiplied colour and alpha [H, W, 4], and depths [H, W]
        along the view axis in world units; the lowest row first, float32."""
        found, self._ready = self._ready, None
        return found

    def _run(self) -> None:
        while True:
            with _one:
                view = self._asked
                if view is not None:
                    self._refine(view)
            with self._lock:
                if self._asked is view:
                    self._thread = None
                    return

    def _refine(self, view: View) -> None:
        settings = MarchSettings(batch=BATCH, threads=max(1, (os.cpu_count() or 2) - 1))
        try:
            for reduction in REDUCTIONS:
                tell = self._tell(view, reduction)
                frame = render_scene(view.scene, reduced(view.camera, reduction), settings, tell)
                self._ready = as_textures(view, reduction, frame)
                tell(1.0, "")
        except Cancelled:
            pass
        except SnergError as error:
            self.problem = str(error)
        except Exception as error:  # said on the object, and in the console
            traceback.print_exception(error)
            self.problem = f"The processor cannot draw it ({type(error).__name__}: {error}); Blender's console says where."

    def _tell(self, view: View, reduction: int) -> Progress:
        def tell(fraction: float, _text: str, /) -> None:
            other = self._asked
            if other is None or (other is not view and (reduction != REDUCTIONS[0] or fraction >= 1)):
                raise Cancelled("Another view is asked for.")

        return tell


def reduced(camera: Camera, reduction: int) -> Camera:
    """The same view with fewer pixels."""
    return camera.resized(-(-camera.width // reduction), -(-camera.height // reduction))


def as_textures(view: View, reduction: int, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """A frame as `SlowPicture.take` returns it (in the thread: it takes tenths of a second). Depths of empty pixels are the farthest:
    textures interpolate, and infinity is none."""
    camera = reduced(view.camera, reduction)
    _, directions = camera.rays()
    cosines = camera.cosines(directions).reshape(camera.height, camera.width)
    depths = np.where(np.isfinite(frame.depth), frame.depth, 0) * cosines
    depths = np.where(np.isfinite(frame.depth), (depths + view.shift) * view.scale, depths.max(initial=0) * view.scale)
    colour = np.concatenate([frame.colour, frame.alpha[..., None]], axis=-1)
    return colour[::-1].astype(np.float32), np.clip(depths, -FARTHEST, FARTHEST)[::-1].astype(np.float32)
