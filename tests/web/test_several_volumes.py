"""Several volumes in one scene of three.js, moved, turned and scaled, with meshes, against float64 marches.

The marches are put together by the rule in viewer/README.md: meshes first; then, the farthest centre first, each volume up to what was
drawn before it. It leaves the depth at which half of the light is gone.
"""

from __future__ import annotations

import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from oracle import dense_march, halfway_depth
from scenes import looking, make_forward, make_forward_cameras, make_frame, make_snerg, rotation
from snerg.core.export.bundle import write_bundle
from snerg.core.geometry.camera import Camera
from snerg.core.geometry.ndc import Ndc
from snerg.core.scene.scene import Scene
from snerg.tests.web.conftest import ROOT, picture_of

pytestmark = pytest.mark.slow

Serve = Callable[[Path], str]
WIDTH, HEIGHT = 72, 54

PAGE = """
import { Box3, BufferAttribute, BufferGeometry, Color, DoubleSide, Matrix4, Mesh, MeshBasicMaterial, Scene, WebGLRenderer } from "three";
import { readCameras, ServerFiles, SnergScene, SnergVolume, threeCamera } from "./index";

window.draw = async ({ volumes, quads, settings }) => {
  const renderer = new WebGLRenderer({ canvas: document.getElementById("canvas"), ...settings });
  const world = new Scene();
  world.background = new Color("white");
  const { cameras: [camera] } = await readCameras(new ServerFiles("0"), "cameras.json");
  renderer.setSize(camera.width, camera.height);
  for (const { corners, colour, opacity } of quads) {
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(corners.flat()), 3));
    geometry.setIndex([0, 1, 2, 0, 2, 3]);
    const glass = opacity < 1 ? { transparent: true, opacity, depthWrite: false } : {};
    const material = new MeshBasicMaterial({ color: new Color().setRGB(...colour, "srgb"), side: DoubleSide, ...glass });
    world.add(new Mesh(geometry, material));
  }
  const problems = [];
  for (const { folder, matrix, first } of volumes) {
    const volume = new SnergVolume(await SnergScene.load(folder + "/scene"));
    volume.applyMatrix4(new Matrix4().set(...matrix.flat()));
    if (first) volume.renderOrder = -1;
    volume.addEventListener("error", ({ error }) => problems.push(error.message));
    world.add(volume);
    await volume.load(renderer);
  }
  renderer.render(world, threeCamera(camera, { far: 100 }));
  window.problems = problems;
  const box = new Box3().setFromObject(world.children.findLast((child) => child.isSnergVolume));
  window.box = [box.min.toArray(), box.max.toArray()];
};
"""


@dataclass(frozen=True, eq=False)
class Standing:
    """A scene, and where it stands: turned, then scaled, then moved."""

    scene: Scene
    turn: tuple[float, float, float] = (0, 0, 0)
    scale: float = 1.0
    position: tuple[float, float, float] = (0, 0, 0)
    first: bool = False  # drawn before the others

    @property
    def matrix(self) -> np.ndarray:
        result = np.eye(4)
        result[:3, :3], result[:3, 3] = self.scale * rotation(self.turn), self.position
        return result

    @property
    def moved(self) -> Scene:
        """The scene as if it had been baked there."""
        turn, scene = rotation(self.turn), self.scene

        def placed(pose: np.ndarray) -> np.ndarray:
            result = np.eye(4)
            result[:3, :3], result[:3, 3] = turn @ pose[:3, :3], self.scale * turn @ pose[:3, 3] + self.position
            return result

        common = {"view_rotation": scene.view_rotation @ turn.T, "near": scene.near * self.scale}
        if scene.ndc is not None:
            frame = Ndc(placed(scene.ndc.camera_to_world), scene.ndc.focal, scene.ndc.near * self.scale)
            return replace(scene, ndc=frame, **common)
        return replace(scene, grid_to_world=placed(scene.grid_to_world), voxel_size=scene.voxel_size * self.scale, **common)

    @property
    def centre(self) -> np.ndarray:
        if self.scene.ndc is not None:
            pose = self.moved.ndc.camera_to_world  # type: ignore[union-attr]
            return pose[:3, 3] - 2 * self.scene.ndc.near * self.scale * pose[:3, 2]
        return self.moved.box.corners().mean(axis=0)


