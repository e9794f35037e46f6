"""The point under a pixel, against a float64 march that stops where half of the light is gone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page

from oracle import halfway_depth
from scenes import make_cameras, make_forward, make_forward_cameras, make_frame, make_snerg
from snerg.core.export.bundle import write_bundle
from snerg.core.geometry.camera import Camera
from snerg.core.scene.scene import Scene
from snerg.tests.web.conftest import opened

Serve = Callable[[Path], str]
SIDE = 12  # pixels between two picks


def scenes() -> dict[str, tuple[Scene, Camera]]:
    box, forward = make_snerg(angles=(0.2, 0.3, 0.5), shape=(40, 36, 50)), make_forward()
    around, before = make_cameras(), make_forward_cameras(make_frame(), 160, 120)
    far = (1e6, -2e6, 5e5)
    return {
        "perspective": (box, around[1]),
        "parallel": (box, around[2]),
        "far from the origin": (make_snerg(shape=(40, 36, 50), centre=far), make_cameras(far)[0]),
        "forward-facing": (forward, before[1]),
        "forward-facing, parallel": (forward, before[4]),
    }


@pytest.mark.parametrize("name", scenes())
def test_points_under_pixels(page: Page, tmp_path: Path, serve: Serve, name: str) -> None:
    scene, camera = scenes()[name]
    write_bundle(scene, [camera], tmp_path / "web")
    assert opened(page, f"{serve(tmp_path / 'web')}?width={camera.width}&height={camera.height}&ui=none") is None
    columns, rows = np.meshgrid(np.arange(SIDE // 2, camera.width, SIDE), np.arange(SIDE // 2, camera.height, SIDE))
    places = np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=-1)
    picked = page.evaluate("places => document.querySelector('snerg-viewer').viewer.pick(places)", places.tolist())
    expected = halfway_depth(scene, camera)[rows.ravel(), columns.ravel()]
    seen = np.array([point is not None for point in picked])
    assert np.mean(seen == np.isfinite(expected)) > 0.98 and 10 < seen.sum() < len(seen), "all but rays along an edge agree"
    both = np.flatnonzero(seen & np.isfinite(expected))
    depths = np.array([picked[i]["depth"] for i in both])
    voxels = np.array([picked[i]["voxel"] for i in both])
    apart = np.abs(depths - expected[both]) / voxels
    assert np.median(apart) < 0.01 and np.mean(apart < 0.1) > 0.9 and np.mean(apart < 1.1) > 0.96, "the same sample, but along edges"
    projected = page.evaluate(
        "points => points.map(p => document.querySelector('snerg-viewer').viewer.project(p))", [picked[i]["position"] for i in both]
    )
    shown = np.array([[p["x"], p["y"]] for p in projected])
    assert np.abs(shown - places[both]).max() < 0.05, "each point lies under the pixel that it was picked at"
