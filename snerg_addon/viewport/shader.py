"""The viewport's shaders, composed of what a scene carries: a diffuse scene's has no network and no features."""

from __future__ import annotations

from pathlib import Path

import gpu
import numpy as np

from ...core.nerf.frame import NETWORK_TRANSMITTANCE
from ...core.nerf.model import ViewNetwork
from ...core.scene.blocks import CELL_VOXELS, DATA_VOXELS
from ...core.scene.scene import Scene

HERE = Path(__file__).parent
VERTEX = "void main() { ndc = pos; gl_Position = vec4(pos, 0.0, 1.0); }"
VIEW = """
struct View {
  vec4 axes[3];          // columns: the camera's axes, in voxels along the grid's
  vec4 network_axes[3];  // columns: the camera's axes in those in which the network was trained
  vec4 eye;              // voxels; w: 1 for parallel rays
  vec4 plane_scale;      // the picture plane at distance 1: ndc * xy + zw
  vec4 near;             // voxels: clip start and end along the view axis, least distance along a ray
  vec4 shape;            // voxels
  vec4 blocks;
  vec4 voxel;            // its size in the world
};
"""


def march_shader(scene: Scene, pages: int, features_need_alpha: bool) -> gpu.types.GPUShader:
    """The march of a scene whose atlas has that many pages. features_need_alpha: features are 0 wherever alpha is, so that they need not
    be read there."""
    info = _info()
    info.typedef_source(VIEW)
    info.uniform_buf(0, "View", "view")
    for slot, name in enumerate(sampler_names(scene, pages)):
        info.sampler(slot, "FLOAT_3D", name)
    info.fragment_out(0, "VEC4", "colour")
    info.fragment_out(1, "FLOAT", "ray_depth")
    constants = {"DATA_VOXELS": f"{DATA_VOXELS}.0", "CELL_VOXELS": f"{CELL_VOXELS}.0"}
    parts = [lookup("rgba", pages, scene.square_roots), skip_lookup(pages)]
    if scene.network is not None:
        constants |= {"VIEW_DEPENDENCE": "", "NETWORK_TRANSMITTANCE": number(NETWORK_TRANSMITTANCE)}
        constants["FEATURES_ABOVE"] = number(0 if features_need_alpha else -1)
        parts += [lookup("feature", pages, scene.square_roots), network(scene.network)]
    if scene.opacity_correction:
        constants["OPACITY_CORRECTION"] = ""
    for name, value in constants.items():
        info.define(name, value)
    info.fragment_source("\n".join([*parts, (HERE / "march.glsl").read_text()]))
    return gpu.shader.create_from_info(info)


def composite_shader() -> gpu.types.GPUShader:
    """The marched picture and its depth into the viewport."""
    info = _info()
    info.push_constant("VEC4", "projection")
    info.push_constant("FLOAT", "seen")  # 0: a holdout, black where it is
    info.sampler(0, "FLOAT_2D", "picture")
    info.sampler(1, "FLOAT_2D", "depths")
    info.fragment_out(0, "VEC4", "colour")
    info.depth_write("ANY")
    info.fragment_source((HERE / "composite.glsl").read_text())
    return gpu.shader.create_from_info(info)


def sampler_names(scene: Scene, pages: int) -> list[str]:
    """The samplers of the march, in the order of their slots."""
    kinds = ("rgba", "skip", *(("feature",) if scene.network is not None else ()))
    return ["indirection", *(f"{kind}_{page}" for kind in kinds for page in range(pages))]


def _info() -> gpu.types.GPUShaderCreateInfo:
    info = gpu.types.GPUShaderCreateInfo()
    face = gpu.types.GPUStageInterfaceInfo("snerg_face")
    face.smooth("VEC2", "ndc")
    info.vertex_in(0, "VEC2", "pos")
    info.vertex_out(face)
    info.vertex_source(VERTEX)
    return info


def lookup(kind: str, pages: int, square_roots: bool) -> str:
    """`vec4 KIND_at(int page, vec3 at)`: trilinear, of eight texels. Cards interpolate 8-bit textures with 8-bit weights, or may: thin fog
    would come out several times too dense. Samplers cannot be indexed by a variable, so that a page is chosen by comparing."""
    lines = "\n".join(f"  if (page == {page}) {{ return {kind}_blend({kind}_{page}, at); }}" for page in range(pages))
    return f"{blend(kind, square_roots)}\nvec4 {kind}_at(int page, vec3 at)\n{{\n{lines}\n  return vec4(0.0);\n}}\n"


