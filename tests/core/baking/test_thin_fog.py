"""Fog so thin that it adds up over a thousand voxels: baked, stored and marched, against float64."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from oracle import dense_march
from scenes import looking, make_dataset, make_snerg, random_network
from snerg.core.baking.bake import BakeSettings, bake
from snerg.core.baking.finish import Finishing, finish
from snerg.core.baking.fit_voxels import fit_voxels
from snerg.core.baking.thin_fog import MAX_GRAIN
from snerg.core.data.load import read_dataset
from snerg.core.geometry.box import Box
from snerg.core.geometry.camera import Camera
from snerg.core.nerf.model import ViewNetwork
from snerg.core.nerf.sampling import Domain
from snerg.core.rendering.early_termination import premultiplied_excess
from snerg.core.rendering.render import MarchSettings, render_scene
from snerg.core.scene.scene import Scene

LENGTH = 1000  # voxels
VOXEL = 2 / LENGTH
SIDE = 24 * VOXEL  # of the tube of fog, across
BOX = Box.axis_aligned([-1, -SIDE / 2, -SIDE / 2], [1, SIDE / 2, SIDE / 2])


@dataclass(frozen=True, eq=False)
class Fog:
    """A tube of fog with that alpha a voxel, orange, and a solid green wall across it where there is one."""

    alpha: float
    wall: float | None = None  # where along x it begins
    network: ViewNetwork | None = None
    occupancy: None = None
    ndc: None = None
    view: str = "diffuse"
    params: dict = field(default_factory=dict)
    domain: Domain = field(default_factory=lambda: Domain.around(np.full(3, -1.0), np.full(3, 1.0)))

    def query(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        density = np.full(len(points), -np.log1p(-self.alpha) / VOXEL)
        colour = np.tile(np.float32([0.8, 0.5, 0.2]), (len(points), 1))
        if self.wall is not None:
            inside = np.abs(points[:, 0] - self.wall - 0.02) < 0.02
            density[inside] = 3 / VOXEL
            colour[inside] = 0.1, 0.9, 0.3
        features = np.full((len(points), 4 if self.network is not None else 0), 0.25, np.float32)
        return density.astype(np.float32), colour, features

    def holds(self, x: np.ndarray) -> np.ndarray:
        return np.ones(len(x), bool)


def along(offset: tuple[float, float] = (0.3, -0.2)) -> Camera:
    """Nearly along the tube, parallel rays, 14 by 14 of them, 1.2 voxels apart."""
    eye = np.array([-1.5, offset[0] * VOXEL, offset[1] * VOXEL])
    return Camera(14, 14, (1 / (1.2 * VOXEL),) * 2, (7, 7), looking(eye, eye + [3, 0.002, -0.003]), projection="orthographic")


def levels(scene: Scene, truth: Scene) -> float:
    """Root mean square difference of a scene's march over white and the float64 march of another, in levels of 255."""
    shown = render_scene(scene, along()).over((1, 1, 1))
    return 255 * float(np.sqrt(np.mean((shown - dense_march(truth, along()).over()) ** 2)))


def baked(fog: Fog, **settings: object) -> Scene:
    return bake(fog, BOX, (), BakeSettings(LENGTH, supersampling=1, **settings))


@pytest.mark.hard_case(76)
@pytest.mark.parametrize("alpha", [1e-4, 2e-4, 5e-4])
def test_thin_fog_is_off_by_less_than_half_a_level(alpha: float) -> None:
    exact, scene = baked(Fog(alpha), quantise=False), baked(Fog(alpha))
    assert scene.square_roots and scene.effects["thin_fog"] and scene.about["bake"]["thin_fog"]["grain"] > MAX_GRAIN
    assert np.allclose(exact.cells[..., -1].max(), alpha, rtol=1e-3)
    assert levels(scene, exact) < 0.5


@pytest.mark.hard_case(76)
def test_fog_before_and_behind_a_solid() -> None:
    fog = Fog(5e-4, wall=0.2)
    assert levels(baked(fog), baked(fog, quantise=False)) < 0.6
