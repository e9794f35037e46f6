"""Baking a field into a SNeRG (section 5.3) inside the artist's box: look, cull, fill (JAX, through the field)."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..io.files import json_bytes
from ..nerf.checkpoint import flatten
from ..nerf.field import Field
from ..progress import Progress, silent, within
from ..scene.blocks import count_voxels, dilate, number_blocks, reindex_blocks, touched_blocks
from ..scene.scene import Scene
from ..scene.voxel_grid import MAX_RESOLUTION, VoxelGrid
from .memory import check_memory
from .occupied_voxels import find_occupied_voxels
from .opacity_correction import opacity_correction_errors
from .prefilter import fill_atlas
from .resume import ResumeCache
from .supersampling import choose_supersampling
from .visibility import visible_voxels

AUTO_SUPERSAMPLING = 0  # samples: as many as are worth their time
ACCELERATION_BYTES = 2  # bytes a voxel, while the tables of a march are made
BAKE_VERSION = 2  # of bakes: another where the same settings keep or give something else


@dataclass(frozen=True)
class BakeSettings:
    """resolution: voxels along the box's longest side; voxel_size, in units of the scene, takes its place where given.
    samples: points averaged in a voxel, Gaussian with a standard deviation of voxel / sqrt(12); 0: as many as measuring shows to be
    worth their time. alpha_threshold: blocks along no row of which so much opacity adds up are culled; visibility_threshold:
    voxels that no camera sees with at least this transmittance are culled (section 5.3). seed: of the jitter. opacity_correction:
    see Scene; None: in forward-facing scenes, as in the paper (supplement C.3), whose rays come nearer to the field's with it.

    For comparison (table 1 of the paper): visibility False keeps what no camera sees; quantise False keeps float32;
    network False leaves out view dependence and its features.
    """

    resolution: int = 512
    samples: int = AUTO_SUPERSAMPLING
    alpha_threshold: float = 0.005
    visibility_threshold: float = 0.01
    seed: int = 0
    opacity_correction: bool | None = None
    voxel_size: float | None = None
    visibility: bool = True
    quantise: bool = True
    network: bool = True

    def __post_init__(self) -> None:
        if self.resolution < 2 or self.resolution > MAX_RESOLUTION:
            raise SnergError(f"A resolution of {self.resolution} voxels cannot be baked; choose 2 to {MAX_RESOLUTION}.")
        if not 0 <= self.samples <= 64:
            raise SnergError(f"{self.samples} samples a voxel cannot be averaged; choose 1 to 64, or 0 to have the number measured.")
        if self.voxel_size is not None and not 0 < self.voxel_size < np.inf:
            raise SnergError(f"Voxels of size {self.voxel_size} cannot be baked; choose a size above 0, in units of the scene.")
        for name in ("alpha_threshold", "visibility_threshold"):
            if not 0 < getattr(self, name) < 1:
                raise SnergError(f"The {name.replace('_', ' ')} is {getattr(self, name)}; choose one between 0 and 1.")


def bake(
    field: Field,
    box: Box,
    cameras: Sequence[Camera],
    settings: BakeSettings = BakeSettings(),
    progress: Progress = silent,
    resume: Path | None = None,
) -> Scene:
    """Evaluate a field inside a box of its space (see Field.ndc) into a sparse grid.

    cameras: those that decide what is visible; none keeps everything. resume: a folder that holds what is finished, so that the
    same bake goes on there after a kill; remove it with files.discard once the scene is safe. Memory beside the finished atlas is
    bounded, whatever the resolution.

    Raises SnergError for a field whose values are not finite, or that depends on the direction in each sample, which a grid
    cannot hold, and for a resolution that does not fit in memory; Cancelled when `progress` does. An empty result is a valid
    scene; `about` says so.
    """
    check_field(field)
    voxel_grid = VoxelGrid.inside(box, settings.voxel_size or float(box.size.max()) / settings.resolution)
    channels = 8 if settings.network and field.network is not None else 4
    looks = ACCELERATION_BYTES if field.ndc is not None and settings.opacity_correction is None else 0
    check_memory(field, box, voxel_grid, channels * (1 if settings.quantise else 4) + looks)
    kept = ResumeCache(resume, resume_key(field, box, cameras, settings) if resume is not None else "")
    tell, clock = TimeLeft(progress), _StageTimer()

    matter = find_occupied_voxels(field, voxel_grid, settings.alpha_threshold, kept, lambda f: tell(0.25 * f, "Looking where something is"))
    clock.lap("occupancy")
    indirection = number_blocks(touched_blocks(matter.bits, matter.indirection))
    bits = dilate(reindex_blocks(matter.bits, matter.indirection, indirection), indirection)
    voxels: dict[str, int | None] = {"held": int(count_voxels(bits).sum()), "seen": None}
    light = None
    if cameras and settings.visibility and len(bits):
        seen, light = visible_voxels(matter, voxel_grid, field.ndc, cameras, settings.visibility_threshold, kept, within(tell, 0.25, 0.5))
        bits &= reindex_blocks(seen, matter.indirection, indirection)
        voxels["seen"] = int(count_voxels(bits).sum())
    clock.lap("visibility")
    samples, evidence = settings.samples, None
    if samples == AUTO_SUPERSAMPLING:
        samples, evidence = choose_supersampling(field, voxel_grid, bits, indirection, settings.seed)
    cells, indirection = fill_atlas(
        field,
        voxel_grid,
        bits,
        indirection,
        channels,
        samples,
        settings.seed,
        settings.quantise,
        kept,
        lambda f: tell(0.5 + 0.48 * f, "Baking colour and opacity"),
    )
    clock.lap("prefilter")
    about: dict[str, Any] = {
        "settings": asdict(settings),
        "seconds": clock.laps,
        "blocks": len(cells),
        "blocks_in_all": indirection.size,
        "voxels": voxels,
        "samples": samples,
        "opacity_lost_at_most": round(matter.lost, 4),
    }
    if light is not None:
        about["light"] = light.to_json()
    if evidence is not None:
        about["samples_measured"] = evidence
    if not len(cells):
        about["warning"] = "The box holds nothing; move it over the object, or train longer."
    network = field.network if channels == 8 else None
    scene = Scene(
        voxel_grid.grid_to_world, voxel_grid.voxel_size, voxel_grid.shape, indirection, cells, network, about={"bake": about}, ndc=field.ndc
    )
    scene = decide_opacity_correction(scene, field, cameras, settings, lambda f: tell(0.98 + 0.02 * f, "Looking for holes"))
    clock.lap("holes")
    tell(1.0, "Baking")
    return scene


def decide_opacity_correction(
    scene: Scene, field: Field, cameras: Sequence[Camera], settings: BakeSettings, tell: Callable[[float], None]
) -> Scene:
    """The scene with equation 9 where the settings say so, or, in a forward-facing one, where its rays come nearer to the field's with it
    (or there are none)."""
    fills = settings.opacity_correction
    if fills is None and scene.ndc is not None and cameras and len(scene.cells):
        errors = opacity_correction_errors(field, scene, cameras, settings.seed, tell)
        scene.about["bake"]["holes"] = errors
        fills = errors["with"] < errors["without"]
    if fills is None:
        fills = scene.ndc is not None
    return replace(scene, opacity_correction=True) if fills else scene


def check_voxel_size(settings: BakeSettings, field: Field) -> None:
    """Raises SnergError when voxels are to have a size in a space where no length is one of the scene's."""
    if settings.voxel_size is not None and field.ndc is not None:
        raise SnergError("The field lies in device coordinates, in which a length is not one of the scene; choose a resolution instead.")


