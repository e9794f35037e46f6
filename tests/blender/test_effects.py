"""A matte scene and a mirror-like one, from rendering to the web page: each gets only the effects that it needs."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import bpy
import pytest

from snerg.core.artifact import open_scene
from snerg.core.baking.bake import BakeSettings
from snerg.core.commands.bake import bake_scene
from snerg.core.commands.bundle import bundle_scene
from snerg.core.commands.train import train_field
from snerg.core.data.load import read_dataset
from snerg.core.io.files import folder_bytes
from snerg.core.rendering.render import render_scene
from snerg.core.study.evaluate import evaluate
from snerg.core.training.view_dependence_test import EFFECT
from snerg.snerg_addon.bridge import box_from_blender
from snerg.snerg_addon.capture import evaluated, render_dataset

ROOT = Path(__file__).parents[2]
STEPS = 1200


def rendered(out: Path, metallic: float, roughness: float, specular: float) -> Path:
    """The demo's objects, all with the same roughness, and 40 cameras."""
    sys.path.insert(0, str(ROOT / "demo"))
    try:
        from build_scene import build
    finally:
        sys.path.remove(str(ROOT / "demo"))
    scene = build(size=120, samples=8, cameras=40)
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.node_tree else ():
            if node.type == "BSDF_PRINCIPLED":
                node.inputs["Metallic"].default_value, node.inputs["Roughness"].default_value = metallic, roughness
                node.inputs["Specular IOR Level"].default_value, node.inputs["Coat Weight"].default_value = specular, 0.0
    bpy.context.view_layer.update()
    cameras = sorted((thing for thing in scene.objects if thing.type == "CAMERA"), key=lambda thing: thing.name)
    render_dataset(scene, cameras, out, box=box_from_blender(scene.snerg.box, evaluated(scene)))
    return out


def trained(dataset: Path, out: Path, steps: int = STEPS, **values: str) -> str:
    """Train, and return the decision on view dependence."""
    steadied = {"average": "0.4", **values}  # so short a training is else a matter of its seed, by 0.03 dB
    decisions = train_field(dataset, out, steps=steps, values=steadied)["decisions"]
    return next((str(d["chosen"]) for d in decisions if d["effect"] == EFFECT), "")


@pytest.mark.slow
def test_a_matte_scene_carries_nothing_for_view_dependence(scene, tmp_path):
    dataset = rendered(tmp_path / "matte", metallic=0.0, roughness=1.0, specular=0.0)
    assert trained(dataset, tmp_path / "auto") == "diffuse"
    trained(dataset, tmp_path / "forced", view_dependence="deferred")
    sizes, quality = {}, {}
    for name in ("auto", "forced"):
        baked, page = tmp_path / f"{name}-scene", tmp_path / f"{name}-page"
        bake_scene(tmp_path / name, baked, BakeSettings(resolution=320))  # so fine that refining has nothing to make up for
        bundle_scene(baked, page)
        sizes[name], quality[name] = folder_bytes(page / "scene"), evaluate(baked, dataset)["psnr"]
    files = [path.name for path in (tmp_path / "auto-page").rglob("*")]
    assert not any(name.startswith("feature") for name in files) and any(name.startswith("rgba") for name in files)
    assert any(path.name.startswith("feature") for path in (tmp_path / "forced-page").rglob("*"))
    assert open_scene(tmp_path / "auto-page").network is None
    assert sizes["auto"] < sizes["forced"] * 2 / 3, sizes
    assert quality["auto"] > quality["forced"] - 0.1, quality
    seconds = frame_seconds({name: tmp_path / f"{name}-scene" for name in ("auto", "forced")}, dataset)
    assert seconds["auto"] < seconds["forced"], seconds


def frame_seconds(scenes: dict[str, Path], dataset: Path) -> dict[str, float]:
    """The processor time of the fastest of several frames of each scene, rendered in turns."""
    camera = read_dataset(dataset, "test").cameras[0].resized(400, 400)
    opened = {name: open_scene(path) for name, path in scenes.items()}
    found: dict[str, list[float]] = {name: [] for name in scenes}
    for _ in range(6):
        for name, snerg in opened.items():
            began = time.process_time()
            render_scene(snerg, camera)
            found[name].append(time.process_time() - began)
    return {name: min(seconds) for name, seconds in found.items()}


@pytest.mark.slow
def test_a_mirror_like_scene_is_found_to_be_one(scene, tmp_path):
    dataset = rendered(tmp_path / "mirror", metallic=1.0, roughness=0.12, specular=0.5)
    assert trained(dataset, tmp_path / "auto", 2000) == "deferred"  # highlights take longer to learn than to do without
    bake_scene(tmp_path / "auto", tmp_path / "scene", BakeSettings(resolution=96))
    bundle_scene(tmp_path / "scene", tmp_path / "page")
    assert any(path.name.startswith("feature") for path in (tmp_path / "page").rglob("*"))
    assert open_scene(tmp_path / "page").network is not None
