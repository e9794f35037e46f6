"""The page's stand-in for what has not arrived, its drafts and its averages, against float64 computations."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes import random_network, snerg_from_volume
from snerg.core.export.scene_files import write_scene
from snerg.core.scene.scene import Scene
from snerg.tests.web.test_modules import node
from snerg.tests.web.test_numbers import SOURCE

BLOCKS = [(0, 0, 0), (3, 1, 3), (4, 0, 5), (1, 0, 4), (4, 1, 0)]  # of the whole scene: in the first coarse block, its corner, and others


def coarse(network: bool, square_roots: bool) -> Scene:
    """Random values in a grid of 2 x 1 x 2 blocks of which one is empty: clear, thin, half and fully opaque, in lumps."""
    draw = np.random.default_rng(4)
    alpha = np.kron(draw.choice([0, 0, 3, 90, 200, 255], (17, 6, 20)), np.ones((2, 2, 2), int))
    alpha = np.where(alpha > 0, np.clip(alpha + draw.integers(-2, 3, alpha.shape), 1, 255), 0)[..., None]
    values = (draw.random((*alpha.shape[:3], 7 if network else 3)) * (alpha + 0.99)).astype(int)
    values = np.concatenate([values, alpha], axis=-1).astype(np.uint8)
    values[29:, :, :31] = 0  # also what an apron of the empty block would hold
    given = {"grid_to_world": np.eye(4), "voxel_size": 0.2, "square_roots": square_roots}
    return snerg_from_volume(values, random_network(1) if network else None, **given)


def dense(scene: Scene) -> NDArray:
    """The scene's values in levels of 255, float64 [X + 2, Y + 2, Z + 2, C], with a border of zeros; squared where roots are stored."""
    values = np.zeros((*(30 * n + 2 for n in scene.indirection.shape), scene.cells.shape[-1]))
    for place in np.argwhere(scene.indirection >= 0):
        x, y, z = place * 30 + 1
        values[x : x + 30, y : y + 30, z : z + 30] = scene.cells[scene.indirection[tuple(place)], 1:-1, 1:-1, 1:-1]
    return values**2 / 255 if scene.square_roots else values


def between(values: NDArray, block: tuple[int, int, int]) -> NDArray:
    """Trilinear values at the 32^3 voxels of a block's cell, a quarter of a coarse voxel apart: [x, y, z, C]."""
    for axis, n in enumerate(block):
        place = (30 * n + np.arange(32) - 1 + 0.5) / 4 - 0.5 + 1  # of voxels' centres; 1 for the border
        low = np.clip(np.floor(place).astype(int), 0, values.shape[axis] - 2)
        part = np.clip(place - low, 0, 1).reshape([-1 if i == axis else 1 for i in range(4)])
        values = (1 - part) * values.take(low, axis) + part * values.take(low + 1, axis)
    return values


def share(alpha: NDArray) -> NDArray:
    """Of premultiplied values, what a voxel keeps of a coarse one of alpha 0 to 255, which lets as much light pass as four."""
    a = np.clip(alpha / 255, 0, 1)
    kept = np.where(a < 0.5, -np.expm1(np.log1p(-np.minimum(a, 0.5)) / 4), 1 - (1 - a) ** 0.25)
    return np.where(a > 1e-9, kept / np.maximum(a, 1e-9), 0)


@pytest.mark.parametrize(("network", "square_roots"), [(False, False), (True, False), (True, True)], ids=["diffuse", "network", "roots"])
def test_a_stand_in_has_the_values_between_coarse_voxels(tmp_path: Path, network: bool, square_roots: bool) -> None:
    """At each voxel of a cell and its apron, colour, alpha and features, to half a level; where the coarse scene is empty, nothing."""
    scene = coarse(network, square_roots)
    write_scene(scene, tmp_path / "coarse")
    found = node(f"""{SOURCE}
        import {{ SnergScene }} from "./data/snerg_scene";
        import {{ StandIn }} from "./volume/stand_in";
        const scene = await SnergScene.load(from({json.dumps(str(tmp_path / "coarse"))}));
        const standIn = await StandIn.read(scene, new AbortController().signal);
        const text = (values) => values && Buffer.from(values).toString("base64");
        const cells = {json.dumps(BLOCKS)}.map((block) => standIn.texels(block));
        console.log(JSON.stringify(cells.map((cell) => cell && [text(cell.rgba), text(cell.feature)])));
    """)
    whole, some = dense(scene), 0
    assert [made is None for made in found] == [False] * 4 + [True]
    for block, made in zip(BLOCKS[:-1], found, strict=False):
        rgba, feature = (
            None if text is None else np.frombuffer(base64.b64decode(text), np.uint8).reshape(32, 32, 32, 4).transpose(2, 1, 0, 3)
            for text in made
        )
        assert (feature is None) == (not network)
        got = np.concatenate([rgba[..., :3], *([] if feature is None else [feature]), rgba[..., 3:]], axis=-1).astype(float)
        wanted = between(whole, block)
        alpha = wanted[..., -1:]
        if square_roots:
            assert np.abs(got - np.sqrt(255 * share(alpha) * wanted)).max() < 0.51
        else:  # the share is that of a whole level of alpha
            assert (got > share(np.maximum(alpha - 0.5, 0)) * wanted - 0.51).all() and (got < share(alpha + 0.5) * wanted + 0.51).all()
            assert np.abs(got - share(alpha) * wanted).mean() < 1  # it is steep where alpha is nearly 255
        some += int((got[..., -1] > 20).sum())
    assert some > 10_000


