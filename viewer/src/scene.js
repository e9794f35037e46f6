// scene.json and cameras.json: read, and checked before anything trusts them.
import { readFile, readJson } from "./files.js";
import { decodePng } from "./png.js";
import { EXPORT_AGAIN, Problem } from "./problem.js";

export const DATA_VOXELS = 30; // a macroblock's own voxels along an axis
export const CELL_VOXELS = 32; // with the apron, as stored in the atlas
const PICTURES = ["png", "webp", "jpeg", "avif"]; // codecs that browsers know
const NETWORK_SHAPES = { weights_0: [34, 16], bias_0: [16], weights_1: [16, 16], bias_1: [16], weights_2: [16, 3], bias_2: [3] };

const isArray = (value, shape) =>
  shape.length === 0
    ? Number.isFinite(value)
    : Array.isArray(value) && value.length === shape[0] && value.every((item) => isArray(item, shape.slice(1)));
const isCount = (value) => Number.isSafeInteger(value) && value > 0;

/** What scene.json says, checked; `blocks` along the axes is added. */
export async function readScene(name) {
  const scene = await readJson(name);
  if (scene === null || typeof scene !== "object" || scene.format !== "snerg-scene") {
    throw new Problem(`The file ${name} is damaged: it does not describe a SNeRG scene. ${EXPORT_AGAIN}`);
  }
  if (scene.version !== 3) {
    throw new Problem(`The file ${name} has version ${scene.version} of the format, which this viewer does not read. ${EXPORT_AGAIN}`);
  }
  const triple = (value) => Array.isArray(value) && value.length === 3 && value.every(isCount);
  const [bx, by, bz] = triple(scene.atlas_blocks) ? scene.atlas_blocks : [0, 0, 0];
  const checks = {
    voxel_size: Number.isFinite(scene.voxel_size) && scene.voxel_size > 0,
    shape: triple(scene.shape),
    grid_to_world: isArray(scene.grid_to_world, [4, 4]),
    view_rotation: isArray(scene.view_rotation, [3, 3]),
    near: Number.isFinite(scene.near),
    codec: PICTURES.includes(scene.codec?.name),
    atlas_blocks: triple(scene.atlas_blocks),
    cells: Number.isSafeInteger(scene.cells) && scene.cells >= 0 && scene.cells <= bx * by * bz,
    network_transmittance: Number.isFinite(scene.network_transmittance),
    network: scene.network === null || isNetwork(scene.network),
    ndc: scene.ndc === null || isFrame(scene.ndc),
    fill_holes: typeof scene.fill_holes === "boolean",
  };
  const bad = Object.keys(checks).filter((key) => !checks[key]);
  if (bad.length) throw new Problem(`The file ${name} is damaged: it has no good "${bad[0]}". ${EXPORT_AGAIN}`);
  return { ...scene, blocks: scene.shape.map((voxels) => Math.ceil(voxels / DATA_VOXELS)) };
}

function isNetwork(network) {
  return typeof network === "object" && Object.entries(NETWORK_SHAPES).every(([key, shape]) => isArray(network?.[key], shape));
}

function isFrame(ndc) {
  return isArray(ndc?.camera_to_world, [4, 4]) && isArray(ndc.focal, [2]) && [...ndc.focal, ndc.near].every((value) => value > 0 && Number.isFinite(value));
}

/** Cell numbers, or -1 where a block is empty: Int32Array, x fastest, then y, then z. */
export async function readIndirection(name, scene) {
  const [bx, by, bz] = scene.blocks;
  const pixels = await decodePng(await readFile(name), name, bx, by * bz, 3);
  const cells = new Int32Array(bx * by * bz);
  for (let i = 0; i < cells.length; i++) cells[i] = pixels[3 * i] + 256 * pixels[3 * i + 1] + 65536 * pixels[3 * i + 2] - 1;
  if (cells.some((cell) => cell >= scene.cells)) {
    throw new Problem(`The file ${name} is damaged: it points outside the atlas. ${EXPORT_AGAIN}`);
  }
  return cells;
}

export async function readCameras(name) {
  const value = await readJson(name);
  const good = (camera) =>
    camera !== null &&
    typeof camera === "object" &&
    isCount(camera.width) &&
    isCount(camera.height) &&
    isArray(camera.focal, [2]) &&
    camera.focal.every((f) => f > 0) &&
    isArray(camera.centre, [2]) &&
    isArray(camera.camera_to_world, [4, 4]) &&
    Number.isFinite(camera.near) &&
    ["perspective", "orthographic"].includes(camera.projection);
  if (!Array.isArray(value?.cameras) || !value.cameras.every(good)) {
    throw new Problem(`The file ${name} is damaged: it is not a list of cameras. ${EXPORT_AGAIN}`);
  }
  return value.cameras.map((camera, i) => ({ ...camera, name: typeof camera.name === "string" && camera.name ? camera.name : `Camera ${i + 1}` }));
}
