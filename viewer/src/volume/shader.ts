// The fragment shader of a scene: march.glsl with the scene's constants and with code for what the scene has. A diffuse scene's
// shader has no network and no feature textures; a scene that is not forward-facing has no NDC code.
import { Matrix3 } from "three";
import { CELL_VOXELS, DATA_VOXELS, type NetworkWeights, positionOf, type SceneDescription } from "../data/scene";
import { COVERING_VERTEX_SHADER } from "./full_screen";
import march from "./march.glsl";
import ndc from "./ndc.glsl";
import { fillTemplate } from "./template";

/** The box of a scene; z is left out, so that the camera's clip planes cut no face off. A forward-facing scene covers the image. */
export const vertexShader = (scene: SceneDescription): string =>
  scene.ndc
    ? COVERING_VERTEX_SHADER
    : "uniform mat4 clipFromGrid;\nin vec3 position;\nvoid main() { gl_Position = clipFromGrid * vec4(position, 1.0); gl_Position.z = 0.0; }\n";

const glslFloat = (value: number) => Math.fround(value).toExponential(9);
const glslVector = (values: readonly number[]) => `vec${values.length}(${values.map(glslFloat).join(", ")})`;
const glslFlag = (value: unknown) => (value ? "1" : "0");

/**
 * GLSL ES 3.00 for a scene whose atlas is spread over `pages` textures of each kind. sceneDepth: stop at what is drawn already, and write
 * depth. picking: give the depth at half transmittance in place of a colour, see `picking.ts`.
 */
export function fragmentShader(scene: SceneDescription, pages: number, sceneDepth: boolean, picking = false): string {
  const lookups = [
    ...(scene.network ? ["rgba", "feature"] : ["rgba"]).map((kind) => texelLookup(kind, pages, scene.square_roots)),
    distanceLookup(pages),
  ];
  return fillTemplate(march, {
    VIEW_DEPENDENCE: glslFlag(scene.network),
    OPACITY_CORRECTION: glslFlag(scene.fill_holes),
    FORWARD_FACING: glslFlag(scene.ndc),
    SCENE_DEPTH: glslFlag(sceneDepth),
    PICKING: glslFlag(picking),
    DATA_VOXELS: glslFloat(DATA_VOXELS),
    CELL_VOXELS: glslFloat(CELL_VOXELS),
    NETWORK_TRANSMITTANCE: glslFloat(scene.network_transmittance),
    ATLAS_LOOKUPS: lookups.join("\n"),
    NETWORK: scene.network ? networkFunction(scene.network) : "",
    NDC: scene.ndc ? ndcFunction(scene, scene.ndc.focal) : "",
  });
}

/** ndc.glsl: the rays of a forward-facing scene to rays of its grid. */
function ndcFunction(scene: SceneDescription, focal: readonly number[]): string {
  const gridFromNdc = new Matrix3()
    .setFromMatrix4(scene.gridToWorld)
    .transpose()
    .multiplyScalar(1 / scene.voxel_size);
  return fillTemplate(ndc, {
    NDC_FOCAL: glslVector(focal),
    GRID_FROM_NDC: `mat3(${gridFromNdc.elements.map(glslFloat).join(", ")})`, // both column by column
    NDC_CORNER: glslVector(positionOf(scene.gridToWorld).toArray()),
  });
}

/** rgbaAt or featureAt: the trilinear value in [0, 1] at a position in texture coordinates of an atlas page. */
function texelLookup(kind: string, pages: number, squareRoots: boolean): string {
  const signature = `vec4 ${kind}At(int page, vec3 place)`;
  if (!squareRoots) return pageLookup(kind, pages, signature, (name) => `textureLod(${name}, place, 0.0)`);
  return blendOfSquares(kind) + pageLookup(kind, pages, signature, (name) => `${kind}Blend(${name}, place / texelSize)`);
}

/** rgbaBlend or featureBlend: the trilinear value of the squares of texels, which no filter of a texture gives. */
function blendOfSquares(kind: string): string {
  const corner = (x: number, y: number, z: number) => `${kind}Squared(page, low + ivec3(${x}, ${y}, ${z}))`;
  const alongX = (y: number, z: number) => `mix(${corner(0, y, z)}, ${corner(1, y, z)}, part.x)`;
  const alongY = (z: number) => `mix(${alongX(0, z)}, ${alongX(1, z)}, part.y)`;
  return [
    `vec4 ${kind}Squared(sampler3D page, ivec3 at) {`,
    "  vec4 root = texelFetch(page, at, 0);",
    "  return root * root;",
    "}",
    `vec4 ${kind}Blend(sampler3D page, vec3 texel) {`,
    "  vec3 corner = texel - 0.5;",
    "  ivec3 low = ivec3(floor(corner));",
    "  vec3 part = corner - vec3(low);",
    `  return mix(${alongY(0)}, ${alongY(1)}, part.z);`,
    "}",
    "",
  ].join("\n");
}

/** distanceAt: how many stencils from a stencil, named by its lowest texel, to the nearest of its cell that is not empty; 0 if it is not. */
function distanceLookup(pages: number): string {
  const read = (name: string) => `float(texelFetch(${name}, stencil, 0).r)`;
  return pageLookup("distance", pages, "float distanceAt(int page, ivec3 stencil)", read, "usampler3D");
}

/** A function that reads the texture of a page. GLSL cannot index samplers by a variable, so that it compares page numbers. */
function pageLookup(kind: string, pages: number, signature: string, read: (name: string) => string, sampler = "sampler3D"): string {
  const names = Array.from({ length: pages }, (_, page) => `${kind}_${page}`);
  const lines = names.map((name, page) => `  ${page < pages - 1 ? `if (page == ${page}) ` : ""}return ${read(name)};`);
  return [...names.map((name) => `uniform ${sampler} ${name};`), `${signature} {`, ...lines, "}", ""].join("\n");
}

/**
 * viewDependentColour: the view-dependence network (section 4.2), which has 16, 16 and 3 outputs a layer. Its inputs are the view
 * direction d, sin(2^k d) and cos(2^k d) for k = 0..3, the diffuse colour over white, and four features: 34 in all.
 *
 * The weights are constants of the code: WebGL 2 guarantees 224 uniform vectors, and they fill 225.
 */
function networkFunction(weights: NetworkWeights): string {
  const hidden = (name: string) => Array.from({ length: 16 }, (_, i) => `${name}${i >> 2}.${"xyzw"[i & 3]}`);
  const relu = (name: string) => [0, 1, 2, 3].map((i) => `  ${name}${i} = max(${name}${i}, 0.0);`);
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
function firstLayerProducts(layer: string, weights: readonly number[][]): string[] {
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
    const rows = weights.slice(row, row + components.length);
    row += components.length;
    const products = addProducts(layer, components, rows);
    return products.length > 0 ? [`  ${type} i${i} = ${expression};`, ...products] : [];
  });
}

/** 16 values as four vec4. */
const fourVectors = (values: readonly number[]) => [0, 4, 8, 12].map((i) => glslVector(values.slice(i, i + 4)));
const startLayer = (layer: string, bias: readonly number[]) => fourVectors(bias).map((value, i) => `  vec4 ${layer}${i} = ${value};`);
/** Products of inputs with their rows of weights. An input without weights has none: most trainings use two of the four frequencies. */
const addProducts = (layer: string, inputs: readonly string[], rows: readonly number[][]) =>
  inputs.flatMap((input, k) =>
    rows[k].some((weight) => weight !== 0) ? fourVectors(rows[k]).map((value, i) => `  ${layer}${i} += ${input} * ${value};`) : [],
  );
