"""The viewer's numbers without a browser: rays and depths from its uniforms, cameras, layouts and images against Python's float64."""

from __future__ import annotations

import json
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from scenes import looking, make_cameras, make_forward, make_frame, make_snerg, rotation
from snerg.core.export.codecs import CodecSettings
from snerg.core.export.scene_files import indirection_image, write_scene
from snerg.core.geometry.camera import Camera
from snerg.core.scene.half_features import halve_features, restore_features
from snerg.core.scene.scene import Scene
from snerg.tests.web.test_modules import ROOT, node

SOURCE = """
import { readFileSync } from "node:fs";
const from = (folder) => ({ read: async (name) => new Uint8Array(readFileSync(`${folder}/${name}`)) });
"""


def description(scene: Scene) -> str:
    """A script's expression for what `readScene` makes of a scene."""
    value = {
        "voxel_size": scene.voxel_size,
        "shape": scene.shape,
        "near": scene.near,
        "ndc": None if scene.ndc is None else scene.ndc.to_json(),
    }
    rows = scene.grid_to_world.tolist()
    turn = np.eye(4)
    turn[:3, :3] = scene.view_rotation
    return f"{{ ...{json.dumps(value)}, gridToWorld: matrixOfRows({rows}), networkFromWorld: matrixOfRows({turn.tolist()}) }}"


def projection(camera: Camera, near: float, far: float) -> list[list[float]]:
    """OpenGL's projection matrix of a camera."""
    (fx, fy), (cx, cy), w, h = camera.focal, camera.centre, camera.width, camera.height
    x, y, a, b = 2 * fx / w, 2 * fy / h, 2 * cx / w - 1, 1 - 2 * cy / h
    if camera.projection == "orthographic":
        return [[x, 0, 0, a], [0, y, 0, b], [0, 0, -2 / (far - near), -(far + near) / (far - near)], [0, 0, 0, 1]]
    return [[x, 0, -a, 0], [0, y, -b, 0], [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)], [0, 0, -1, 0]]


def uniforms(scene: Scene, camera: Camera, standing: np.ndarray, near: float, far: float, reverse: bool = False) -> dict[str, Any]:
    """What `viewUniforms` gives the shader, matrices as rows; standing: [4, 4], of the volume."""
    return node(f"""
        import {{ Camera, Vector4 }} from "three";
        import {{ matrixOfRows }} from "./data/scene";
        import {{ similarity, viewUniforms }} from "./volume/pose";
        const camera = new Camera();
        camera.matrixWorld.copy(matrixOfRows({camera.camera_to_world.tolist()}));
        camera.projectionMatrix.copy(matrixOfRows({projection(camera, near, far)}));
        Object.assign(camera, {{ near: {near}, far: {far} }});
        const standing = similarity(matrixOfRows({standing.tolist()}));
        const viewport = new Vector4(7, 11, {camera.width}, {camera.height});
        const found = viewUniforms({description(scene)}, standing, camera, viewport, {json.dumps(reverse)});
        for (const [name, value] of Object.entries(found)) {{
          if (value.isMatrix4) found[name] = value.clone().transpose().elements;
          else if (value.toArray) found[name] = value.toArray();
        }}
        console.log(JSON.stringify(found));
    """)


