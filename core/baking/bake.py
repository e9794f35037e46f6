"""Bakes a field inside a box into a SNeRG (section 5.3): finds occupied voxels, culls invisible ones, fills the atlas. Uses JAX."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..io.json_files import json_bytes
from ..io.settings import check_whole, is_whole
from ..nerf.checkpoint import flatten
from ..nerf.field import Field
from ..progress import Note, Progress, silent, within
from ..scene.blocks import count_voxels, dilate, number_blocks, reindex_blocks, touched_blocks
from ..scene.quantize import quantize, quantize_roots
from ..scene.scene import Scene
from ..scene.voxel_grid import MAX_RESOLUTION, VoxelGrid
from .memory import check_memory
from .occupied_voxels import find_occupied_voxels
from .opacity_correction import opacity_correction_errors
from .prefilter import Quantiser, fill_atlas
from .resume import ResumeCache
from .supersampling import choose_supersampling
from .thin_fog import MAX_GRAIN, fog_grain
from .timing import StageTimer, TimeLeft
from .visibility import VisibilityStatistics, visible_voxels

AUTO_SUPERSAMPLING = 0  # BakeSettings.supersampling: measured, see supersampling.py
MAX_SETTING_SUPERSAMPLING = 64  # points a voxel that may be asked for: bounds the time
ACCELERATION_BYTES = 2  # bytes a voxel of the acceleration structure of the marcher
BAKE_VERSION = 4  # part of the key of kept work; raised when the same settings bake something else
# Settings whose names in files (scene.json, studies, kept work) are older than those here.
FILE_NAMES = {"supersampling": "samples", "opacity_correction": "fill_holes"}
SHARES = {"occupancy": 0.25, "visibility": 0.5, "prefilter": 0.98}  # of the progress, at the end of each stage


@dataclass(frozen=True)
class BakeSettings:
    """How a field is baked. Raises SnergError for values out of range."""

    resolution: int = 512  # voxels along the box's longest side
    supersampling: int = AUTO_SUPERSAMPLING  # points averaged in a voxel, 1 to 64; 0: measured (see supersampling.py)
    alpha_threshold: float = 0.005  # least opacity that must add up along some row of a block, or the block is culled (tau_alpha)
    visibility_threshold: float = 0.01  # voxels that no camera sees with at least this transmittance are culled (tau_vis, section 5.3)
    seed: int = 0  # of the jitter and of the measurements
    # Whether composited rays are corrected by eq. 9 (see Scene). None: in forward-facing scenes, as in the paper (supplement C.3), if
    # rays of the cameras are closer to the field's with it.
    opacity_correction: bool | None = None
    voxel_size: float | None = None  # side of a voxel, scene units; replaces the resolution
    # For the ablations of table 1.
    visibility: bool = True  # False: keep voxels that no camera sees
    quantise: bool = True  # False: float32 cells
    network: bool = True  # False: a diffuse scene, without view dependence and features

    def __post_init__(self) -> None:
        if not (is_whole(self.resolution) and 2 <= self.resolution <= MAX_RESOLUTION):
            raise SnergError(f"A resolution of {self.resolution} voxels cannot be baked; choose 2 to {MAX_RESOLUTION}.")
        check_whole("The seed of a bake", self.seed, 0, 2**63 - 1)
        if not (is_whole(self.supersampling) and 0 <= self.supersampling <= MAX_SETTING_SUPERSAMPLING):
            raise SnergError(
                f"Averages of {self.supersampling} samples a voxel cannot be taken; choose 1 to {MAX_SETTING_SUPERSAMPLING}, "
                "or 0 to have the number measured."
            )
        if self.voxel_size is not None and not 0 < self.voxel_size < np.inf:
            raise SnergError(f"Voxels of size {self.voxel_size} cannot be baked; choose a size above 0, in units of the scene.")
        for name in ("alpha_threshold", "visibility_threshold"):
            if not 0 < getattr(self, name) < 1:
                raise SnergError(f"The {name.replace('_', ' ')} is {getattr(self, name)}; choose one between 0 and 1.")

    def to_json(self) -> dict[str, Any]:
        """The settings by the names that files have for them (FILE_NAMES)."""
        return {FILE_NAMES.get(name, name): value for name, value in asdict(self).items()}

    @classmethod
    def from_json(cls, value: dict[str, Any]) -> BakeSettings:
        """Undo `to_json`. Raises TypeError for a name that is no setting, SnergError for values out of range."""
        names = {old: new for new, old in FILE_NAMES.items()}
        return cls(**{names.get(name, name): setting for name, setting in value.items()})


def bake(
    field: Field,
    box: Box,
    cameras: Sequence[Camera],
    settings: BakeSettings = BakeSettings(),
    progress: Progress = silent,
    resume: Path | None = None,
) -> Scene:
    """Bake a field inside a box of its space (see Field.ndc) into a sparse grid.

    cameras: voxels that none of them sees are culled; without cameras all occupied voxels are kept. resume: a folder for finished parts,
    from which the same bake goes on after it was killed; remove it with files.discard once the scene is written. Beside the finished atlas
    the memory does not grow with the resolution.

    An empty box gives a valid, empty scene with a warning in `about`. Raises SnergError for a field whose values are not finite, for one
    that depends on the view direction at each sample, which a grid cannot store, and for a resolution that does not fit in memory;
    Cancelled when `progress` does.
    """
    check_field(field)
    voxel_grid = VoxelGrid.inside(box, settings.voxel_size or float(box.size.max()) / settings.resolution)
    check_memory(field, box, voxel_grid, voxel_bytes(field, settings))
    cache = ResumeCache(resume, resume_key(field, box, cameras, settings) if resume is not None else "")
    tell, timer = TimeLeft(progress), StageTimer()
    culled = _cull(field, voxel_grid, cameras, settings, cache, tell, timer)
    supersampling, evidence = settings.supersampling, None
    if supersampling == AUTO_SUPERSAMPLING:
        supersampling, evidence = choose_supersampling(field, voxel_grid, culled.mask, culled.indirection, settings.seed)
    grain = fog_grain(field, voxel_grid, culled.mask, culled.indirection, settings.seed) if settings.quantise else 0.0
    thin_fog = grain > MAX_GRAIN
    if thin_fog:
        progress(
            SHARES["visibility"], Note(f"Thin fog: stored as square roots, since 8 even bits would give it {grain:.1f} levels of grain.")
        )
    quantiser = (quantize_roots if thin_fog else quantize) if settings.quantise else None
    cells, indirection = _fill(field, voxel_grid, culled, supersampling, settings, quantiser, cache, tell)
    timer.lap("prefilter")
    about = _about(settings, timer, culled, supersampling, evidence, indirection)
    if thin_fog:
        about["thin_fog"] = {"grain": round(grain, 2)}
    network = field.network if channels_of(field, settings) == 8 else None
    grid = (voxel_grid.grid_to_world, voxel_grid.voxel_size, voxel_grid.shape)
    scene = Scene(*grid, indirection, cells, network, about={"bake": about}, ndc=field.ndc, square_roots=thin_fog)
    scene = decide_opacity_correction(scene, field, cameras, settings, tell)
    timer.lap("holes")
    tell(1.0, "Baking")
    return scene


def channels_of(field: Field, settings: BakeSettings) -> int:
    """Channels of the scene's cells: 8, or 4 in a diffuse scene (see Scene.cells)."""
    return 8 if settings.network and field.network is not None else 4


