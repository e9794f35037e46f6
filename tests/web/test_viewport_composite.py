"""How a marched picture is laid into Blender's viewport: the shader that Blender gets, on the browser's card, against float64."""

from __future__ import annotations

import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page

from snerg.tests.web.conftest import ROOT
from snerg.tests.web.viewport_card import CARD

WIDTH, HEIGHT = 24, 16
BEFORE = (0.125, 0.25)  # what colour and depth buffers hold before
DRAW = f"""({{ glsl, picture, depths, projection, seen, width, height, before }}) => {{{CARD}"""
DRAW += """
  const texture = (unit, inner, format, values) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const edge of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, edge, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, gl.FLOAT, values && new Float32Array(values));
    return made;
  };
  const target = (...attached) => {
    gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
    attached.forEach(([place, made]) => gl.framebufferTexture2D(gl.FRAMEBUFFER, place, gl.TEXTURE_2D, made, 0));
  };
  const read = () => {
    const found = new Float32Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, found);
    return Array.from(found);
  };
  gl.viewport(0, 0, width, height);
  const program = build(glsl);
  texture(0, gl.RGBA32F, gl.RGBA, picture);
  texture(1, gl.R32F, gl.RED, depths);
  const [colour, depth] = [texture(2, gl.RGBA32F, gl.RGBA, null), texture(3, gl.DEPTH_COMPONENT32F, gl.DEPTH_COMPONENT, null)];
  target([gl.COLOR_ATTACHMENT0, colour], [gl.DEPTH_ATTACHMENT, depth]);
  gl.clearColor(before[0], before[0], before[0], before[0]);
  gl.clearDepth(before[1]);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.ALWAYS);
  gl.uniform1i(gl.getUniformLocation(program, "picture"), 0);
  gl.uniform1i(gl.getUniformLocation(program, "depths"), 1);
  gl.uniform4f(gl.getUniformLocation(program, "projection"), ...projection);
  gl.uniform1f(gl.getUniformLocation(program, "seen"), seen);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const colours = read();
  gl.disable(gl.DEPTH_TEST);
  target([gl.COLOR_ATTACHMENT0, texture(4, gl.RGBA32F, gl.RGBA, null)]);
  const copy = build("#version 300 es\\nprecision highp float; uniform highp sampler2D depth; out vec4 colour;" +
    "void main() { colour = texelFetch(depth, ivec2(gl_FragCoord.xy), 0); }");
  gl.uniform1i(gl.getUniformLocation(copy, "depth"), 3);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  return [colours, read()];
}
"""


@pytest.fixture(scope="module")
def glsl(tmp_path_factory: pytest.TempPathFactory) -> str:
    if find_spec("bpy") is None:
        pytest.skip("the viewport's code is made by Blender's module")
    folder = tmp_path_factory.mktemp("composite")
    script = [sys.executable, str(ROOT / "tests" / "web" / "viewport_shader.py"), str(folder)]
    done = subprocess.run(script, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return (folder / "composite.glsl").read_text()


def marched() -> tuple[NDArray, NDArray]:
    """A picture [H, W, 4], premultiplied sRGB, and distances [H, W] along the view axis; both bottom up. A third of it holds nothing."""
    draw = np.random.default_rng(0)
    alpha = draw.choice([0.0, 0.0, 1 / 255, 0.3, 0.7, 1.0], (HEIGHT, WIDTH, 1))
    straight = draw.random((HEIGHT, WIDTH, 3))
    straight[:4] *= 0.09  # on both sides of 0.04045, where sRGB bends
    straight[4, ::2], straight[4, 1::2] = 1.02, -0.02  # what a network may add
    picture = np.concatenate([straight * alpha, alpha], axis=-1)
    return picture.astype(np.float32), draw.uniform(0.2, 60, (HEIGHT, WIDTH)).astype(np.float32)


def laid(page: Page, glsl: str, projection: tuple[float, ...], seen: float = 1.0) -> tuple[NDArray, NDArray]:
    """Colour [H, W, 4] and depth [H, W] in the viewport's buffers, bottom up."""
    picture, depths = marched()
    given = {"picture": picture.reshape(-1).tolist(), "depths": depths.reshape(-1).tolist(), "projection": projection, "seen": seen}
    colour, depth = page.evaluate(DRAW, given | {"glsl": glsl, "width": WIDTH, "height": HEIGHT, "before": BEFORE})
    return np.array(colour).reshape(HEIGHT, WIDTH, 4), np.array(depth).reshape(HEIGHT, WIDTH, 4)[..., 0]


def linear(srgb: NDArray) -> NDArray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def perspective(near: float, far: float) -> tuple[float, float, float, float]:
    """The terms (2, 2), (2, 3), (3, 2) and (3, 3) of Blender's projection matrix."""
    return -(far + near) / (far - near), -2 * far * near / (far - near), -1.0, 0.0


def parallel(near: float, far: float) -> tuple[float, float, float, float]:
    return -2 / (far - near), -(far + near) / (far - near), 0.0, 1.0


@pytest.mark.hard_case(8)
def test_colours_are_linear_and_premultiplied_and_nothing_is_drawn_where_nothing_is(page: Page, glsl: str) -> None:
    picture, _ = (values.astype(np.float64) for values in marched())
    colour, depth = laid(page, glsl, perspective(0.1, 100))
    alpha = picture[..., 3]
    held = alpha > 0
    expected = linear(np.clip(picture[held, :3] / alpha[held, None], 0, 1)) * alpha[held, None]
    assert np.abs(colour[held, :3] - expected).max() < 2e-6 and np.abs(colour[held, 3] - alpha[held]).max() < 1e-6
    assert (colour[~held] == BEFORE[0]).all() and (depth[~held] == BEFORE[1]).all() and 50 < (~held).sum() < 300


def test_a_holdout_is_black_and_as_opaque(page: Page, glsl: str) -> None:
    picture, _ = marched()
    colour, depth = laid(page, glsl, perspective(0.1, 100), 0.0)
    held = picture[..., 3] > 0
    assert not colour[held, :3].any() and np.abs(colour[held, 3] - picture[held, 3]).max() < 1e-6
    assert (depth[held] != BEFORE[1]).all() and (colour[~held] == BEFORE[0]).all()


@pytest.mark.parametrize(("kind", "near", "far"), [("perspective", 0.1, 100.0), ("perspective", 5.0, 40.0), ("parallel", -20.0, 45.0)])
def test_depths_are_those_of_the_viewports_own_buffer(page: Page, glsl: str, kind: str, near: float, far: float) -> None:
    """By similar triangles, without a matrix; in front of the near plane and behind the far one, on these planes."""
    picture, depths = (values.astype(np.float64) for values in marched())
    _, found = laid(page, glsl, (perspective if kind == "perspective" else parallel)(near, far))
    held = picture[..., 3] > 0
    z = np.clip(depths[held], near, far)
    expected = (1 / near - 1 / z) / (1 / near - 1 / far) if kind == "perspective" else (z - near) / (far - near)
    assert np.abs(found[held] - expected).max() < 1e-6
    assert near < 1 or ((found[held] == 0).any() and (found[held] == 1).any())