def place(angles: tuple[float, float, float], scale: float, position: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * rotation(angles), position
    return matrix


PLACES = [np.eye(4), place((0.3, -0.5, 0.9), 2.5, (1.0, -2.0, 0.5)), place((0.1, 0.2, -0.3), 0.01, (1e6, -1e6, 1e6))]


@pytest.mark.hard_case(2, 3, 6, 42)
@pytest.mark.parametrize("standing", PLACES, ids=["as it is", "moved", "tiny and far"])
@pytest.mark.parametrize("index", [1, 2], ids=["shifted", "parallel"])
def test_rays_from_the_uniforms_are_the_cameras(standing: np.ndarray, index: int) -> None:
    """As march.glsl makes them of a pixel, in voxels of the volume where it stands; clip planes, depth and the box's corners, too."""
    scene = replace(make_snerg((34, 30, 40), angles=(0.2, 0.4, -0.3), centre=(0.3, 0.1, -0.2)), near=0.4)
    scale = float(np.cbrt(np.linalg.det(standing[:3, :3])))
    camera = make_cameras(width=160, height=120)[index].moved(standing)
    near, far = 0.8 * scale, 9.0 * scale
    found = uniforms(scene, camera, standing, near, far)
    pixels = np.array([[0, 0], [159, 0], [33, 101], [80, 60]])
    fragment = np.stack([7 + pixels[:, 0] + 0.5, 11 + 120 - pixels[:, 1] - 0.5], axis=-1)
    left, bottom, height = found["viewport"]
    pixel = np.stack([fragment[:, 0] - left, height + bottom - fragment[:, 1]], axis=-1)
    plane = (pixel - found["principalPoint"]) / found["focal"] * [1, -1]
    turn = np.array(found["raySpaceFromCamera"]).reshape(4, 4)[:3, :3]
    if found["orthographic"]:
        view = np.tile([0.0, 0, -1], (4, 1))
        origin = found["cameraPosition"] + np.concatenate([plane, np.zeros((4, 1))], axis=1) @ turn.T
    else:
        view = np.concatenate([plane, -np.ones((4, 1))], axis=1)
        view /= np.linalg.norm(view, axis=1, keepdims=True)
        origin = np.tile(found["cameraPosition"], (4, 1))
    grid, unit = standing @ scene.grid_to_world, scene.voxel_size * scale
    axes = grid[:3, :3] / scale
    origins, directions = camera.rays(pixels)
    expected = (origins - grid[:3, 3]) @ axes / unit
    assert view @ turn.T == pytest.approx(directions @ axes, abs=1e-9)
    moved = float(((origin - expected) * (view @ turn.T)).sum(axis=1)[0])
    assert np.abs(origin - expected - moved * (view @ turn.T)).max() < 1e-4 and (moved == pytest.approx(0, abs=1e-4) or index == 2)
    assert found["clipPlanes"] == pytest.approx([near / unit - moved, far / unit - moved], abs=1e-4)
    assert found["nearDistance"] == pytest.approx(0.4 / scene.voxel_size - moved, abs=1e-4)
    network = np.array(found["networkFromCamera"]).reshape(4, 4)[:3, :3]
    trained = directions @ (standing[:3, :3] / scale) @ scene.view_rotation.T
    assert view @ network.T == pytest.approx(trained, abs=1e-9)
    corner = np.array([*scene.shape, 1.0]) * [1, 0, 1, 1]
    world = grid @ np.array([*(corner[:3] * scene.voxel_size), 1.0])
    clip = np.array(projection(camera, near, far)) @ np.linalg.inv(camera.camera_to_world) @ world
    got = np.array(found["clipFromGrid"]).reshape(4, 4) @ corner
    assert got[:2] / got[3] == pytest.approx(clip[:2] / clip[3], abs=1e-6)
    for reverse in (False, True):
        x, y, z, w = uniforms(scene, camera, standing, near, far, reverse)["depthTerms"]
        depth = 3.0 * scale
        view_depth = depth / unit - moved
        ndc = x - y * view_depth if index == 2 else x / view_depth - y
        p = np.array(projection(camera, near, far))
        truth = (p @ [0, 0, -depth, 1])[2] / (p @ [0, 0, -depth, 1])[3]
        assert ndc == pytest.approx(truth, abs=1e-6) and (z, w) == ((1, 0) if reverse else (0.5, 0.5))


@pytest.mark.hard_case(6)
def test_a_camera_in_front_of_a_parallel_view_is_moved_to_the_box_and_no_further() -> None:
    """Single precision resolves rays near the box; what stands before a camera in the box stays before it."""
    scene = make_snerg((34, 30, 40))
    for distance, moves in ((500.0, True), (0.5, False)):
        camera = Camera(100, 100, (30.0, 30.0), (50, 50), looking((0, -distance, 0), (0, 0, 0)), "orthographic")
        found = uniforms(scene, camera, np.eye(4), 0.1, 1000.0)
        position = np.array(found["cameraPosition"])
        half = np.linalg.norm(np.array(scene.shape) / 2)
        ahead = (np.array(scene.shape) / 2 - position) @ [0, 1, 0]
        assert ahead == pytest.approx(half + 1 if moves else distance / scene.voxel_size, rel=1e-6)


@pytest.mark.hard_case(9)
def test_a_forward_facing_scenes_rays_are_in_units_of_its_near_plane() -> None:
    scene, standing = make_forward(), place((0.3, -0.5, 0.9), 2.5, (1.0, -2.0, 0.5))
    frame = make_frame()
    camera = Camera(100, 80, (90.0, 90.0), (50, 40), frame.camera_to_world).moved(standing)
    found = uniforms(scene, camera, standing, 1.0, 100.0)
    assert np.array(found["cameraPosition"]) == pytest.approx([0, 0, 0], abs=1e-9)
    assert np.array(found["raySpaceFromCamera"]).reshape(4, 4) == pytest.approx(np.eye(4), abs=1e-9)
    assert found["clipPlanes"] == pytest.approx([1 / (2.5 * frame.near), 100 / (2.5 * frame.near)])
    assert found["nearDistance"] == pytest.approx(scene.near / frame.near)


def test_uneven_mirrored_and_sheared_transforms_are_refused_at_the_edge() -> None:
    turn = rotation((0.3, 0.2, 0.4))
    cases = {
        "even": (np.diag([2.0, 2, 2]), True),
        "nearly": (np.diag([2.0, 2, 2 * (1 + 5e-5)]), True),
        "uneven": (np.diag([2.0, 2, 2 * (1 + 5e-4)]), False),
        "mirrored": (np.diag([-2.0, 2, 2]), False),
        "flat": (np.diag([2.0, 2, 0]), False),
        "sheared": (np.array([[1, 1e-3, 0], [0, 1, 0], [0, 0, 1]]), False),
        "hardly sheared": (np.array([[1, 5e-5, 0], [0, 1, 0], [0, 0, 1]]), True),
    }
    matrices = []
    for matrix, _ in cases.values():
        whole = np.eye(4)
        whole[:3, :3], whole[:3, 3] = turn @ matrix, (5, 6, 7)
        matrices.append(whole.tolist())
    found = node(f"""
        import {{ matrixOfRows }} from "./data/scene";
        import {{ similarity }} from "./volume/pose";
        const parts = (s) => s && [s.scale, s.position.toArray(), s.rotation.elements];
        const of = (rows) => parts(similarity(matrixOfRows(rows)));
        console.log(JSON.stringify({json.dumps(matrices)}.map(of)));
    """)
    assert {name: value is not None for name, value in zip(cases, found, strict=True)} == {name: good for name, (_, good) in cases.items()}
    scale, position, elements = found[0]
    assert scale == pytest.approx(2) and position == [5, 6, 7] and np.array(elements).reshape(4, 4).T[:3, :3] == pytest.approx(turn)


@pytest.mark.hard_case(2, 3)
@pytest.mark.parametrize("y_up", [False, True])
def test_an_exported_camera_projects_as_it_did(tmp_path: Path, y_up: bool) -> None:
    """As a camera of three.js, through its matrices; and as it was read from cameras.json."""
    cameras = [*make_cameras(width=160, height=120)[:3], replace(make_cameras()[0], near=0.5, far=20.0, name="")]
    (tmp_path / "cameras.json").write_text(json.dumps({"cameras": [c.to_json() for c in cameras], "coarse": True}))
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (12, 3))
    shown = np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1) if y_up else points
    found = node(f"""{SOURCE}
        import {{ Vector3 }} from "three";
        import {{ readCameras }} from "./data/cameras";
        import {{ threeCamera }} from "./volume/three_camera";
        const list = await readCameras(from({json.dumps(str(tmp_path))}), "cameras.json");
        const of = (camera) => {{
          const made = threeCamera(camera, {{ yUp: {json.dumps(y_up)}, far: 500 }});
          const seen = {json.dumps(shown.tolist())}.map((p) => new Vector3(...p).project(made).toArray());
          return {{ name: camera.name, near: made.near, far: made.far, seen }};
        }};
        console.log(JSON.stringify({{ coarse: list.coarse, cameras: list.cameras.map(of) }}));
    """)
    assert found["coarse"] is True and [c["name"] for c in found["cameras"]][3] == "Camera 4"
    for camera, got in zip(cameras, found["cameras"], strict=True):
        pixels, depth = camera.project(points)
        ndc = np.array(got["seen"])
        assert (ndc[:, 0] + 1) / 2 * camera.width == pytest.approx(pixels[:, 0], abs=1e-3)
        assert (1 - ndc[:, 1]) / 2 * camera.height == pytest.approx(pixels[:, 1], abs=1e-3)
        far = 20.0 if camera.far < np.inf else 500.0
        assert got["far"] == far and got["near"] == pytest.approx(max(camera.near, far * 1e-5))
        p = np.array(projection(camera, got["near"], far))
        clip = np.stack([np.zeros(12), np.zeros(12), -depth, np.ones(12)]).T @ p.T
        assert ndc[:, 2] == pytest.approx(clip[:, 2] / clip[:, 3], abs=1e-6)


