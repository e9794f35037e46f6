"""What is done to a baked scene on the training images: pruning, fitting its voxels, fine-tuning its network. Uses JAX, pruning apart."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

from ..data.dataset import Dataset
from ..errors import SnergError, needs_jax
from ..progress import Note, Progress, silent, within
from ..scene.scene import Scene
from .prune import prune

FINISHING_STAGES = ("prune", "fit", "refine")
WEIGHTS = {"prune": 1.0, "fit": 5.0, "refine": 1.0}  # of each stage in the progress, about its time


@dataclass(frozen=True)
class Finishing:
    """What is done to a bake on the training images. Raises SnergError for values out of range."""

    refine: bool = True  # fine-tune the network, where the voxels are not fitted: fitting moves both
    fit: bool = False  # fit the voxels
    prune: float = 0.0  # drop voxels with a smaller share of every training pixel, 0 to 1; 0: none

    def __post_init__(self) -> None:
        if not 0 <= self.prune < 1:
            raise SnergError(f"Voxels with a share of a pixel below {self.prune} cannot be dropped; choose 0, or a number below 1.")

    def stages(self, network: bool) -> tuple[str, ...]:
        """The names of the stages, in order. network: whether the scene has one; a diffuse scene is not refined."""
        chosen = {"prune": self.prune > 0, "fit": self.fit, "refine": self.refine and network and not self.fit}
        return tuple(name for name, wanted in chosen.items() if wanted)


DEFAULT_FINISHING = Finishing()


def finish(
    scene: Scene,
    dataset: Dataset,
    finishing: Finishing,
    background: tuple[float, float, float],
    progress: Progress = silent,
) -> tuple[Scene, dict[str, float]]:
    """Run the stages on the images of a dataset. background: RGB in [0, 1] over which the field was trained.

    Voxels of thin fog are neither fitted nor pruned, which a note says.
    Returns the scene, with the report of each stage in `about`, and the seconds of each. Raises SnergError when an image cannot be read,
    Cancelled when `progress` does.
    """
    if scene.square_roots and (finishing.fit or finishing.prune):
        progress(0.0, Note("The voxels are neither fitted nor pruned: in thin fog, no single one tells in a picture."))
        finishing = replace(finishing, fit=False, prune=0.0)
    stages, seconds, done = finishing.stages(scene.network is not None), {}, 0.0
    for name in stages:
        share = WEIGHTS[name] / sum(WEIGHTS[stage] for stage in stages)
        began = time.perf_counter()
        scene = _run(name, scene, dataset, finishing, background, within(progress, done, done + share))
        done, seconds[name] = done + share, time.perf_counter() - began
    return scene, seconds


def _run(
    name: str, scene: Scene, dataset: Dataset, finishing: Finishing, background: tuple[float, float, float], progress: Progress
) -> Scene:
    """One stage."""
    if name == "prune":
        return prune(scene, dataset, finishing.prune, progress=progress)[0]
    with needs_jax():
        from .fine_tune import RefineSettings, refine
        from .fit_voxels import FitSettings, fit_voxels
    if name == "fit":
        fitted, report = fit_voxels(scene, dataset, FitSettings(background=background), progress)
        if "skipped" not in report:
            return fitted
        progress(1.0, Note(f"The voxels are not fitted: {report['skipped']}."))
        return replace(scene, about={**scene.about, "fit": report})
    return refine(scene, dataset, RefineSettings(background=background), progress)[0]
