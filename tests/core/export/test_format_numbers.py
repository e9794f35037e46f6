"""The numbers of the format past what bytes, halves and floats hold, by golden values that are written out or counted in whole numbers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scenes import make_frame, make_snerg, rotation, snerg_from_volume
from snerg.core.errors import SnergError
from snerg.core.export.atlas import MAX_ATLAS_CELLS, atlas_blocks, atlas_slices, cells_from_slices, slice_count
from snerg.core.export.atlas_files import read_float_cells
from snerg.core.export.codecs import CodecSettings, images_of_slice, slice_of_images
from snerg.core.export.reference_axes import reorient, viewer_axes
from snerg.core.export.scene_files import indirection_image, read_scene, write_scene
from snerg.core.export.scene_json import MAX_BLOCKS, MAX_WEIGHT, check_blocks
from snerg.core.export.vdb import density_of, opacity, straight_colour, voxel_transform
from snerg.core.io.images import read_image
from snerg.core.rendering.render import march_rays
from snerg.core.scene.scene import Scene, blocks_of

GOLDEN = {  # cell to R, G, B
    -1: (0, 0, 0),
    0: (1, 0, 0),
    254: (255, 0, 0),
    255: (0, 1, 0),
    256: (1, 1, 0),
    65534: (255, 255, 0),
    65535: (0, 0, 1),
    65536: (1, 0, 1),
    0x010203: (4, 2, 1),
    2**24 - 2: (255, 255, 255),
}


@pytest.mark.hard_case(54)
def test_the_bytes_of_an_indirection_are_golden() -> None:
    """The third byte begins at 2^16 cells; x goes along a row, y and then z down."""
    cells = np.array(list(GOLDEN), np.int32)
    assert indirection_image(cells.reshape(-1, 1, 1))[0].tolist() == [list(colour) for colour in GOLDEN.values()]
    grid = np.arange(2 * 3 * 4, dtype=np.int32).reshape(2, 3, 4) + 65530  # [x, y, z]
    pixels = indirection_image(grid).astype(int)
    assert pixels.shape == (12, 2, 3)
    for x, y, z in np.ndindex(2, 3, 4):
        assert pixels[z * 3 + y, x] @ [1, 256, 65536] == grid[x, y, z] + 1


@pytest.mark.hard_case(54)
def test_more_than_two_bytes_of_cells_are_read_back(tmp_path: Path) -> None:
    """A folder whose indirection points past 2^16 cells; the atlas itself is not needed for that."""
    scene = snerg_from_volume(np.full((90, 60, 35, 4), 9, np.uint8), None, grid_to_world=np.eye(4), voxel_size=0.1)
    write_scene(scene, tmp_path / "scene")
    moved = scene.indirection + 65530
    Image.fromarray(indirection_image(moved)).save(tmp_path / "scene" / "indirection.png")
    with pytest.raises(SnergError, match="outside its atlas"):
        read_scene(tmp_path / "scene")
    from snerg.core.export.scene_files import _read_indirection

    assert np.array_equal(_read_indirection(tmp_path / "scene" / "indirection.png", blocks_of(scene.shape)), moved)


def test_an_atlas_is_nearly_a_cube_of_at_most_64_cells_a_side() -> None:
    for cells, blocks in ((0, (1, 1, 1)), (1, (1, 1, 1)), (8, (2, 2, 2)), (9, (2, 3, 2)), (65536, (40, 41, 40)), (64**3, (64, 64, 64))):
        assert atlas_blocks(cells) == blocks
        assert slice_count(blocks) == blocks[2] * 8
    for cells in (*range(1, 2000, 37), 65535, 65537, 250_000, 64**3 - 1):
        x, y, z = atlas_blocks(cells)
        assert cells <= x * y * z <= 1.5 * cells + 8 and 1 <= min(x, y, z) <= max(x, y, z) <= MAX_ATLAS_CELLS == 64
    with pytest.raises(SnergError, match="262145 macroblocks"):
        atlas_blocks(64**3 + 1)


def test_each_voxel_of_an_atlas_stands_where_its_cell_and_its_place_say() -> None:
    """Cell i at (i mod bx, i / bx mod by, i / (bx by)); a slice is four planes below each other; x goes along a row."""
    draw = np.random.default_rng(0)
    cells = draw.integers(0, 256, (7, 32, 32, 32, 4), np.uint8)
    blocks = (2, 3, 2)
    slices = list(atlas_slices(cells, blocks))
    assert len(slices) == 16 and slices[0].shape == (4 * 96, 64, 4)
    for _ in range(300):
        cell, x, y, z = (int(draw.integers(0, n)) for n in (12, 32, 32, 32))
        cx, cy, cz = cell % 2, cell // 2 % 3, cell // 6
        plane = 32 * cz + z
        found = slices[plane // 4][96 * (plane % 4) + 32 * cy + y, 32 * cx + x]
        assert found.tolist() == (cells[cell, x, y, z].tolist() if cell < 7 else [0] * 4)
    assert np.array_equal(cells_from_slices(lambda index: slices[index], blocks, 7, 4), cells)


def test_images_of_a_slice_hold_each_channel_where_the_format_says() -> None:
    pixels = np.arange(8 * 2 * 8, dtype=np.uint8).reshape(8, 2, 8)
    pixels[..., 7] = 255
    png, other = images_of_slice(pixels, CodecSettings()), images_of_slice(pixels, CodecSettings("webp"))
    assert np.array_equal(png["rgba"], pixels[..., [0, 1, 2, 7]]) and np.array_equal(png["feature"], pixels[..., 3:7])
    assert np.array_equal(other["rgb"], pixels[..., :3]) and np.array_equal(other["alpha"], pixels[..., 7])
    assert other["feature"].shape == (16, 2, 3) and np.array_equal(other["feature"][:8], pixels[..., 3:6])
    assert np.array_equal(other["feature"][8:], pixels[..., [6, 6, 6]])
    for codec, images in ((CodecSettings(), png), (CodecSettings("webp"), other)):
        assert np.array_equal(slice_of_images(images, codec), pixels)


@pytest.mark.hard_case(58)
def test_what_a_lossy_codec_adds_is_limited_to_alpha_and_a_lossless_ones_is_kept() -> None:
    alpha = np.full((8, 2), 40, np.uint8)
    images = {"alpha": alpha, "rgb": np.full((8, 2, 3), 50, np.uint8), "feature": np.full((16, 2, 3), 30, np.uint8)}
    images["feature"][8:] = 60
    assert slice_of_images(images, CodecSettings("jpeg", 90))[0, 0].tolist() == [40, 40, 40, 30, 30, 30, 40, 40]
    assert slice_of_images(images, CodecSettings("webp"))[0, 0].tolist() == [50, 50, 50, 30, 30, 30, 60, 40]
    exact = np.full((8, 2, 4), 40, np.uint8)
    assert images_of_slice(exact, CodecSettings("jpeg")), "a colour of its alpha is none above it"
    exact[3, 1, 1] = 41
    with pytest.raises(SnergError, match="above their alpha"):
        images_of_slice(exact, CodecSettings("jpeg"))


@pytest.mark.hard_case(59)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, np.nextafter(np.float32(1), np.float32(2)), -1e-30])
def test_floats_end_at_0_and_1(tmp_path: Path, bad: float) -> None:
    cells = np.zeros((1, 32, 32, 32, 4), np.float32)
    cells[0, 1, 1, 1] = 1.0
    np.save(tmp_path / "cells.npy", cells)
    assert np.array_equal(read_float_cells(tmp_path / "cells.npy", cells.shape), cells)
    cells[0, 31, 31, 31, 3] = bad
    np.save(tmp_path / "cells.npy", cells)
    with pytest.raises(SnergError, match="values outside 0 to 1"):
        read_float_cells(tmp_path / "cells.npy", cells.shape)


def test_limits_of_the_format_are_where_they_are_said_to_be(tmp_path: Path) -> None:
    check_blocks((2**23, 1, 1))
    with pytest.raises(ValueError, match="macroblocks"):
        check_blocks((2**23 + 1, 1, 1))
    assert (MAX_BLOCKS, MAX_WEIGHT) == (2**23, 1e6)
    assert [blocks_of((n, 1, 1))[0] for n in (1, 29, 30, 31, 60, 61, 4096, 131072)] == [1, 1, 1, 2, 2, 3, 137, 4370]


@pytest.mark.hard_case(59)
def test_a_scene_has_no_numbers_that_json_lacks(tmp_path: Path) -> None:
    scene = make_snerg((20, 20, 20))
    write_scene(scene, tmp_path / "scene")
    text = (tmp_path / "scene" / "scene.json").read_text()
    value = json.loads(text, parse_constant=lambda name: pytest.fail(f"the file holds {name}"))
    assert value["cells"] == len(scene.cells) and value["shape"] == [20, 20, 20]
    assert [np.float32(w) for w in value["network"]["bias_0"]] == list(scene.network.bias_0), "weights are exact"
    for bad in (np.nan, np.inf):
        with pytest.raises(SnergError):
            write_scene(replace(scene, near=bad), tmp_path / "other")
        assert not (tmp_path / "other").exists()


def test_scenes_whose_parts_do_not_fit_are_refused_at_the_edge() -> None:
    """A number of the last cell is one, the next is none."""
    scene = make_snerg((61, 30, 31), diffuse=True)
    count = len(scene.cells)
    for number, good in ((count - 1, True), (count, False), (-1, True), (-2, False)):
        changed = scene.indirection.copy()
        changed[0, 0, 0] = number
        if good:
            assert replace(scene, indirection=changed).indirection[0, 0, 0] == number
        else:
            with pytest.raises(SnergError, match="outside its atlas"):
                replace(scene, indirection=changed)


@pytest.mark.hard_case(18, 53)
def test_a_volumes_density_lets_through_what_a_voxel_does() -> None:
    """exp(-density length) is 1 - alpha, in thin fog too; opacity of 1 has the density of half a level less."""
    alpha = np.float32([0, 1e-7, 1e-4, 1 / 255, 0.5, 254 / 255, 1])
    density = density_of(alpha, 0.05)
    assert density.dtype == np.float32 and np.isfinite(density).all()
    through = np.exp(-density.astype(np.float64) * 0.05)
    assert 1 - through[1:-1] == pytest.approx(alpha[1:-1].astype(np.float64), rel=1e-5) and through[0] == 1
    assert through[-1] == pytest.approx(0.5 / 255, rel=1e-4)
    plain, corrected = (make_snerg((20, 20, 20), opacity_correction=on) for on in (False, True))
    assert np.array_equal(opacity(plain, alpha), alpha)
    assert opacity(corrected, alpha) == pytest.approx(np.minimum(1.5 * alpha, 1))
    values = np.float32([[0, 0, 0, 0], [0.25, 0.1, 0.5, 0.5], [0.6, 0.5, 0, 0.5]])
    linear = [0.5**2.4 and ((0.5 + 0.055) / 1.055) ** 2.4, ((0.2 + 0.055) / 1.055) ** 2.4]
    expected = np.array([[0, 0, 0], [*linear, 1], [1, 1, 0]])
    assert straight_colour(values) == pytest.approx(expected, abs=1e-6)
    scene = make_snerg((20, 31, 42))
    matrix = voxel_transform(scene)
    corners = [matrix @ [*place, 1] for place in ((-0.5, -0.5, -0.5), (19.5, 30.5, 41.5))]
    assert corners[0][:3] == pytest.approx(-scene.box.size / 2) and corners[1][:3] == pytest.approx(scene.box.size / 2)


@pytest.mark.hard_case(45)
@pytest.mark.parametrize("angles", [(0, 0, 0), (1.4, 0.2, 0.1), (0.1, 3.0, 1.6)])
def test_a_scene_along_other_axes_is_the_same_scene(angles: tuple[float, float, float]) -> None:
    """Three different sides, of which a reversed one is padded: rays show the same."""
    scene = make_snerg((44, 35, 61), angles=angles, centre=(0.3, -0.2, 0.1))
    for turn in (viewer_axes(scene.grid_to_world[:3, :3]), np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]])):
        turned = reorient(scene, turn)
        draw = np.random.default_rng(0)
        origins = draw.normal(size=(200, 3))
        origins = 5 * origins / np.linalg.norm(origins, axis=-1, keepdims=True) + scene.box.box_to_world[:3, 3]
        directions = scene.box.box_to_world[:3, 3] + draw.normal(0, 0.4, (200, 3)) - origins
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        before, after = (march_rays(one, origins, directions) for one in (scene, turned))
        assert np.median(before.transmittance) < 0.5
        assert np.quantile(np.abs(before.transmittance - after.transmittance), 0.5) < 0.02, "another phase of the lattice at most"
        for place in np.argwhere(turned.indirection >= 0)[:3]:
            number = turned.indirection[tuple(place)]
            local = 30 * place + np.array([1.5, 2.5, 3.5])
            world = turned.grid_to_world[:3, :3] @ local * turned.voxel_size + turned.grid_to_world[:3, 3]
            back = (world - scene.grid_to_world[:3, 3]) @ scene.grid_to_world[:3, :3] / scene.voxel_size
            block, inside = np.divmod(np.floor(back).astype(int), 30)
            old = scene.indirection[tuple(block)]
            assert turned.cells[(number, 2, 3, 4)].tolist() == scene.cells[(old, *(inside + 1))].tolist()


def test_the_published_viewer_starts_upright_at_the_front() -> None:
    for angles in ((0, 0, 0), (0, 0, 0.7), (0.4, 0.2, -0.3), (0.0, 0.0, 3.0)):
        turn = viewer_axes(rotation(angles))
        assert round(np.linalg.det(turn)) == 1
        up, ahead = (rotation(angles) @ turn)[:, 1], (rotation(angles) @ turn)[:, 2]
        assert up[2] > 0.7 and ahead[1] > 0.7


def test_a_turned_scene_is_as_upright_as_a_cube_can_be_and_never_mirrored() -> None:
    draw = np.random.default_rng(0)
    for _ in range(100):
        axes = rotation(tuple(draw.uniform(-3, 3, 3)))
        turn = viewer_axes(axes)
        assert round(np.linalg.det(turn)) == 1 and np.abs(turn).sum(axis=0).tolist() == [1, 1, 1]
        assert (axes @ turn)[2, 1] > np.abs(axes[2]).max() - 0.2


def test_sixteen_bits_are_rounded_to_the_nearest_of_eight(tmp_path: Path) -> None:
    """Every value against whole numbers: cutting the low byte off would lose half a level."""
    values = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    Image.fromarray(values).save(tmp_path / "deep.png")
    got = read_image(tmp_path / "deep.png")
    expected = [(2 * v * 255 + 65535) // (2 * 65535) for v in range(65536)]
    assert got.shape == (256, 256, 3) and got[..., 1].reshape(-1).tolist() == expected
    assert (got == got[..., :1]).all()


def test_a_box_in_device_coordinates_is_not_turned_for_the_reference_layout() -> None:
    from snerg.core.export.reference_axes import viewer_scene

    scene = Scene(np.eye(4), 0.1, (30, 30, 30), np.full((1, 1, 1), -1, np.int32), np.zeros((0, 32, 32, 32, 4), np.uint8), None)
    forward = replace(scene, ndc=make_frame())
    found = viewer_scene(forward)
    assert found.grid_to_world[:3, 2].tolist() == [0, 0, 1] and found.grid_to_world[2, 3] == pytest.approx(-3.0)
    pose = np.eye(4)
    pose[:3, :3] = rotation((0, 0, 0.1))
    with pytest.raises(SnergError, match="turned"):
        viewer_scene(replace(forward, grid_to_world=pose))


def test_jpeg_keeps_colours_of_neighbours_apart() -> None:
    """Features of neighbours differ as colours seldom do: at full chroma resolution columns of red and blue stay what they are."""
    import io

    from snerg.core.export.image_files import encode_image

    pixels = np.zeros((32, 32, 3), np.uint8)
    pixels[:, ::2, 0], pixels[:, 1::2, 2] = 200, 200
    back = np.asarray(Image.open(io.BytesIO(encode_image("feature", pixels, CodecSettings("jpeg", 95)))).convert("RGB")).astype(int)
    assert np.abs(back - pixels).mean() < 10
