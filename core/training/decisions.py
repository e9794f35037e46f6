"""Decides settings that are 'auto' by measuring a dataset's images and cameras, before training.

View dependence is decided during training, in view_dependence_test.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.dataset import Dataset
from ..errors import SnergError
from ..geometry.box import Box
from ..geometry.camera import Camera
from ..geometry.ndc import Ndc
from ..nerf.sampling import CELLS, Domain, carve, cell_centres, clip_rays, pack_samples
from .config import TrainSettings

TRANSPARENT = 0.001  # share of pixels that are not opaque, from which alpha says something of the scene
FACING = 35.0  # degrees between the cameras' mean axis and theirs, up to which a scene is forward-facing (LLFF: 20 and less)
PLAIN = 0.5  # share of the images' borders that have the background's colour, from which that is a backdrop
DEEP = 2.0  # farthest / nearest, from which device coordinates spend samples better than the world's
NEARER = 0.9  # of the nearest depth: where the near plane stands
WIDEST = 3.0  # device coordinates are cut off there, in units of half a picture
RANGE = 6.0  # farthest / nearest along a ray, from which distances in disparity serve better


@dataclass(frozen=True)
class Decision:
    """A decision about one effect, and its evidence."""

    effect: str  # its name, such as 'NDC'
    chosen: bool | str  # what training does
    evidence: str  # a sentence with the measured numbers
    measured: float | None = None  # the value that was compared with `threshold`; None where nothing was measured
    threshold: float | None = None
    overridden: bool = False  # whether the settings chose, whatever the evidence

    def text(self) -> str:
        """For a progress line: 'NDC: no. The cameras ...'."""
        chosen = ("yes" if self.chosen else "no") if isinstance(self.chosen, bool) else self.chosen
        return f"{self.effect}: {chosen}{', as the settings say' if self.overridden else ''}. {self.evidence}"

    def to_json(self) -> dict[str, Any]:
        """JSON values."""
        return asdict(self)


def decided(
    effect: str, setting: str, measured: bool, evidence: str, value: float | None = None, threshold: float | None = None
) -> Decision:
    """The decision `measured`, unless the setting is 'on' or 'off', which overrides it. value, threshold: see Decision."""
    chosen = measured if setting == "auto" else setting == "on"
    return Decision(effect, chosen, evidence, value, threshold, setting != "auto")


def transparency(setting: str, pixels: NDArray[Any], has_alpha: bool) -> Decision:
    """Decide whether the images' alpha is trained on: yes where at least TRANSPARENT of the pixels [N, 4] uint8 are not opaque.

    has_alpha: whether every image has alpha that varies. Raises SnergError when the setting is 'on' and has_alpha is False.
    """
    if not has_alpha:
        if setting == "on":
            raise SnergError("The settings want transparency, but not every image has an alpha channel that varies; set it to auto or off.")
        return decided("Alpha", setting, False, "The images have no alpha channel, or one that is opaque everywhere.", 0.0, TRANSPARENT)
    share = float((pixels[:, 3] < 255).mean())
    evidence = f"{100 * share:.2f} % of the pixels are not opaque (from {100 * TRANSPARENT:g} % on, alpha bounds the scene and is learned)."
    return decided("Alpha", setting, share >= TRANSPARENT, evidence, share, TRANSPARENT)


def known_depth(carved: float) -> Decision:
    """The decision that the dataset's depth is used, as the settings say.

    carved: share in [0, 1] of the cells of the occupancy grid that it empties.
    """
    evidence = f"A view looks through {100 * carved:.0f} % of the cells, which are empty."
    return Decision("Depth", True, evidence, carved, None, True)


def backdrop(setting: str, shares: Sequence[float], alpha: bool, colour: str) -> Decision:
    """Decide whether opaque images show the scene in front of a plain backdrop, so that silhouettes can be found by flood fill.

    shares: for each image the share in [0, 1] of its border pixels that have exactly the background's colour; empty where the background
    is random. alpha: whether alpha is trained on; there is no need for a backdrop then.
    """
    if alpha or not shares:
        why = "Alpha separates the scene from its background." if alpha else "The background has no single colour."
        return Decision("Backdrop", False, why, None, PLAIN, setting != "auto")
    share = float(np.mean(shares))
    rule = f"from {100 * PLAIN:.0f} % on, areas of this colour that touch the border are background"
    evidence = f"{100 * share:.0f} % of the images' border pixels are exactly {colour} ({rule})."
    return decided("Backdrop", setting, share >= PLAIN, evidence, share, PLAIN)


def forward_facing(
    setting: str,
    cameras: Sequence[Camera],
    points: NDArray[Any] | None,
    bounds: NDArray[Any] | None,
    alpha: bool,
) -> tuple[Decision, Ndc | None]:
    """Decide whether to train in normalised device coordinates (NDC): (decision, the NDC or None).

    points: [N, 3] on the scene's surfaces, world units, or None; bounds: [views, 2] nearest and farthest depth, world units, or None.
    alpha: whether alpha is trained on. Raises SnergError when the setting is 'on' and NDC is impossible for these cameras.
    """
    frame = mean_frame(cameras)
    axes = np.stack([-c.camera_to_world[:3, 2] for c in cameras])
    angle = float(np.degrees(np.arccos(np.clip(axes @ -frame[:3, 2], -1, 1).min())))
    near, far = _depths(frame, cameras, points, bounds)
    summary = f"The cameras look up to {angle:.0f} degrees away from their mean direction (forward-facing: {FACING:.0f} at most)"
    reasons = []
    others = sorted({c.projection for c in cameras} - {"perspective"})
    if others:
        reasons.append(f"some are {' and '.join(others)}")
    if angle > FACING:
        reasons.append("they surround the scene")
    elif near is None or far is None:
        reasons.append("the source does not say how near and far the scene is")
    elif near <= 0:
        reasons.append("no plane in front of all cameras has the whole scene behind it")
    impossible = bool(reasons)
    if near is not None and far is not None and near > 0:
        summary += f", the scene lies {near:.3g} to {far:.3g} away, a ratio of {far / near:.1f} (NDC from {DEEP:g} on)"
        if far / near < DEEP:
            reasons.append("the scene is not deep enough")
    if alpha:
        reasons.append("alpha separates the scene from its background")
    evidence = summary + (f"; {' and '.join(reasons)}." if reasons else ".")
    if setting == "on" and impossible:
        raise SnergError(f"These cameras cannot have normalised device coordinates: {reasons[0]}; set ndc to auto or off.")
    decision = decided("NDC", setting, not reasons, evidence, angle, FACING)
    if not decision.chosen or near is None:
        return decision, None
    focal = np.median([(2 * c.focal[0] / c.width, 2 * c.focal[1] / c.height) for c in cameras], axis=0)
    return decision, Ndc(frame, (float(focal[0]), float(focal[1])), near * NEARER)


def mean_frame(cameras: Sequence[Camera]) -> NDArray[Any]:
    """The mean camera-to-world pose [4, 4] of cameras, rigid: the mean of their axes, made orthonormal, at their mean position."""
    u, _, vt = np.linalg.svd(np.mean([c.camera_to_world[:3, :3] for c in cameras], axis=0))
    frame = np.eye(4)
    frame[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    frame[:3, 3] = np.mean([c.position for c in cameras], axis=0)
    return frame


def _depths(
    frame: NDArray[Any], cameras: Sequence[Camera], points: NDArray[Any] | None, bounds: NDArray[Any] | None
) -> tuple[float | None, float | None]:
    """(nearest, farthest) depth of the scene along the frame's -z axis, world units; (None, None) without bounds and enough points."""
    if bounds is not None:
        ahead = np.array([(c.position - frame[:3, 3]) @ -frame[:3, 2] for c in cameras])
        return float((bounds[:, 0] + ahead).min()), float((bounds[:, 1] + ahead).max())
    if points is None or len(points) < 16:
        return None, None
    depth = (points - frame[:3, 3]) @ -frame[:3, 2]
    return float(np.percentile(depth, 0.5)), float(np.percentile(depth, 99.5))


