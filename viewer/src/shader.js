// The fragment shader, put together from what the scene carries: a diffuse scene's has no network and no
// feature textures, and only a forward-facing scene's knows of device coordinates.
import march from "./march.glsl";
import ndc from "./ndc.glsl";
import { CELL_VOXELS, DATA_VOXELS } from "./scene.js";

const number = (value) => Math.fround(value).toExponential(9);
const vector = (values) => `vec${values.length}(${values.map(number).join(", ")})`;

/** GLSL 3.00 for a scene whose atlas has that many pages. */
export function fragmentShader(scene, pages) {
  const constants = [`const float DATA_VOXELS = ${DATA_VOXELS}.0;`, `const float CELL_VOXELS = ${CELL_VOXELS}.0;`];
  const parts = [lookups("rgba", pages), lookups("skip", pages)];
  if (scene.network) {
    constants.push("#define VIEW_DEPENDENCE", `const float NETWORK_TRANSMITTANCE = ${number(scene.network_transmittance)};`);
    parts.push(lookups("feature", pages), network(scene.network));
  }
  if (scene.fill_holes) constants.push("#define FILL_HOLES");
  if (scene.ndc) {
    const pose = scene.grid_to_world;
    const columns = [0, 1, 2].flatMap((i) => pose[i].slice(0, 3)); // of the inverse, whose columns are the rotation's rows
    constants.push(
      "#define NDC",
      `const vec2 NDC_FOCAL = ${vector(scene.ndc.focal)};`,
      `const mat3 GRID_FROM_NDC = mat3(${columns.map((value) => number(value / scene.voxel_size)).join(", ")});`,
      `const vec3 NDC_CORNER = ${vector([0, 1, 2].map((i) => pose[i][3]))};`,
    );
    parts.push(ndc);
  }
  const at = march.indexOf("const float STOP");
  const main = march.indexOf("// How far along");
  return [march.slice(0, at), ...constants, march.slice(at, main), ...parts, march.slice(main)].join("\n");
}

export const VERTEX_SHADER = "in vec3 position;\nvoid main() { gl_Position = vec4(position.xy, 0.0, 1.0); }\n";

/** Samplers cannot be indexed by a variable, so a page is chosen by comparing. Skips are counted in coarse voxels. */
function lookups(kind, pages) {
  const names = Array.from({ length: pages }, (_, i) => `${kind}_${i}`);
  const read = (name) =>
    kind === "skip" ? `texelFetch(${name}, at, 0).r * 255.0` : `textureLod(${name}, at / vec3(textureSize(${name}, 0)), 0.0)`;
  const [type, argument] = kind === "skip" ? ["float", "ivec3"] : ["vec4", "vec3"];
  const lines = names.map((name, i) => (i < pages - 1 ? `  if (page == ${i}) return ${read(name)};` : `  return ${read(name)};`));
  return [
    ...names.map((name) => `uniform sampler3D ${name};`),
    `${type} ${kind}At(int page, ${argument} at) {`,
    ...lines,
    "}",
    "",
  ].join("\n");
}

/**
 * The view-dependence network (section 4.2) with its weights as constants: WebGL 2 promises 224 uniform vectors, and it has 225.
 * Inputs: direction, sin(2^k d), cos(2^k d) for k = 0..3, the colour over white, four features.
 */
function network(weights) {
  const scales = ["direction", "2.0 * direction", "4.0 * direction", "8.0 * direction"];
  const inputs = [
    ["vec3", "direction"],
    ...scales.map((d) => ["vec3", `sin(${d})`]),
    ...scales.map((d) => ["vec3", `cos(${d})`]),
    ["vec3", "colour"],
    ["vec4", "features"],
  ];
  const lines = [];
  let row = 0;
  const first = layer("a", weights.bias_0);
  inputs.forEach(([type, expression], i) => {
    const rows = Array.from(type === "vec4" ? "xyzw" : "xyz", (component) => [`i${i}.${component}`, weights.weights_0[row++]]);
    first.push(`  ${type} i${i} = ${expression};`, ...products("a", rows));
  });
  const hidden = (name) => Array.from({ length: 16 }, (_, i) => `${name}${i >> 2}.${"xyzw"[i & 3]}`);
  const relu = (name) => [0, 1, 2, 3].map((i) => `  ${name}${i} = max(${name}${i}, 0.0);`);
  lines.push(...first, ...relu("a"));
  lines.push(...layer("b", weights.bias_1), ...products("b", hidden("a").map((h, i) => [h, weights.weights_1[i]])), ...relu("b"));
  lines.push(`  vec3 c = ${vector(weights.bias_2)};`);
  hidden("b").forEach((h, i) => lines.push(`  c += ${h} * ${vector(weights.weights_2[i])};`));
  return [
    "vec3 residual(vec3 colour, vec4 features, vec3 direction) {",
    ...lines,
    "  return 1.0 / (1.0 + exp(-clamp(c, -30.0, 30.0)));",
    "}",
    "",
  ].join("\n");
}

const fours = (values) => [0, 4, 8, 12].map((i) => vector(values.slice(i, i + 4)));
const layer = (name, bias) => fours(bias).map((value, i) => `  vec4 ${name}${i} = ${value};`);
const products = (name, rows) => rows.flatMap(([input, weights]) => fours(weights).map((value, i) => `  ${name}${i} += ${input} * ${value};`));
