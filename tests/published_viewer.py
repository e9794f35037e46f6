"""The published web viewer, reimplemented with NumPy from its code: an oracle for scenes in the reference layout.

It reads the files itself and shares no code with core, so that a mistake in core cannot hide by being repeated here.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

BLOCK, CELL, EMPTY = 30, 32, 254


class PublishedViewer:
    """A scene folder in the viewer's form: 3D textures [X, Y, Z, C] in [0, 1], the atlas indices and the parameters."""

    def __init__(self, folder: Path) -> None:
        self.params = p = json.loads((folder / "scene_params.json").read_text())
        self.grid = np.array([p["grid_width"], p["grid_height"], p["grid_depth"]])
        self.atlas_size = np.array([p["atlas_width"], p["atlas_height"], p["atlas_depth"]])
        self.low = np.array([p["min_x"], p["min_y"], p["min_z"]])
        self.voxel = p["voxel_size"]
        self.view = np.array(p["worldspace_T_opengl"])[:3, :3]
        rgba = self.texture(folder, "rgba")
        self.rgb, self.alpha = rgba[..., :3], rgba[..., 3]
        self.diffuse = "0_bias" not in p
        self.features = None if self.diffuse else self.texture(folder, "feature")
        blocks = -(-self.grid // p["block_size"])
        pixels = np.asarray(Image.open(folder / "atlas_indices.png"))
        assert pixels.dtype == np.uint8 and pixels.shape == (blocks[2] * blocks[1], blocks[0], 3)
        self.index = pixels.reshape(blocks[2], blocks[1], blocks[0], 3).transpose(2, 1, 0, 3).astype(int)
        mip = np.rint(self.alpha * 255)
        for _ in range(2):
            x, y, z = (n // 2 for n in mip.shape)
            mip = np.rint(mip.reshape(x, 2, y, 2, z, 2).mean(axis=(1, 3, 5)))
        self.mip = mip

    def texture(self, folder: Path, name: str) -> np.ndarray:
        """A texture [X, Y, Z, 4] in [0, 1] from its slices. The viewer reads them as four bytes a pixel, so that other modes fail."""
        width, height, depth = self.atlas_size
        planes = []
        for number in range(self.params["num_slices"]):
            image = Image.open(folder / f"{name}_{number:03d}.png")
            assert image.mode == "RGBA"
            planes.append(np.asarray(image).reshape(4, height, width, 4))
        assert sum(map(len, planes)) == depth
        return np.concatenate(planes).transpose(2, 1, 0, 3) / 255

    def show(
        self, camera_to_viewer: np.ndarray, size: tuple[int, int], fov_degrees: float, near: float = 0.33, fault: bool = True
    ) -> np.ndarray:
        """The image [H, W, 3] in [0, 1] of a camera in the viewer's world.

        camera_to_viewer: [4, 4] OpenGL pose. size: (width, height) in pixels. fov_degrees: vertical field of view. near: distance
        of the near plane. fault: reproduce the viewer's mistake with NDC rays, whose origins are origin * t + direction.
        """
        width, height = size
        scale = np.tan(np.radians(fov_degrees) / 2)
        row, column = np.mgrid[0:height, 0:width]
        x = (2 * (column + 0.5) / width - 1) * scale * width / height
        y = (1 - 2 * (row + 0.5) / height) * scale
        local = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
        rays = local @ camera_to_viewer[:3, :3].T
        start = camera_to_viewer[:3, 3] + near * rays  # on the near plane
        directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        view_directions = directions
        if self.params["ndc"]:
            start, directions = self.ndc_rays(start * [1, 1, -1], directions * [1, 1, -1], fault)
            near = 0.0
        return self.march(start, directions, near, view_directions).reshape(height, width, 3)

    def ndc_rays(self, origins: np.ndarray, directions: np.ndarray, fault: bool) -> tuple[np.ndarray, np.ndarray]:
        """Rays with z reversed to rays in NDC with z reversed; x is reversed too. Origins and directions are [N, 3]."""
        t = (-(1 + origins[:, 2]) / directions[:, 2])[:, None]
        ox, oy, oz = (origins * t + directions if fault else origins + directions * t).T
        dx, dy, dz = directions.T
        p = self.params
        x, y = 2 * p["input_focal"] / p["input_width"], -2 * p["input_focal"] / p["input_height"]
        start = np.stack([x * ox / oz, y * oy / oz, -1 - 2 / oz], axis=-1)
        along = np.stack([x * (dx / dz - ox / oz), y * (dy / dz - oy / oz), 2 / oz], axis=-1)
        return start, along / np.linalg.norm(along, axis=-1, keepdims=True)

    def march(self, origins: np.ndarray, directions: np.ndarray, near: float, view_directions: np.ndarray) -> np.ndarray:
        """Colours [N, 3] in [0, 1] of rays in viewer units, over white."""
        origin = (origins - self.low) / self.voxel
        entry, end = slab(origin, directions, np.zeros(3), self.grid)
        t = np.maximum(near / self.voxel, entry) + 0.5
        count = len(origin)
        colour, features, transmittance = np.zeros((count, 3)), np.zeros((count, 4)), np.ones(count)
        live = np.flatnonzero(entry < end)
        for _ in range(int(np.ceil(np.linalg.norm(self.grid)))):
            live = live[(t[live] < end[live]) & (transmittance[live] > 1 / 255)]
            if not len(live):
                break
            position = origin[live] + t[live, None] * directions[live]
            block = np.clip(np.floor(position / BLOCK).astype(int), 0, np.array(self.index.shape[:3]) - 1)
            place = self.index[tuple(block.T)]
            empty = place[:, 0] > EMPTY
            _, exits = slab(origin[live[empty]], directions[live[empty]], BLOCK * block[empty], BLOCK * (block[empty] + 1))
            t[live[empty]] = exits + 0.5
            self.composite(live[~empty], position[~empty] - BLOCK * block[~empty], place[~empty], colour, features, transmittance)
            t[live[~empty]] += 1
        result = colour + transmittance[:, None]
        if self.diffuse:
            return np.clip(result, 0, 1)
        seen = transmittance <= 254 / 255
        result[seen] += self.network(result[seen], features[seen], view_directions[seen] @ self.view.T)
        return np.clip(result, 0, 1)

    def composite(self, rays, local, place, colour, features, transmittance) -> None:
        """Add a sample of each of some rays in place. local: [M, 3] voxels from the macroblock's corner; place: [M, 3] its cell."""
        position = CELL * place + 1 + local  # texels of the atlas
        keep = self.mip[tuple(np.floor(position / 4).astype(int).T)] > 0
        rays, position = rays[keep], position[keep]
        alpha = linear(self.alpha[..., None], position)[:, 0]
        keep = alpha > 0.5 / 255
        rays, position, alpha = rays[keep], position[keep], alpha[keep]
        colour[rays] += transmittance[rays, None] * linear(self.rgb, position)
        if self.features is not None:
            features[rays] += transmittance[rays, None] * linear(self.features, position)
        transmittance[rays] *= 1 - alpha

    def network(self, colour: np.ndarray, features: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """The view-dependent colours [N, 3] from diffuse colours [N, 3], features [N, 4] and view directions [N, 3]."""
        scaled = [2.0**k * directions for k in range(4)]
        x = np.concatenate([directions, *(np.sin(s) for s in scaled), *(np.sin(s + np.pi / 2) for s in scaled), colour, features], axis=-1)
        for layer in range(3):
            x = x @ np.array(self.params[f"{layer}_weights"]) + np.array(self.params[f"{layer}_bias"])
            x = np.maximum(x, 0) if layer < 2 else 1 / (1 + np.exp(-x))
        return x


def slab(origin: np.ndarray, direction: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances [N] at which rays enter and leave a box."""
    with np.errstate(divide="ignore"):
        inverse = 1 / direction
    a, b = (low - origin) * inverse, (high - origin) * inverse
    return np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)


def linear(texture: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Trilinear values [N, C] at positions [N, 3] in texels, clamped to the edge; texel centres are at + 0.5."""
    base = np.floor(position - 0.5).astype(int)
    fraction = position - 0.5 - base
    result = np.zeros((len(position), texture.shape[-1]))
    for corner in np.ndindex(2, 2, 2):
        at = np.clip(base + corner, 0, np.array(texture.shape[:3]) - 1)
        weight = np.where(corner, fraction, 1 - fraction).prod(axis=-1)
        result += weight[:, None] * texture[tuple(at.T)]
    return result