def test_what_stands_in_is_a_quarter_of_the_scene_and_of_its_kind() -> None:
    scene = {"shape": [121, 40, 500], "voxel_size": 0.05, "network": {}, "square_roots": False}
    good = {"blocks": [2, 1, 5], "voxel_size": 0.2, "network": {}, "square_roots": False}
    cases = {
        "it": (good, True),
        "rounding": ({**good, "voxel_size": 0.2 * (1 + 5e-5)}, True),
        "another size": ({**good, "voxel_size": 0.2 * (1 + 2e-4)}, False),
        "half": ({**good, "voxel_size": 0.1}, False),
        "too few blocks": ({**good, "blocks": [1, 1, 5]}, False),
        "too many blocks": ({**good, "blocks": [2, 1, 6]}, False),
        "diffuse": ({**good, "network": None}, False),
        "roots": ({**good, "square_roots": True}, False),
    }
    found = node(f"""
        import {{ standsIn }} from "./volume/stand_in";
        console.log(JSON.stringify({json.dumps([case for case, _ in cases.values()])}.map((one) => standsIn(one, {json.dumps(scene)}))));
    """)
    assert dict(zip(cases, found, strict=True)) == {name: expected for name, (_, expected) in cases.items()}


def test_the_edges_of_a_drafts_steps() -> None:
    """1000 pixels: what 40 and 20 milliseconds are just not, and just are; and three images in a row."""
    steps = node("""
        import { DraftResolution } from "./viewer/draft_resolution";
        const of = (made, ...milliseconds) => milliseconds.map((time) => made.next(time === null ? null : time / 1000, 1000));
        const fine = new DraftResolution();
        const rest = [of(fine, null, 20), of(fine, 40), of(fine, 40.01), of(fine, 20, 20, 20, 20), of(fine, 19.9, 19.9), of(fine, 20)];
        rest.push(of(fine, 19.9, 19.9, 19.9), of(fine, 161), of(fine, 700, 1e6), of(fine, 1, 1, 1, 1, 1, 1, 1, 1, 1));
        console.log(JSON.stringify([...rest, of(new DraftResolution(), 20.01), of(new DraftResolution(), 80.01)]));
    """)
    assert steps == [
        [0.125, 1],
        [1],
        [0.5],
        [0.5, 0.5, 0.5, 0.5],
        [0.5, 0.5],
        [0.5],
        [0.5, 0.5, 1],
        [0.25],  # 161 is 40.25 at a half
        [0.125, 0.125],
        [0.125, 0.125, 0.25, 0.25, 0.25, 0.5, 0.5, 0.5, 1],
        [0.5],
        [0.25],
    ]


def test_a_jittered_camera_sees_what_lies_that_far_beside_each_pixel() -> None:
    """Of three.js, in perspective and parallel; its matrices are as they were behind it."""
    found = node("""
        import { OrthographicCamera, PerspectiveCamera, Vector3 } from "three";
        import { withJitter } from "./viewer/smoothing";
        const cameras = [new PerspectiveCamera(40, 2, 0.1, 50), new OrthographicCamera(-3, 5, 2, -1, 0.1, 50)];
        const points = [[0.3, 0.2, -2], [-0.7, 0.4, -9]].map((place) => new Vector3(...place));
        const seen = (camera) => points.map((point) => point.clone().project(camera).toArray());
        console.log(JSON.stringify(cameras.map((camera) => {
          camera.updateProjectionMatrix();
          const before = [camera.projectionMatrix, camera.projectionMatrixInverse].map((matrix) => [...matrix.elements]);
          const [still, found] = [seen(camera), []];
          withJitter(camera, [0.3, -0.45], 80, 40, () => {
            found.push(seen(camera), points.map((p) => p.clone().project(camera).unproject(camera).toArray()));
          });
          const after = [camera.projectionMatrix, camera.projectionMatrixInverse].map((matrix) => [...matrix.elements]);
          return { still, moved: found[0], back: found[1], kept: JSON.stringify(before) === JSON.stringify(after) };
        })));
    """)
    for camera in found:
        pixels = (np.array(camera["moved"]) - np.array(camera["still"])) * [80 / 2, 40 / 2, 1]
        assert pixels == pytest.approx(np.tile([-0.3, 0.45, 0], (2, 1)), abs=1e-9)
        assert np.array(camera["back"]) == pytest.approx(np.array([[0.3, 0.2, -2], [-0.7, 0.4, -9]]), abs=1e-6) and camera["kept"]


def test_an_average_is_done_when_it_has_all_its_images() -> None:
    """Where a card adds up no floats, there is none."""
    found = node("""
        import { Accumulation } from "./viewer/smoothing";
        const of = (extension) => new Accumulation({ getExtension: () => extension });
        const one = of({});
        const told = [one.done(16), one.done(1)];
        one.begin(16, 100, 8, 6);
        told.push(one.count, one.done(16), one.sample.width, one.sum.height);
        one.taken = 7;
        told.push(one.done(16));
        one.taken = 8;
        told.push(one.done(16), one.done(1));
        one.reset();
        told.push(one.done(16));
        const none = of(null);
        none.begin(16, 1, 8, 6);
        one.begin(16, 400, 8, 6);
        console.log(JSON.stringify([...told, none.count, none.done(16), one.count, one.done(16)]));
    """)
    assert found == [False, True, 8, False, 8, 6, False, True, True, False, 1, True, 1, True]
