"""A coarse bake of a training's field so far, which Blender shows while the training runs."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..baking.bake import BakeSettings, bake
from ..errors import Cancelled, SnergError
from ..export.scene_files import write_scene
from ..io.files import discard
from ..progress import Note, Progress

if TYPE_CHECKING:
    from ..nerf.field import Field

FOLDER = "preview"  # within the training's folder
SETTINGS = BakeSettings(resolution=128, supersampling=1, visibility=False)
MOST_SECONDS = 8.0  # of a bake; one that takes longer is given up, and the next has half the resolution
LEAST_RESOLUTION = 32


class TooSlowError(SnergError):
    """A preview took more than MOST_SECONDS."""


class TrainingPreview:
    """Bakes fields one after the other into the scene folder `folder`; each takes the place of the one before.

    A field that cannot be baked ends the previews and not the training: a note to `progress` says why.
    """

    def __init__(self, folder: Path, progress: Progress) -> None:
        self._folder, self._progress = folder, progress
        self._settings: BakeSettings | None = SETTINGS  # None: no more previews

    def __call__(self, field: Field, fraction: float) -> None:
        """Bake a field. fraction: of the training that is done. Raises Cancelled where `progress` does."""
        if self._settings is None:
            return
        try:
            if field.ndc is not None:
                raise SnergError("the scene is forward-facing, and Blender's viewport shows no such scene.")
            self._bake(field, self._settings, fraction)
        except Cancelled:
            raise
        except TooSlowError as error:
            self._settings = replace(self._settings, resolution=self._settings.resolution // 2)
            if self._settings.resolution < LEAST_RESOLUTION:
                self._give_up(error, fraction)
        except (SnergError, MemoryError) as error:
            self._give_up(error, fraction)

    def _bake(self, field: Field, settings: BakeSettings, fraction: float) -> None:
        end = time.perf_counter() + MOST_SECONDS

        def tell(_fraction: float, _text: str, /) -> None:
            self._progress(fraction, "Baking a preview")
            if time.perf_counter() > end:
                raise TooSlowError(f"baking one takes longer than {MOST_SECONDS:.0f} s.")

        write_scene(bake(field, field.domain.world_box(), (), settings, tell), self._folder)

    def _give_up(self, error: BaseException, fraction: float) -> None:
        self._settings = None
        self._progress(fraction, Note(f"No preview while training: {str(error) or 'there is not enough memory.'}"))


@contextmanager
def training_preview(training: Path, wanted: bool, progress: Progress) -> Iterator[TrainingPreview | None]:
    """A preview within the folder of a training, where one is wanted. It is deleted at the end; what a killed training left is deleted in
    any case."""
    folder = training / FOLDER
    discard(folder)
    try:
        yield TrainingPreview(folder, progress) if wanted else None
    finally:
        discard(folder)