def blend(kind: str, square_roots: bool) -> str:
    """`vec4 KIND_blend(sampler3D page, vec3 at)`; texel centres lie at halves. square_roots: texels hold those of their values."""
    texel = (
        f"{kind}_squared(texelFetch(page, low + ivec3({{}}, {{}}, {{}}), 0))"
        if square_roots
        else "texelFetch(page, low + ivec3({}, {}, {}), 0)"
    )
    corners = [texel.format(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    along_z = [f"mix({corners[2 * i]}, {corners[2 * i + 1]}, part.z)" for i in range(4)]
    along_y = [f"mix({along_z[2 * i]}, {along_z[2 * i + 1]}, part.y)" for i in range(2)]
    squared = f"vec4 {kind}_squared(vec4 root) {{ return root * root; }}\n" if square_roots else ""
    return (
        f"{squared}vec4 {kind}_blend(sampler3D page, vec3 at)\n{{\n  vec3 texel = at - 0.5;\n  ivec3 low = ivec3(floor(texel));\n"
        f"  vec3 part = texel - vec3(low);\n  return mix({along_y[0]}, {along_y[1]}, part.x);\n}}\n"
    )


def skip_lookup(pages: int) -> str:
    """`float skip_at(int page, ivec3 at)`: the distance to the nearest coarse voxel of the cell that holds something, in coarse voxels."""
    lines = "\n".join(f"  if (page == {page}) {{ return texelFetch(skip_{page}, at, 0).r * 255.0; }}" for page in range(pages))
    return f"float skip_at(int page, ivec3 at)\n{{\n{lines}\n  return 0.0;\n}}\n"


def number(value: float) -> str:
    """A float32 as GLSL has it."""
    return f"{float(np.float32(value)):.9e}"


def vector(values: np.ndarray) -> str:
    """A vec3 or vec4."""
    return f"vec{len(values)}({', '.join(number(v) for v in values)})"


def network(weights: ViewNetwork) -> str:
    """`vec3 residual(vec3 colour, vec4 features, vec3 direction)`: the view-dependence network (section 4.2), its weights as constants.

    Inputs: direction, sin(2^k d) and cos(2^k d) for k = 0..3, the colour over white, four features.
    """
    scales = ["direction", "(2.0 * direction)", "(4.0 * direction)", "(8.0 * direction)"]
    inputs = ["direction.{}", *(f"sin({s}.{{}})" for s in scales), *(f"cos({s}.{{}})" for s in scales), "colour.{}"]
    names = [text.format(axis) for text in inputs for axis in "xyz"] + [f"features.{axis}" for axis in "xyzw"]
    lines = layer("a", names, weights.weights_0, weights.bias_0)
    hidden = [f"a{i // 4}.{'xyzw'[i % 4]}" for i in range(16)]
    lines += layer("b", hidden, weights.weights_1, weights.bias_1)
    lines.append(f"  vec3 c = {vector(weights.bias_2)};")
    lines += [f"  c += b{i // 4}.{'xyzw'[i % 4]} * {vector(weights.weights_2[i])};" for i in range(16)]
    body = "\n".join(lines)
    return (
        f"vec3 residual(vec3 colour, vec4 features, vec3 direction)\n{{\n{body}\n  return 1.0 / (1.0 + exp(-clamp(c, -30.0, 30.0)));\n}}\n"
    )


def layer(name: str, inputs: list[str], weights: np.ndarray, bias: np.ndarray) -> list[str]:
    """Lines of a hidden layer of 16 with its ReLU, as four vec4. An input without weights has no line: most trainings use two of the four
    frequencies."""
    lines = [f"  vec4 {name}{i} = {vector(bias[4 * i : 4 * i + 4])};" for i in range(4)]
    for text, row in ((text, row) for text, row in zip(inputs, weights, strict=True) if row.any()):
        lines += [f"  {name}{i} += {text} * {vector(row[4 * i : 4 * i + 4])};" for i in range(4)]
    return lines + [f"  {name}{i} = max({name}{i}, vec4(0.0));" for i in range(4)]
