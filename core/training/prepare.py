"""Prepares a training before its first step: reads the pixels, finds the domain, decides 'auto' settings, makes the sampler. Needs JAX."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data.coverage import coverage
from ..data.dataset import HELD_OUT, Dataset
from ..data.load import read_split
from ..errors import SnergError
from ..geometry.ndc import Ndc
from ..io.images import over, to_uint8
from ..nerf.model import init_params, with_frequencies
from ..nerf.sampling import Domain, clip_rays, hull
from ..progress import Progress
from . import decisions, known_depth, view_dependence_test
from .config import TrainSettings
from .decisions import Decision
from .device_sampler import DeviceSampler, packs_on_device
from .hierarchical_sampler import HierarchicalSampler
from .light import diffuse_pixels
from .losses import plain_colour
from .occupancy_sampler import OccupancySampler
from .ray_dataset import RayDataset
from .sampler import Sampler
from .silhouette import border_share, silhouette
from .validation import HELD_OUT_RAYS, ValidationRays, some_views

Masks = list[NDArray[Any] | None]
DECISION_RAYS = 1024  # training rays that the decisions on sampling are measured on
CROSSING_RAYS = 65536  # training rays that the share of rays crossing the box is measured on


@dataclass(frozen=True, eq=False)
class Prepared:
    """The inputs of a training. Its fields are never replaced; what changes inside them while training runs is `rng`, the sampler's
    own state and `rays.withheld`, and `trainer.Trainer` alone changes it."""

    dataset: Dataset
    settings: TrainSettings  # as asked for; `sampler.settings` has those that were 'auto' decided
    rays: RayDataset  # all pixels of the dataset
    domain: Domain  # where the field lives
    ndc: Ndc | None  # its normalized device coordinates; None where it lives in world coordinates
    sampler: Sampler
    rng: np.random.Generator  # of all random numbers that are drawn on the host
    params: Any  # initial parameters, a tree of NumPy arrays
    decisions: tuple[Decision, ...]  # of effects that the images and cameras decide
    validation_views: NDArray[Any]  # bool [views], not trained on until the view-dependence test is done
    held_out: ValidationRays | None  # rays of views that are never trained on; None where the dataset has no such split


def prepare(dataset: Dataset, settings: TrainSettings, progress: Progress, held_out: Dataset | None) -> Prepared:
    """Read the images, decide what the settings leave open, and build the sampler and the initial parameters.

    held_out: views that are scored and never trained on. Raises SnergError where the dataset cannot be trained on.
    """
    masks = masks_of(dataset)
    rays, transparency = read_pixels(dataset, settings, masks, progress)
    if settings.diffuse:
        rays.diffuse = diffuse_pixels(dataset)
    domain, ndc, occupied, of_space = find_domain(dataset, settings, rays, masks, progress)
    rays.domain, rays.ndc = domain, ndc
    if ndc is None:
        of_space.append(training_box(dataset, rays, settings.seed))
    rng = np.random.default_rng(settings.seed)
    sampler, of_sampling = make_sampler(settings, rays, occupied, rng)
    views = len(dataset.views)
    validation_views = view_dependence_test.set_aside(views) if settings.view_dependence == "auto" else np.zeros(views, bool)
    rays.withheld = validation_views.copy()
    params = init_params(settings.family, settings.view_dependence, sampler.settings.hierarchy == "on", rng)
    return Prepared(
        dataset=dataset,
        settings=settings,
        rays=rays,
        domain=domain,
        ndc=ndc,
        sampler=sampler,
        rng=rng,
        params=with_frequencies(params, settings.view_degrees),
        decisions=(transparency, *of_space, *of_sampling),
        validation_views=validation_views,
        held_out=None if held_out is None else held_out_rays(held_out, settings, domain, ndc),
    )


def read_pixels(dataset: Dataset, settings: TrainSettings, masks: Masks, progress: Progress) -> tuple[RayDataset, Decision]:
    """(all pixels of the dataset with their rays, the decision whether alpha is trained on). If not, pixels are composited over white."""
    count = len(dataset.views)

    def images(opaque: bool) -> Iterator[NDArray[Any]]:
        for i in range(count):
            progress(0.0, f"Reading image {i + 1} of {count}")
            yield to_uint8(over(dataset.read(i))) if opaque else dataset.read(i)

    domain = decisions.suggested(dataset.suggested_box())
    rays = RayDataset(images(settings.transparency == "off"), dataset.cameras, domain, masks)
    decision = decisions.transparency(settings.transparency, rays.pixels, rays.alpha)
    if rays.alpha and not decision.chosen:
        rays = RayDataset(images(True), dataset.cameras, domain, masks)
    return rays, decision


def find_domain(
    dataset: Dataset, settings: TrainSettings, rays: RayDataset, masks: Masks, progress: Progress
) -> tuple[Domain, Ndc | None, NDArray[Any], list[Decision]]:
    """(domain, device coordinates or None, cells that may hold something bool [CELLS ** 3], decisions).

    The domain of a forward-facing capture is in normalised device coordinates; that of any other is the visual hull of its silhouettes.
    """
    decision, ndc = decisions.forward_facing(settings.ndc, dataset.cameras, dataset.points, dataset.bounds, rays.alpha)
    if ndc is not None:
        domain, occupied = decisions.seen_in_ndc(ndc, dataset.cameras)
        return domain, ndc, occupied, [decision]
    progress(0.0, "Carving the visual hull")
    silhouettes, backdrop = find_silhouettes(dataset, settings, rays, masks)
    plain = all(s is None for s in silhouettes)  # what is behind the scene must be explained too
    box = dataset.opaque_box if plain and dataset.opaque_box is not None else dataset.suggested_box()
    domain, occupied = hull(box, dataset.cameras, silhouettes)
    if settings.depth == "off":
        return domain, None, occupied, [decision, backdrop]
    progress(0.0, "Reading the depth")
    occupied, of_depth = carve_by_depth(dataset, rays, domain, occupied)
    return domain, None, occupied, [decision, backdrop, of_depth]


def carve_by_depth(dataset: Dataset, rays: RayDataset, domain: Domain, occupied: NDArray[Any]) -> tuple[NDArray[Any], Decision]:
    """(the cells that no view looks through bool [CELLS^3], the decision on depth).

    Raises SnergError where a view has no depth, it cannot be read, or it leaves no cell.
    """
    kept = known_depth.carve(dataset, rays, domain, occupied)
    if not kept.any():
        raise SnergError("The depth of the dataset says that all of the box is empty; its unit may be wrong: set depth to off.")
    return kept, decisions.known_depth(1 - int(kept.sum()) / max(int(occupied.sum()), 1))


def find_silhouettes(
    dataset: Dataset, settings: TrainSettings, rays: RayDataset, masks: Masks
) -> tuple[Sequence[NDArray[Any] | None], Decision]:
    """(each view's silhouette, bool [H, W], or None where its image has none; the decision on the backdrop).

    A silhouette is where alpha is above 0, or everything but a plain backdrop. Pixels far from their view's silhouette are not drawn.
    """
    cameras, background = dataset.cameras, plain_colour(settings.background)
    bounds = zip(rays.starts, rays.ends, cameras, strict=True)
    images = [rays.pixels[start:end].reshape(c.height, c.width, 4) for start, end, c in bounds]
    shares = [] if background is None or rays.alpha else [border_share(i[..., :3], background) for i in images]
    decision = decisions.backdrop(settings.backdrop, shares, rays.alpha, settings.background)
    if rays.alpha:
        found = [i[..., 3] > 0 for i in images]
    elif decision.chosen and background is not None:
        found = [silhouette(i[..., :3], background) for i in images]
    else:
        return [None] * len(images), decision
    # What a mask hides is unknown: it must not carve the visual hull.
    found = [f if mask is None else f | ~mask for f, mask in zip(found, masks, strict=True)]
    rays.keep_near(found, masks)
    return found, decision


def training_box(dataset: Dataset, rays: RayDataset, seed: int) -> Decision:
    """What the training box is, with the share of CROSSING_RAYS training rays that cross it.

    Raises SnergError when none does: the loss would be 0 and nothing would be learned.
    """
    origins, directions, near, far, _ = rays.rays(rays.draw(CROSSING_RAYS, np.random.default_rng(seed)))
    enter, leave = clip_rays(rays.domain, origins, directions, near)
    share = float((np.minimum(leave, far) > enter).mean())
    box = rays.domain.world_box()
    if not share:
        low, high = (", ".join(f"{v:.4g}" for v in corner) for corner in (box.corners().min(axis=0), box.corners().max(axis=0)))
        raise SnergError(
            f"No camera sees the training box, which spans ({low}) to ({high}): none of {CROSSING_RAYS} rays tried crosses it; "
            "give a box around what the cameras look at, or correct the poses."
        )
    measured = replace(coverage(box, dataset.cameras, dataset.points), rays=share)
    size = " x ".join(f"{side:.3g}" for side in box.size)
    return Decision("Training box", size, f"{dataset.box_origin} {measured.text().capitalize()}".strip(), share)


def make_sampler(
    settings: TrainSettings, rays: RayDataset, occupied: NDArray[Any], rng: np.random.Generator
) -> tuple[Sampler, list[Decision]]:
    """The sampler that the settings name, with its 'auto' settings decided, and these decisions. occupied: bool [CELLS^3].

    Raises SnergError as `packs_on_device` does.
    """
    origins, directions, near, *_ = rays.rays(rays.draw(DECISION_RAYS, np.random.default_rng(settings.seed)))
    domain = rays.domain
    sampling = decisions.sampling(settings, domain, occupied, origins, directions, near)
    if settings.sampler == "packed":
        kind = DeviceSampler if packs_on_device(settings) else OccupancySampler
        return kind(settings, rays, domain, occupied, rng), [sampling]
    disparity = decisions.disparity(settings.distances, domain, origins, directions, near, rays.ndc is not None)
    hierarchy, distances = "on" if sampling.chosen else "off", "disparity" if disparity.chosen else "linear"
    decided = replace(settings, distances=distances, hierarchy=hierarchy)
    return HierarchicalSampler(decided, rays, domain, occupied, rng), [sampling, disparity]


def held_out_rays(dataset: Dataset, settings: TrainSettings, domain: Domain, ndc: Ndc | None) -> ValidationRays:
    """A fixed set of rays of views that are never trained on."""
    images = (dataset.read(i) for i in range(len(dataset.views)))
    return ValidationRays(RayDataset(images, dataset.cameras, domain, masks_of(dataset), ndc), None, HELD_OUT_RAYS, settings)


def masks_of(dataset: Dataset) -> Masks:
    """Each view's mask, bool [H, W], True where a pixel is used; None where all are."""
    return [dataset.mask(i) for i in range(len(dataset.views))]


def held_out_of(dataset: Dataset) -> Dataset | None:
    """A few views of the dataset's 'val' or 'test' split, which `dataset` does not train on; None where it has no such split."""
    for split in HELD_OUT:
        if split in dataset.splits() and split != dataset.split:
            try:
                return some_views(read_split(dataset, split))
            except SnergError:
                continue  # training does not need these images
    return None