def voxel_bytes(field: Field, settings: BakeSettings) -> int:
    """Bytes that a voxel takes at the peak of a bake: its values, and the acceleration structure where the scene is marched."""
    marched = field.ndc is not None and settings.opacity_correction is None
    return channels_of(field, settings) * (1 if settings.quantise else 4) + (ACCELERATION_BYTES if marched else 0)


@dataclass(frozen=True, eq=False)
class _Culled:
    """The voxels to bake, and what culling measured."""

    mask: NDArray[Any]  # uint32 [M, 30, 30], voxels to bake
    indirection: NDArray[Any]  # int32 [bx, by, bz], number of each block of the mask, or -1
    opacity_lost: float  # see OccupiedVoxels
    occupied: int  # voxels that are occupied or neighbours of occupied ones
    visible: int | None  # those of them that are visible; None where visibility is not tested
    statistics: VisibilityStatistics | None


def _cull(
    field: Field,
    voxel_grid: VoxelGrid,
    cameras: Sequence[Camera],
    settings: BakeSettings,
    cache: ResumeCache,
    tell: Progress,
    timer: StageTimer,
) -> _Culled:
    """The voxels of a grid that are occupied or neighbours of occupied ones, and visible."""
    end = SHARES["occupancy"]
    occupied = find_occupied_voxels(field, voxel_grid, settings.alpha_threshold, cache, lambda f: tell(end * f, "Finding occupied voxels"))
    timer.lap("occupancy")
    indirection = number_blocks(touched_blocks(occupied.mask, occupied.indirection))
    mask = dilate(reindex_blocks(occupied.mask, occupied.indirection, indirection), indirection)
    count, visible, statistics = int(count_voxels(mask).sum()), None, None
    if cameras and settings.visibility and len(mask):
        threshold, shown = settings.visibility_threshold, within(tell, end, SHARES["visibility"])
        seen, statistics = visible_voxels(occupied, indirection, voxel_grid, field.ndc, cameras, threshold, cache, shown)
        mask &= seen
        visible = int(count_voxels(mask).sum())
    timer.lap("visibility")
    return _Culled(mask, indirection, occupied.opacity_lost, count, visible, statistics)