def check_field(field: Field) -> None:
    """Raise SnergError when a field cannot be baked."""
    if field.view not in ("deferred", "diffuse"):
        raise SnergError(
            f"The field's view dependence is of the kind {field.view!r}, sample by sample, which no grid can hold; "
            "train it with view dependence 'deferred' or 'diffuse' to bake it."
        )
    for name, array in learnt_arrays(field).items():
        if not np.isfinite(array).all():
            raise SnergError(f"The field's {name} holds values that are not finite; train it again, or import an undamaged checkpoint.")


def learnt_arrays(field: Field) -> dict[str, NDArray[Any]]:
    """Everything that a field has learnt, by name."""
    network = {} if field.network is None else {f"view.{name}": np.asarray(array) for name, array in field.network._asdict().items()}
    return flatten(field.params) | network


def resume_key(field: Field, box: Box, cameras: Sequence[Camera], settings: BakeSettings) -> str:
    """A name for a bake: another for another field, box, cameras or settings."""
    domain = field.domain
    plain = {
        "version": BAKE_VERSION,
        "settings": asdict(settings),
        "box": box.to_json(),
        "cameras": [camera.to_json() for camera in cameras],
        "family": repr(field.family),
        "view": field.view,
        "ndc": None if field.ndc is None else field.ndc.to_json(),
        "scale": domain.scale,
    }
    digest = hashlib.sha256(json_bytes(plain))
    arrays = learnt_arrays(field) | {"centre": domain.centre, "low": domain.low, "high": domain.high}
    if field.occupancy is not None:
        arrays["occupancy"] = field.occupancy
    for name, array in arrays.items():
        digest.update(f"{name} {array.shape} {array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:16]


class TimeLeft:
    """Progress that says how long the rest will take, as soon as it can tell."""

    def __init__(self, progress: Progress) -> None:
        self.progress = progress
        self.first: tuple[float, float] | None = None

    def __call__(self, fraction: float, what: str) -> None:
        now = time.monotonic()
        if self.first is None:
            self.first = now, fraction
        gone, done = now - self.first[0], fraction - self.first[1]
        if gone > 2 and done > 0.02:
            left = gone * (1 - fraction) / done
            what += f", {left:.0f} s left" if left < 100 else f", {left / 60:.0f} min left"
        self.progress(fraction, what)


class _StageTimer:
    """Seconds of each stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.laps[name] = round(now - self.last, 3)
        self.last = now