def seen_in_ndc(ndc: Ndc, cameras: Sequence[Camera]) -> tuple[Domain, NDArray[Any]]:
    """(domain, occupancy bool [CELLS^3]) of a forward-facing capture in NDC: the part of NDC that the cameras see, and its cells that at
    least one camera sees, with one more cell on every side. Raises SnergError when no camera looks along the axis of the frame."""
    ends = []
    for camera in cameras:
        edge = [(x, y) for x in (0, camera.width // 2, camera.width - 1) for y in (0, camera.height // 2, camera.height - 1)]
        origins, directions = camera.rays(np.array(edge))
        point, direction, near, far = ndc.rays(origins, directions, camera.clip_distances(directions)[0])
        hits = far > near
        ends += [point[hits], (point + far[:, None] * direction)[hits]]
    found = np.concatenate(ends)
    if not len(found):
        raise SnergError("No camera looks along the axis of the forward-facing frame; set ndc to off.")
    low = np.append(found[:, :2].min(axis=0).clip(-WIDEST, WIDEST), -1.0)
    high = np.append(found[:, :2].max(axis=0).clip(-WIDEST, WIDEST), 1.0)
    domain = Domain.around(low, high)
    x = cell_centres(CELLS)
    inside = ((x >= domain.low - 1 / CELLS) & (x <= domain.high + 1 / CELLS)).all(axis=-1)
    alive = np.zeros(CELLS**3, bool)
    # A cell that no camera's centre ray meets may still show at its rim: an extra cell all round.
    alive[inside] = carve(ndc.to_world(domain.to_world(x[inside])), cameras, [None] * len(cameras), 0.0)
    grown = alive.reshape((CELLS,) * 3)
    for axis in range(3):
        grown = grown | np.roll(grown, 1, axis) | np.roll(grown, -1, axis)
    return domain, grown.reshape(-1) & inside


def pixel_size(dataset: Dataset) -> float:
    """The median size of a view's pixel at the middle of the suggested box, in units of half the box's longest side."""
    box = dataset.suggested_box()
    middle, half = box.box_to_world[:3, 3], float(box.size.max()) / 2
    sizes = []
    for camera in dataset.cameras:
        distance = 1.0 if camera.projection == "orthographic" else float(np.linalg.norm(middle - camera.position))
        sizes.append(distance / max(camera.focal))
    return float(np.median(sizes)) / half


def disparity(setting: str, domain: Domain, origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any], ndc: bool) -> Decision:
    """Decide whether samples are evenly spaced in disparity (1 / distance) instead of distance: yes where far / near is at least RANGE.

    origins, directions [N, 3] and near [N]: rays in field coordinates. setting: 'auto', 'linear' or 'disparity'.
    """
    override = {"linear": "off", "disparity": "on"}.get(setting, "auto")
    if ndc:
        return decided("Disparity", override, False, "Normalised device coordinates are already linear in disparity.")
    enter, leave = clip_rays(domain, origins, directions, near)
    hit = leave > enter
    if not hit.any():
        return decided("Disparity", override, False, "No ray crosses the box.")
    nearest, farthest = float(np.percentile(enter[hit], 5)), float(np.percentile(leave[hit], 95))
    ratio = farthest / max(nearest, 1e-3)
    evidence = f"Along the rays, far / near of the scene is {min(ratio, 9999):.1f} (disparity from {RANGE:g} on)."
    return decided("Disparity", override, ratio >= RANGE, evidence, ratio, RANGE)


def sampling(
    settings: TrainSettings, domain: Domain, alive: NDArray[Any], origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any]
) -> Decision:
    """Decide whether hierarchical sampling, with a coarse and a fine network, is needed.

    The packed sampler does not need it: its samples have the final spacing and lie in occupied cells. Even samples do not need it where
    settings.coarse of them have at most the final spacing. origins, directions [N, 3] and near [N]: rays in field coordinates.
    """
    if settings.sampler == "packed":
        filled = share_filled(domain, alive, origins, directions, near)
        evidence = f"{100 * filled:.0f} % of the rays' length lies in cells that may be occupied; packed samples lie only there."
        return Decision("Hierarchical sampling", False, evidence, filled)
    enter, leave = clip_rays(domain, origins, directions, near)
    way = float(np.percentile(np.maximum(leave - enter, 0), 95))
    needed = way / settings.spacing
    evidence = f"Rays cross the domain for up to {way:.2f}, {needed:.0f} times the final spacing; there are {settings.coarse} even samples."
    return decided("Hierarchical sampling", settings.hierarchy, needed > settings.coarse, evidence, needed, settings.coarse)


def share_filled(domain: Domain, alive: NDArray[Any], origins: NDArray[Any], directions: NDArray[Any], near: NDArray[Any]) -> float:
    """The share of the rays' length in the domain that lies in occupied cells, in [0, 1].

    alive: bool [CELLS^3]; origins, directions [N, 3] and near [N]: rays in field coordinates.
    """
    step = 4 / CELLS
    enter, leave = clip_rays(domain, origins, directions, near)
    way = np.maximum(leave - enter, 0).sum() / step
    return float(len(pack_samples(domain, alive, origins, directions, step, np.full(len(origins), 0.5), near).ray) / max(way, 1))


def suggested(box: Box) -> Domain:
    """The domain that contains a box."""
    corners = box.corners()
    return Domain.around(corners.min(axis=0), corners.max(axis=0))