def _fill(
    field: Field,
    voxel_grid: VoxelGrid,
    culled: _Culled,
    supersampling: int,
    settings: BakeSettings,
    quantiser: Quantiser | None,
    cache: ResumeCache,
    tell: Progress,
) -> tuple[NDArray[Any], NDArray[Any]]:
    """`fill_atlas` of the voxels that culling left."""
    begin, end = SHARES["visibility"], SHARES["prefilter"]
    channels, seed = channels_of(field, settings), settings.seed

    def tell_fraction(fraction: float) -> None:
        tell(begin + (end - begin) * fraction, "Baking colour and opacity")

    return fill_atlas(field, voxel_grid, culled.mask, culled.indirection, channels, supersampling, seed, quantiser, cache, tell_fraction)


def _about(
    settings: BakeSettings,
    timer: StageTimer,
    culled: _Culled,
    supersampling: int,
    evidence: list[dict[str, Any]] | None,
    indirection: NDArray[Any],
) -> dict[str, Any]:
    """Scene.about["bake"]: settings and measurements, JSON values. "seconds" is filled on by the timer."""
    blocks = int(indirection.max(initial=-1)) + 1
    about: dict[str, Any] = {
        "settings": settings.to_json(),
        "seconds": timer.laps,
        "blocks": blocks,
        "blocks_in_all": indirection.size,
        "voxels": {"held": culled.occupied, "seen": culled.visible},
        "samples": supersampling,
        "opacity_lost_at_most": round(culled.opacity_lost, 4),
    }
    if culled.statistics is not None:
        about["light"] = culled.statistics.to_json()
    if evidence is not None:
        about["samples_measured"] = evidence
    if not blocks:
        about["warning"] = empty_warning(culled.opacity_lost, settings.alpha_threshold)
    return about


def empty_warning(opacity_lost: float, threshold: float) -> str:
    """Why a bake has no voxels: there is nothing, or fog that is thinner than the threshold of opacity keeps."""
    if opacity_lost < threshold:
        return "The box holds nothing; move it over the object, or train longer."
    return (
        f"The box holds thin fog alone, at most {100 * opacity_lost:.1f} % opaque, which is left out; lower the alpha threshold to keep it."
    )


def decide_opacity_correction(scene: Scene, field: Field, cameras: Sequence[Camera], settings: BakeSettings, tell: Progress) -> Scene:
    """The scene with opacity correction (eq. 9) if the settings ask for it.

    If they leave it open (None), only a forward-facing scene gets it: when its camera rays are closer to the field's with it, or when it
    has no cameras. Errors of the comparison go to scene.about["bake"]["holes"].
    """
    begin = SHARES["prefilter"]

    def tell_fraction(fraction: float) -> None:
        tell(begin + (1 - begin) * fraction, "Measuring the opacity correction")

    correct = settings.opacity_correction
    if correct is None and scene.ndc is not None and cameras and len(scene.cells):
        errors = opacity_correction_errors(field, scene, cameras, settings.seed, tell_fraction)
        scene.about["bake"]["holes"] = errors
        correct = errors["with"] < errors["without"]
    if correct is None:
        correct = scene.ndc is not None
    return replace(scene, opacity_correction=True) if correct else scene


def check_voxel_size(settings: BakeSettings, field: Field) -> None:
    """Raise SnergError when a voxel size is given for a field in normalised device coordinates, whose lengths are not the scene's."""
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
    """All trained weights of a field by name; arrays of any shape."""
    network = {} if field.network is None else {f"view.{name}": np.asarray(array) for name, array in field.network._asdict().items()}
    return flatten(field.params) | network


def resume_key(field: Field, box: Box, cameras: Sequence[Camera], settings: BakeSettings) -> str:
    """The key of a bake's kept work: a hash of the field, the box, the cameras and the settings, 16 hexadecimal digits."""
    domain = field.domain
    plain = {
        "version": BAKE_VERSION,
        "settings": settings.to_json(),
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
