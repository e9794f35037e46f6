"""A baked scene as an OpenVDB volume, which Cycles and EEVEE light, and whose shadows they cast."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import SnergError
from ..io.files import write_bytes
from ..io.images import srgb_to_linear
from ..progress import Progress, silent
from ..rendering.opacity import opacity_factor
from ..scene.blocks import DATA_VOXELS, block_coordinates
from ..scene.scene import Scene

SOLID = 1 - 0.5 / 255  # the opacity that an opaque voxel has: that of 1 asks for an infinite density
LEFT_OUT = "View dependence is left out: colours are those of the scene without its network."
PER_VOXEL = "The opacity correction of the scene acts on each voxel, not on each ray: what many faint voxels add up to is a little clearer."


def write_vdb(scene: Scene, path: Path, progress: Progress = silent) -> dict[str, Any]:
    """Write the grids `density` (float, per unit of length) and `color` (three floats, scene-linear) to a .vdb file, whole or not at all.

    The volume's axes are the box's, its origin the box's centre, its unit that of the scene. Through one voxel passes 1 - alpha of the
    light; where the scene has the opacity correction (eq. 9), what that leaves of a ray through this voxel alone. Of a ray through more
    of them eq. 9 leaves less, which no density gives: at most 0.2 less, where voxels are faint; an opaque surface is opaque.

    Returns {"voxels": those that are active, "bytes", "left_out": sentences, '' where nothing is}. Raises SnergError where the
    package openvdb is not there, the scene is forward-facing (its grid lies in NDC), or the file cannot be written.
    """
    vdb = open_vdb()
    if scene.ndc is not None:
        raise SnergError("The scene is forward-facing: its grid lies in device coordinates, which no volume has; export a web page.")
    density, colour = vdb.FloatGrid(), vdb.Vec3SGrid()
    density.name, colour.name = "density", "color"
    density.gridClass = vdb.GridClass.FOG_VOLUME
    for grid in (density, colour):
        grid.transform = vdb.createLinearTransform(voxel_transform(scene).T.tolist())  # OpenVDB multiplies rows
        grid.saveFloatAsHalf = False
    active, total = 0, max(len(scene.cells), 1)
    for done, (corner, densities, colours) in enumerate(blocks(scene)):
        density.copyFromArray(densities, ijk=corner)
        colour.copyFromArray(colours, ijk=corner)
        active += int((densities > 0).sum())
        progress(0.9 * (done + 1) / total, "Writing the volume")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "volume.vdb"
        vdb.write(str(file), grids=[density, colour])
        data = file.read_bytes()
    write_bytes(path, data)
    return {"voxels": active, "bytes": len(data), "left_out": left_out(scene)}


def left_out(scene: Scene) -> str:
    """What of a scene a volume does not hold, in sentences; '' where it holds everything."""
    return " ".join([LEFT_OUT] * (scene.network is not None) + [PER_VOXEL] * scene.opacity_correction)


def open_vdb() -> ModuleType:
    """The package openvdb. Raises SnergError where there is none."""
    for name in ("openvdb", "pyopenvdb"):  # its name now, and until OpenVDB 11
        try:
            return __import__(name)
        except ImportError:
            continue
    raise SnergError(
        "Writing a volume needs the package openvdb, which this Python does not have; Blender from blender.org brings it: "
        "run 'blender --command snerg export-vdb' there."
    )


def voxel_transform(scene: Scene) -> NDArray[Any]:
    """[4, 4] float64: indices of voxel centres to the box's own axes, whose origin is the box's centre."""
    found = np.diag([*[scene.voxel_size] * 3, 1.0])
    found[:3, 3] = (0.5 - np.array(scene.shape) / 2) * scene.voxel_size
    return found


def blocks(scene: Scene) -> Iterator[tuple[tuple[int, int, int], NDArray[Any], NDArray[Any]]]:
    """Of each block with a cell its first voxel, densities [30, 30, 30] float32 and straight colours [30, 30, 30, 3] float32."""
    for place, cell in zip(block_coordinates(scene.indirection), scene.cells, strict=True):
        values = scene.linear(cell[1:-1, 1:-1, 1:-1]).astype(np.float32) / np.float32(scene.unit)
        x, y, z = (int(n) * DATA_VOXELS for n in place)
        yield (x, y, z), density_of(opacity(scene, values[..., -1]), scene.voxel_size), straight_colour(values)


def opacity(scene: Scene, alpha: NDArray[Any]) -> NDArray[Any]:
    """The opacities that a scene's voxels have in its renders, elementwise: with the correction where the scene has it."""
    return alpha * opacity_factor(np, alpha) if scene.opacity_correction else alpha


def density_of(alpha: NDArray[Any], length: float) -> NDArray[Any]:
    """Extinction per unit of length, float32, elementwise: over `length` exactly 1 - alpha of the light passes; alpha at most SOLID."""
    return np.asarray(-np.log1p(-np.minimum(alpha, SOLID)) / length, np.float32)


def straight_colour(values: NDArray[Any]) -> NDArray[Any]:
    """Premultiplied display-referred [..., 4 or 8] with alpha last to straight scene-linear colour [..., 3] float32, 0 where alpha is."""
    alpha = values[..., -1:]
    straight = np.divide(values[..., :3], alpha, out=np.zeros_like(values[..., :3]), where=alpha > 0)
    return np.asarray(srgb_to_linear(np.clip(straight, 0, 1)), np.float32)
