"""Scoring rays of views that are not trained on: over the background that the field is trained over."""

from dataclasses import replace

import numpy as np
import pytest

from scenes import looking
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.model import MlpModelConfig, init_params
from snerg.core.nerf.sampling import CELLS, Domain
from snerg.core.training.config import TrainSettings
from snerg.core.training.hierarchical_sampler import HierarchicalSampler
from snerg.core.training.occupancy_sampler import OccupancySampler
from snerg.core.training.ray_dataset import RayDataset
from snerg.core.training.validation import ValidationRays

SETTINGS = TrainSettings(
    family=MlpModelConfig(width=8, depth=1, degrees=1, density="relu"),
    view_dependence="diffuse",
    samples=512,
    coarse=4,
    fine=4,
    rays_at_once=64,
)
SHOWN = {"white": (1, 1, 1), "black": (0, 0, 0), "#204060": (0x20 / 255, 0x40 / 255, 0x60 / 255), "random": (1, 1, 1)}


def pool_of(alpha: int) -> RayDataset:
    camera = Camera(16, 16, (20.0, 20.0), (8.0, 8.0), looking((2.4, 0, 0.8), (0, 0, 0)))
    image = np.full((16, 16, 4), (200, 100, 50, alpha), np.uint8)
    return RayDataset([image], [camera], Domain.around(np.full(3, -0.8), np.full(3, 0.8)))


@pytest.mark.hard_case(8)
@pytest.mark.parametrize("name", SHOWN)
@pytest.mark.parametrize("sampler", [OccupancySampler, HierarchicalSampler])
def test_rays_are_scored_over_the_background_of_the_training(name, sampler):
    """Where the field is empty it shows the background, and a picture's transparent part is that too."""
    kind = "packed" if sampler is OccupancySampler else "hierarchical"
    settings, pool = replace(SETTINGS, background=name, sampler=kind), pool_of(51)
    rays = ValidationRays(pool, None, 100, settings)
    assert np.abs(rays.wanted - (0.2 * np.array([200, 100, 50]) / 255 + 0.8 * np.array(SHOWN[name]))).max() < 1e-6
    params = init_params(settings.family, "diffuse", kind == "hierarchical", np.random.default_rng(0))
    for part in (params, params.get("coarse", params)):
        part["field"][1].kernel[:], part["field"][1].bias[:] = 0, -1  # density 0 everywhere
    scheme = sampler(settings, pool, pool.domain, np.ones(CELLS**3, bool), np.random.default_rng(0))
    assert np.abs(scheme.colours(params, rays, 1.0) - SHOWN[name]).max() < 1e-6


def test_opaque_pictures_are_what_they_are():
    rays = ValidationRays(pool_of(255), None, 50, replace(SETTINGS, background="black"))
    assert np.abs(rays.wanted - np.array([200, 100, 50]) / 255).max() < 1e-6