@dataclass(frozen=True, eq=False)
class Wrong:
    """A scene with a transform that no volume can have."""

    scene: Scene
    matrix: np.ndarray
    first: bool = False


@dataclass(frozen=True, eq=False)
class Quad:
    """A rectangle across the picture's columns from `left` to `right`, at a depth along the camera's axis."""

    depth: float
    left: float
    right: float
    colour: tuple[float, float, float]
    opacity: float = 1.0

    def corners(self, camera: Camera) -> np.ndarray:
        edges = np.array([[self.left, -1], [self.right, -1], [self.right, camera.height + 1], [self.left, camera.height + 1]])
        plane = (edges - camera.centre) / camera.focal * [1, -1] * (self.depth if camera.projection == "perspective" else 1)
        local = np.concatenate([plane, np.full((4, 1), -self.depth)], axis=1)
        return local @ camera.camera_to_world[:3, :3].T + camera.camera_to_world[:3, 3]


def put_together(camera: Camera, volumes: Iterable[Standing], quads: Iterable[Quad]) -> np.ndarray:
    """The picture [H, W, 3] by the documented rule."""
    picture, depth = np.ones((camera.height, camera.width, 3)), np.full((camera.height, camera.width), 100.0)
    column = np.arange(camera.width) + 0.5
    glass: list[tuple[float, Quad | Standing]] = []
    for quad in quads:
        inside = (column > quad.left) & (column < quad.right)
        if quad.opacity < 1:
            glass.append((quad.depth, quad))
        else:
            covered = inside[None, :] & (quad.depth < depth)
            picture[covered], depth[covered] = quad.colour, quad.depth
    for volume in volumes:
        along = (camera.camera_to_world[:3, 3] - volume.centre) @ camera.camera_to_world[:3, 2]
        glass.append((np.inf if volume.first else along, volume))
    for _, thing in sorted(glass, key=lambda pair: -pair[0]):
        if isinstance(thing, Quad):
            seen = ((column > thing.left) & (column < thing.right))[None, :] & (thing.depth < depth)
            picture[seen] = thing.opacity * np.array(thing.colour) + (1 - thing.opacity) * picture[seen]
            continue
        truth = dense_march(thing.moved, camera, ends=depth)
        surface = halfway_depth(thing.moved, camera, depth)
        picture = np.clip(np.clip(truth.colour, 0, 1) + truth.transmittance[..., None] * picture, 0, 1)  # as a canvas clips
        depth = np.minimum(depth, surface)
    return picture


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page that draws what a test asks for."""
    folder = tmp_path_factory.mktemp("several")
    esbuild = [str(ROOT / "node_modules" / ".bin" / "esbuild"), "--bundle", "--format=iife", "--log-level=error"]
    texts = [f"--loader:.{suffix}=text" for suffix in ("glsl", "css", "html")]
    source = ROOT / "viewer" / "src"
    subprocess.run([*esbuild, *texts, f"--outfile={folder / 'page.js'}"], input=PAGE, cwd=source, text=True, check=True)
    (folder / "index.html").write_text(
        '<!doctype html><body style="margin:0"><canvas id="canvas" style="display:block"></canvas><script src="page.js"></script>'
    )
    return folder


def draw(
    page: Page,
    address: str,
    folder: Path,
    camera: Camera,
    volumes: list[Standing] | list[Wrong],
    quads: list[Quad],
    settings: dict[str, bool],
) -> np.ndarray:
    for i, volume in enumerate(volumes):
        write_bundle(volume.scene, [camera], folder / str(i))
    page.goto(address)
    page.evaluate(
        "asked => window.draw(asked)",
        {
            "volumes": [{"folder": str(i), "matrix": v.matrix.tolist(), "first": v.first} for i, v in enumerate(volumes)],
            "quads": [{"corners": q.corners(camera).tolist(), "colour": q.colour, "opacity": q.opacity} for q in quads],
            "settings": settings,
        },
    )
    return picture_of(page)


def small(diffuse: bool = False, opacity_correction: bool = False) -> Scene:
    return make_snerg((34, 30, 40), diffuse, angles=(0.1, 0.2, 0.3), opacity_correction=opacity_correction)


def cases() -> dict[str, tuple[Camera, list[Standing], list[Quad]]]:
    front = Camera(WIDTH, HEIGHT, (64.0, 64.0), (36.0, 27.0), looking((0.5, -7.0, 2.0), (0, 0, 0)), near=0.1)
    parallel = Camera(WIDTH, HEIGHT, (12.0, 12.0), (37.5, 25.5), looking((-3.0, -6.0, 3.0), (0, 0, 0)), "orthographic", near=0.1)
    frame = make_frame()
    ahead = replace(make_forward_cameras(frame, WIDTH, HEIGHT)[1], near=0.1)
    apart = [
        Standing(small(), (0.4, -0.3, 1.0), 1.0, (0.3, 1.8, 0.2)),
        Standing(small(True), (2.0, 0.5, -1.0), 0.6, (-0.2, -2.5, 0.1)),
    ]
    inside = [Standing(small(), (0.2, 0.1, 0.4), 1.7), Standing(small(True, True), (1.0, -0.5, 2.0), 0.7, (0.2, -0.1, 0.3))]
    quads = [Quad(5.0, 7, 30, (0.1, 0.6, 0.3)), Quad(7.3, 22, 45, (0.8, 0.2, 0.1)), Quad(8.0, 41, 72, (0.2, 0.3, 0.9))]
    glass = Quad(6.0, 15, 60, (0.9, 0.7, 0.1), 0.5)
    forward = Standing(make_forward(), (0, 0, 0.15), 0.8, (0.1, 0.4, 0.3))
    return {
        "before and behind": (front, apart, []),
        "one inside the other": (front, inside, []),
        "the outer one first": (front, [replace(inside[0], first=True), inside[1]], []),
        "parallel": (parallel, [*apart, *inside], []),
        "three and meshes": (front, [*inside, apart[1]], [*quads, glass]),
        "forward-facing, moved": (ahead, [forward], []),
        "forward-facing and meshes": (ahead, [forward], [Quad(2.2, 4, 34, (0.1, 0.6, 0.3)), Quad(6.0, 22, 60, (0.8, 0.2, 0.1))]),
        "forward-facing with a box in it": (ahead, [forward, Standing(small(), (0.3, 0.2, 0.1), 0.5, (0.8, 1.5, 1.6))], []),
    }


def compare(shown: np.ndarray, expected: np.ndarray) -> None:
    difference = np.abs(shown - expected)
    assert difference.mean() < 0.5 / 255
    assert np.mean(difference.max(axis=-1) < 3 / 255) > 0.997, "but where half of the light is gone at one sample or at the next"


@pytest.mark.hard_case(76)
@pytest.mark.parametrize("name", cases())
def test_volumes_and_meshes(page: Page, example: Path, tmp_path: Path, serve: Serve, name: str) -> None:
    camera, volumes, quads = cases()[name]
    shown = draw(page, serve(example), example, camera, volumes, quads, {})
    expected = put_together(camera, volumes, quads)
    compare(shown, expected)
    if volumes[-1].scene.ndc is None:
        corners = volumes[-1].moved.box.corners()
        low, high = np.array(page.evaluate("window.box"))
        assert (low <= corners.min(axis=0) + 1e-5).all() and (high >= corners.max(axis=0) - 1e-5).all(), "three.js knows how large it is"
        assert ((high - low) < 3 * np.ptp(corners, axis=0)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [{"antialias": True}, {"reversedDepthBuffer": True}, {"logarithmicDepthBuffer": True}, {"stencil": True}],
    ids=lambda settings: next(iter(settings)),
)
def test_any_kind_of_renderer(page: Page, example: Path, serve: Serve, settings: dict[str, bool]) -> None:
    camera, volumes, quads = cases()["three and meshes"]
    shown = draw(page, serve(example), example, camera, volumes, quads, settings)
    compare(shown, put_together(camera, volumes, quads))


@pytest.mark.parametrize(
    "matrix",
    [np.diag([1.0, 1.2, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0, 1.0]), np.eye(4) + 0.3 * np.eye(4, k=1)],
    ids=["uneven", "mirrored", "sheared"],
)
def test_what_a_volume_cannot_be_is_said(page: Page, example: Path, serve: Serve, matrix: np.ndarray) -> None:
    camera, volumes, _ = cases()["before and behind"]

    shown = draw(page, serve(example), example, camera, [Wrong(volumes[0].scene, matrix)], [], {})
    assert (shown == 1).all(), "it is not drawn wrong"
    assert page.evaluate("window.problems") == [
        "A SNeRG volume is scaled unevenly, sheared or mirrored, which it cannot be: give it the same scale along x, y and z."
    ]
