"""Modules of the viewer that need no browser, run by Node."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]


def node(script: str) -> Any:
    """The JSON that a module script in the viewer's folder prints."""
    esbuild = [str(ROOT / "node_modules" / ".bin" / "esbuild"), "--bundle", "--format=esm", "--platform=node", "--loader:.glsl=text"]
    source = ROOT / "viewer" / "src"
    bundled = subprocess.run(esbuild, input=script, cwd=source, capture_output=True, text=True, check=True).stdout
    result = subprocess.run(["node", "--input-type=module"], input=bundled, cwd=source, capture_output=True, text=True, check=True)
    return json.loads(result.stdout)


def test_png_is_decoded_exactly(tmp_path: Path) -> None:
    """Every filter, and alpha so low that a canvas, which premultiplies, would lose the colours."""
    draw = np.random.default_rng(2)
    for name, pixels in {
        "noise": draw.integers(0, 256, (37, 29, 4)),
        "faint": draw.integers(0, 256, (64, 32, 4)) * np.array([1, 1, 1, 0]) + draw.integers(0, 3, (64, 32, 1)) * np.array([0, 0, 0, 1]),
        "slope": np.add.outer(np.arange(40), np.arange(50))[..., None] * np.array([1, 2, 3, 1]) % 256,
        "grey": draw.integers(0, 9, (20, 30, 1)),
        "colour": draw.integers(0, 4, (20, 30, 3)) + np.arange(30)[:, None],
    }.items():
        Image.fromarray(np.squeeze(pixels.astype(np.uint8))).save(tmp_path / f"{name}.png")
        height, width, channels = pixels.shape
        shown = node(f"""
            import {{ readFileSync }} from "node:fs";
            import {{ decodePng }} from "./data/png";
            const bytes = new Uint8Array(readFileSync({json.dumps(str(tmp_path / f"{name}.png"))}));
            console.log(JSON.stringify(Array.from(await decodePng(bytes, "it", {width}, {height}, {channels}))));
        """)
        assert (np.array(shown).reshape(pixels.shape) == pixels).all(), name


@pytest.mark.hard_case(55)
def test_layouts_stay_within_the_texture_limit() -> None:
    cases = [(0, 256, 5), (1, 256, 5), (512, 256, 5), (513, 256, 5), (2560, 256, 5), (1000, 2048, 5), (262144, 2048, 5), (7, 64, 7)]
    layouts = node(f"""
        import {{ atlasLayout }} from "./volume/atlas_layout";
        console.log(JSON.stringify({json.dumps(cases)}.map((c) => atlasLayout(...c))));
    """)
    for (cells, limit, most), layout in zip(cases, layouts, strict=True):
        x, y, z = layout["blocks"]
        assert max(x, y, z) * 32 <= limit and 1 <= layout["pages"] <= most
        assert layout["pages"] * layout["cellsPerPage"] >= cells and x * y * z >= layout["cellsPerPage"]
        assert layout["pages"] * x * y * z <= 1.35 * cells + 8, "little is wasted"


@pytest.mark.hard_case(55)
def test_layouts_that_no_device_holds_are_refused() -> None:
    message = node("""
        import { atlasLayout } from "./volume/atlas_layout";
        try { atlasLayout(2561, 256, 5); } catch (problem) { console.log(JSON.stringify(problem.message)); }
    """)
    assert "too large for this device" in message and "2561 blocks" in message


def test_distances() -> None:
    """Chebyshev distances against their definition."""
    shape = (7, 5, 6)  # x, y, z
    occupied = np.random.default_rng(0).random(shape[::-1]) < 0.03
    occupied[2, 1, 3] = True
    shown = node(f"""
        import {{ chebyshevDistance }} from "./volume/distance";
        console.log(JSON.stringify(Array.from(chebyshevDistance({occupied.ravel().astype(int).tolist()}, {list(shape)}))));
    """)
    points = np.argwhere(occupied)
    expected = np.abs(np.argwhere(np.ones_like(occupied))[:, None] - points).max(axis=-1).min(axis=-1)
    assert (np.array(shown) == expected).all()


def test_distances_of_stencils() -> None:
    """Chebyshev distances between stencils, against their definition: texels at faces, edges and corners of a cell, and an empty cell."""
    texels = np.zeros((32, 32, 32), bool)  # z, y, x
    for place in ((0, 31, 7), (31, 0, 31), (16, 9, 31), (20, 1, 0), (31, 31, 12)):
        texels[place] = True
    rows = (texels.astype(np.uint64) << np.arange(32, dtype=np.uint64)).sum(axis=-1).ravel().tolist()
    shown, empty = node(f"""
        import {{ stencilDistances }} from "./volume/distance";
        const distances = (rows) => Array.from(stencilDistances(Uint32Array.from(rows)));
        console.log(JSON.stringify([distances({rows}), distances(Array(1024).fill(0))]));
    """)
    stencils = np.zeros((33, 33, 33), bool)  # from one below the cell on
    for offset in np.ndindex(2, 2, 2):
        stencils[tuple(slice(start, start + 32) for start in offset)] |= texels
    points = np.argwhere(stencils[1:, 1:, 1:])
    expected = np.abs(np.argwhere(np.ones_like(texels))[:, None] - points).max(axis=-1).min(axis=-1)
    assert (np.array(shown) == expected).all() and set(empty) == {255}


def test_shader_templates() -> None:
    """Every placeholder is filled, as often as it occurs, and no value is searched for placeholders."""
    assert fill("a {{A}} {{B}} {{A}}", {"A": "{{B}}", "B": "2"}) == "a {{B}} 2 {{B}}"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"A": "1"}, "unknown placeholder {{B}}"),
        ({"A": "1", "B": "2", "C": "3"}, "no placeholder {{C}}"),
        ({"A": "1", "toString": "2"}, "unknown placeholder {{B}}"),
    ],
)
def test_shader_templates_name_the_wrong_placeholder(values: dict[str, str], message: str) -> None:
    assert message in fill("{{A}} {{B}}", values)


def fill(template: str, values: dict[str, str]) -> str:
    """What `fillTemplate` returns, or the message of the error that it throws."""
    return node(f"""
        import {{ fillTemplate }} from "./volume/template";
        let result;
        try {{ result = fillTemplate({json.dumps(template)}, {json.dumps(values)}); }} catch (error) {{ result = error.message; }}
        console.log(JSON.stringify(result));
    """)


def test_the_shader_has_the_placeholders_that_are_filled() -> None:
    """shader.ts fills those of march.glsl and ndc.glsl; test_pictures.py compiles them for each kind of scene."""
    source = ROOT / "viewer" / "src" / "volume"
    shader = (source / "shader.ts").read_text(encoding="utf-8")
    for name in ("march", "ndc"):
        named = set(re.findall(r"\{\{(\w+)\}\}", (source / f"{name}.glsl").read_text(encoding="utf-8")))
        call = shader.split(f"fillTemplate({name}, {{")[1].split("});")[0]
        assert named and named == set(re.findall(r"^    (\w+):", call, re.MULTILINE))
