// The fragment shader of a scene: march.glsl with the scene's constants and with code for what the scene has. A diffuse scene's
// shader has no network and no feature textures; a scene that is not forward-facing has no NDC code.
import { Matrix3 } from "three";
import march from "./march.glsl";
import ndc from "./ndc.glsl";
import { CELL_VOXELS, DATA_VOXELS, positionOf } from "./scene.js";
import { fillTemplate } from "./template.js";

export const VERTEX_SHADER = "in vec3 position;\nvoid main() { gl_Position = vec4(position.xy, 0.0, 1.0); }\n";

const glslFloat = (value) => Math.fround(value).toExponential(9);
const glslVector = (values) => `vec${values.length}(${values.map(glslFloat).join(", ")})`;
const glslFlag = (value) => (value ? "1" : "0");

/** GLSL ES 3.00 for a scene (of `readScene`) whose atlas is spread over `pages` textures of each kind. */
export function fragmentShader(scene, pages) {
  const lookups = [...(scene.network ? ["rgba", "feature"] : ["rgba"]).map((kind) => texelLookup(kind, pages)), distanceLookup(pages)];
  return fillTemplate(march, {
    VIEW_DEPENDENCE: glslFlag(scene.network),
    OPACITY_CORRECTION: glslFlag(scene.fill_holes),
    FORWARD_FACING: glslFlag(scene.ndc),
    DATA_VOXELS: glslFloat(DATA_VOXELS),
    CELL_VOXELS: glslFloat(CELL_VOXELS),
    NETWORK_TRANSMITTANCE: glslFloat(scene.network_transmittance),
    ATLAS_LOOKUPS: lookups.join("\n"),
    NETWORK: scene.network ? networkFunction(scene.network) : "",
    NDC: scene.ndc ? ndcFunction(scene) : "",
  });
}

/** ndc.glsl: the rays of a forward-facing scene to rays of its grid. */
function ndcFunction(scene) {
  const gridFromNdc = new Matrix3().setFromMatrix4(scene.gridToWorld).transpose().multiplyScalar(1 / scene.voxel_size);
  return fillTemplate(ndc, {
    NDC_FOCAL: glslVector(scene.ndc.focal),
    GRID_FROM_NDC: `mat3(${gridFromNdc.elements.map(glslFloat).join(", ")})`, // both column by column
    NDC_CORNER: glslVector(positionOf(scene.gridToWorld).toArray()),
  });
}

/** rgbaAt or featureAt: the trilinear value in [0, 1] at a position in texels of an atlas page. */
function texelLookup(kind, pages) {
  const read = (name) => `textureLod(${name}, texel / vec3(textureSize(${name}, 0)), 0.0)`;
  return pageLookup(kind, pages, `vec4 ${kind}At(int page, vec3 texel)`, read);
}

/** distanceAt: how many coarse voxels from a coarse voxel to the nearest of its cell that is not empty; 0 if it is not empty. */
function distanceLookup(pages) {
  return pageLookup("distance", pages, "float distanceAt(int page, ivec3 coarse)", (name) => `texelFetch(${name}, coarse, 0).r * 255.0`);
}

/** A function that reads the texture of a page. GLSL cannot index samplers by a variable, so that it compares page numbers. */
function pageLookup(kind, pages, signature, read) {
  const names = Array.from({ length: pages }, (_, page) => `${kind}_${page}`);
  const lines = names.map((name, page) => `  ${page < pages - 1 ? `if (page == ${page}) ` : ""}return ${read(name)};`);
  return [...names.map((name) => `uniform sampler3D ${name};`), `${signature} {`, ...lines, "}", ""].join("\n");
}

/**
 * viewDependentColour: the view-dependence network (section 4.2), which has 16, 16 and 3 outputs a layer. Its inputs are the view
 * direction d, sin(2^k d) and cos(2^k d) for k = 0..3, the diffuse colour over white, and four features: 34 in all.
 *
 * The weights are constants of the code: WebGL 2 guarantees 224 uniform vectors, and they fill 225.
 */
function networkFunction(weights) {
  const hidden = (name) => Array.from({ length: 16 }, (_, i) => `${name}${i >> 2}.${"xyzw"[i & 3]}`);
  const relu = (name) => [0, 1, 2, 3].map((i) => `  ${name}${i} = max(${name}${i}, 0.0);`);
  return [
    "vec3 viewDependentColour(vec3 colour, vec4 features, vec3 direction) {",
    ...startLayer("a", weights.bias_0),
    ...firstLayerProducts("a", weights.weights_0),
    ...relu("a"),
    ...startLayer("b", weights.bias_1),
    ...addProducts("b", hidden("a"), weights.weights_1),
    ...relu("b"),
    `  vec3 c = ${glslVector(weights.bias_2)};`,
    ...hidden("b").map((input, i) => `  c += ${input} * ${glslVector(weights.weights_2[i])};`),
    "  return 1.0 / (1.0 + exp(-clamp(c, -30.0, 30.0)));",
    "}",
    "",
  ].join("\n");
}

/** Declare each input of the network as i0, i1, ... and add its products with the first layer's weights. */
function firstLayerProducts(layer, weights) {
  const scaled = ["direction", "2.0 * direction", "4.0 * direction", "8.0 * direction"];
  const inputs = [
    ["vec3", "direction"],
    ...scaled.map((direction) => ["vec3", `sin(${direction})`]),
    ...scaled.map((direction) => ["vec3", `cos(${direction})`]),
    ["vec3", "colour"],
    ["vec4", "features"],
  ];
  let row = 0;
  return inputs.flatMap(([type, expression], i) => {
    const components = Array.from(type === "vec4" ? "xyzw" : "xyz", (component) => `i${i}.${component}`);
    const rows = weights.slice(row, (row += components.length));
    return [`  ${type} i${i} = ${expression};`, ...addProducts(layer, components, rows)];
  });
}

/** 16 values as four vec4. */
const fourVectors = (values) => [0, 4, 8, 12].map((i) => glslVector(values.slice(i, i + 4)));
const startLayer = (layer, bias) => fourVectors(bias).map((value, i) => `  vec4 ${layer}${i} = ${value};`);
const addProducts = (layer, inputs, rows) =>
  inputs.flatMap((input, k) => fourVectors(rows[k]).map((value, i) => `  ${layer}${i} += ${input} * ${value};`));