@pytest.mark.hard_case(54)
def test_the_third_byte_of_an_indirection_is_read(tmp_path: Path) -> None:
    cells = np.array([-1, 0, 254, 255, 65534, 65535, 65536, 0x010203, 2**18 - 1, 2**24 - 2], np.int32)
    grid = np.broadcast_to(cells[:, None, None], (10, 2, 3)).copy()
    grid[:, 1, 2] = cells[::-1]
    Image.fromarray(indirection_image(grid)).save(tmp_path / "indirection.png")
    read = f"""{SOURCE}
        import {{ readIndirection }} from "./data/scene";
        const scene = (cells) => ({{ blocks: [10, 2, 3], cells }});
        const read = (cells) => readIndirection(from({json.dumps(str(tmp_path))}), "indirection.png", scene(cells));
        let problem = "";
        await read(2 ** 24 - 2).catch((error) => {{ problem = error.message; }});
        console.log(JSON.stringify([Array.from(await read(2 ** 24 - 1)), problem]));
    """
    found, problem = node(read)
    assert np.array(found).reshape(3, 2, 10).transpose(2, 1, 0).tolist() == grid.tolist()
    assert "points outside the atlas" in problem


@pytest.mark.hard_case(54, 55)
def test_each_cell_has_a_place_of_its_own_past_two_bytes_of_cells() -> None:
    """Golden places: x fastest, then y, z and pages; of few cells, all, and of 2^16 and 2^18, some."""
    cases = [(30, 256, 5), (513, 256, 5), (2**16 + 1, 2048, 5), (2**18, 1024, 15)]
    wanted = [[0, 1, cells // 2, cells - 2, cells - 1] for cells, *_ in cases]
    found = node(f"""
        import {{ atlasLayout, cellPosition }} from "./volume/atlas_layout";
        const of = (c, i) => {{ const l = atlasLayout(...c); return [l, {json.dumps(wanted)}[i].map((cell) => cellPosition(l, cell))]; }};
        console.log(JSON.stringify({json.dumps(cases)}.map(of)));
    """)
    for (cells, limit, pages), numbers, (layout, places) in zip(cases, wanted, found, strict=True):
        (bx, by, bz), each = layout["blocks"], layout["cellsPerPage"]
        assert max(bx, by, bz) * 32 <= limit and layout["pages"] <= pages and layout["pages"] * each >= cells
        for cell, (page, x, y, z) in zip(numbers, places, strict=True):
            assert page * each + x + bx * (y + by * z) == cell and x < bx and y < by and z < bz and page < layout["pages"]
            assert x + bx * (y + by * z) < each


def test_features_at_half_the_resolution_are_restored_as_python_does(tmp_path: Path) -> None:
    """Of two cells side by side and one below: each voxel's own alpha times the straight value of its group, rounded to nearest."""
    scene = make_snerg((40, 35, 31))
    write_scene(scene, tmp_path / "scene", codec=CodecSettings("png", half_features=True))
    value = json.loads((tmp_path / "scene" / "scene.json").read_text())
    bx, by, _ = value["atlas_blocks"]
    found = node(f"""{SOURCE}
        import {{ readSlice, sliceOrder }} from "./data/slices";
        const scene = {json.dumps({"atlas_blocks": value["atlas_blocks"], "codec": value["codec"], "network": True})};
        const slices = [];
        for (const i of [0, 3, 7]) {{
          const texels = await readSlice(scene, from({json.dumps(str(tmp_path / "scene"))}), "", i);
          slices.push([Array.from(texels.rgba), Array.from(texels.feature)]);
        }}
        console.log(JSON.stringify([sliceOrder(scene).length, slices]));
    """)
    assert found[0] == 8 * value["atlas_blocks"][2]
    for index, (rgba, feature) in zip((0, 3, 7), found[1], strict=True):
        for kind, values in (("rgba", rgba), ("feature", feature)):
            texels = np.array(values, np.uint8).reshape(4, by, 32, bx, 32, 4)  # z, block y, y, block x, x
            for cell in range(min(len(scene.cells), bx * by)):
                own = scene.cells[cell][:, :, 4 * index : 4 * index + 4]
                expected = own[..., [0, 1, 2, 7]] if kind == "rgba" else restore_features(halve_features(own), own[..., 7])
                assert np.array_equal(texels[:, cell // bx, :, cell % bx].transpose(2, 1, 0, 3), expected), (index, kind, cell)


@pytest.mark.hard_case(58)
def test_what_a_lossy_image_adds_is_limited_to_alpha() -> None:
    """mergeAlpha on a pixel that a codec brightened; a lossless codec's stay."""
    source = (ROOT / "viewer" / "src" / "data" / "slices.ts").read_text()
    body = source[source.index("function mergeGrey") : source.index("/** One byte a pixel")] + source[source.index("function mergeAlpha") :]
    script = f"""
        {body.replace(": SliceTexels", ": any")}
        const run = (bounded) => {{
          const found = mergeAlpha(new Uint8Array([40]), new Uint8ClampedArray([50, 40, 3, 255]),
            new Uint8ClampedArray([45, 2, 41, 255, 60, 60, 60, 255]), bounded);
          return [Array.from(found.rgba), Array.from(found.feature)];
        }};
        console.log(JSON.stringify([run(true), run(false)]));
    """
    bounded, exact = node_typed(script)
    assert bounded == [[40, 40, 3, 40], [40, 2, 40, 40]] and exact == [[50, 40, 3, 40], [45, 2, 41, 60]]


def png_with_every_filter(pixels: np.ndarray) -> bytes:
    """A PNG of [H, W, C] whose rows have the filters 0 to 4 in turn, by the specification's formulas."""
    height, width, channels = pixels.shape
    rows = np.pad(pixels.astype(int).reshape(height, -1), ((1, 0), (channels, 0)))
    data = bytearray()
    for y in range(height):
        above, row = rows[y], rows[y + 1]
        data.append(y % 5)
        for i in range(channels, len(row)):
            a, b, c = int(row[i - channels]), int(above[i]), int(above[i - channels])
            paeth = min(((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c)))[2]
            data.append((int(row[i]) - (0, a, b, (a + b) // 2, paeth)[y % 5]) % 256)
    kind = {1: 0, 3: 2, 4: 6}[channels]

    def chunk(name: bytes, body: bytes) -> bytes:
        return len(body).to_bytes(4, "big") + name + body + zlib.crc32(name + body).to_bytes(4, "big")

    header = width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, kind, 0, 0, 0])
    packed = zlib.compress(bytes(data))
    middle = chunk(b"IDAT", packed[:20]) + chunk(b"IDAT", packed[20:])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + middle + chunk(b"IEND", b"")


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_each_filter_of_a_png_is_undone(tmp_path: Path, channels: int) -> None:
    draw = np.random.default_rng(channels)
    pixels = draw.integers(0, 256, (23, 17, channels)).astype(np.uint8)
    pixels[10:] = draw.integers(0, 3, (13, 17, channels))  # ties
    (tmp_path / "it.png").write_bytes(png_with_every_filter(pixels))
    assert np.array_equal(np.asarray(Image.open(tmp_path / "it.png")).reshape(pixels.shape), pixels)
    found = node(f"""{SOURCE}
        import {{ decodePng }} from "./data/png";
        const bytes = await from({json.dumps(str(tmp_path))}).read("it.png");
        console.log(JSON.stringify(Array.from(await decodePng(bytes, "it", 17, 23, {channels}))));
    """)
    assert found == pixels.reshape(-1).tolist()


def node_typed(script: str) -> Any:
    """As `node`, of TypeScript."""
    esbuild = [str(ROOT / "node_modules" / ".bin" / "esbuild"), "--loader=ts", "--format=esm"]
    plain = subprocess.run(esbuild, input=script, capture_output=True, text=True, check=True).stdout
    return json.loads(subprocess.run(["node", "--input-type=module"], input=plain, capture_output=True, text=True, check=True).stdout)


def test_no_place_takes_more_than_eight_bits() -> None:
    """Whatever a device says that it holds."""
    found = node("""
        import { atlasLayout } from "./volume/atlas_layout";
        console.log(JSON.stringify(atlasLayout(256 ** 3 + 1, 16384, 7)));
    """)
    assert max(found["blocks"]) <= 255 and found["pages"] * found["cellsPerPage"] > 256**3


def test_distances_end_at_what_a_byte_holds() -> None:
    found = node("""
        import { chebyshevDistance } from "./volume/distance";
        const row = (n, at) => Array.from(chebyshevDistance(Array.from({ length: n }, (_, i) => (i === at ? 1 : 0)), [n, 1, 1]));
        console.log(JSON.stringify([row(300, 0), row(3, -1)]));
    """)
    assert found == [[min(i, 255) for i in range(300)], [255] * 3]
