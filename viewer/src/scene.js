// scene.json, indirection.png and cameras.json: reads them, and checks every value that the viewer uses.
import { Matrix3, Matrix4, Vector3 } from "three";
import { EXPORT_AGAIN, ViewerError } from "./errors.js";
import { readFile, readJson } from "./files.js";
import { decodes } from "./image.js";
import { decodePng } from "./png.js";

export const DATA_VOXELS = 30; // voxels of a macroblock along an axis
export const CELL_VOXELS = 32; // the same with the apron of one voxel on each side, as stored in a cell of the atlas
const CODECS = ["png", "webp", "jxl", "jpeg", "avif"]; // that browsers decode, JPEG XL not all of them
const NETWORK_SHAPES = { weights_0: [34, 16], bias_0: [16], weights_1: [16, 16], bias_1: [16], weights_2: [16, 3], bias_2: [3] };

/** A rigid transform, given by its four rows as in the JSON files. */
export const matrixOfRows = (rows) => new Matrix4(...rows.flat());

/** The rotation of a rigid transform, as a Matrix4. */
export const rotationOf = (pose) => pose.clone().setPosition(0, 0, 0);

export const positionOf = (pose) => new Vector3().setFromMatrixPosition(pose);

const isArray = (value, shape) =>
  shape.length === 0
    ? Number.isFinite(value)
    : Array.isArray(value) && value.length === shape[0] && value.every((item) => isArray(item, shape.slice(1)));
const isPositiveInteger = (value) => Number.isSafeInteger(value) && value > 0;
const isShape = (value) => Array.isArray(value) && value.length === 3 && value.every(isPositiveInteger);

/**
 * What scene.json holds (as `codec` the first of its codecs that this browser decodes), and with it `blocks`, the number of macroblocks along x, y and z; `gridToWorld`, a Matrix4 whose
 * rotation's columns are the grid's axes and whose position is the grid's corner; and `networkFromWorld`, a rotation as a Matrix4.
 *
 * Throws a ViewerError that names the file and the key where a value is missing or invalid.
 */
export async function readScene(name) {
  const scene = await readJson(name);
  if (scene === null || typeof scene !== "object" || scene.format !== "snerg-scene") {
    throw new ViewerError(`The file ${name} is damaged: it does not describe a SNeRG scene. ${EXPORT_AGAIN}`);
  }
  if (scene.version !== 3) {
    throw new ViewerError(`The file ${name} has version ${scene.version} of the format, which this viewer does not read. ${EXPORT_AGAIN}`);
  }
  const invalid = invalidKey(scene);
  if (invalid) throw new ViewerError(`The file ${name} is damaged: "${invalid}" is missing or invalid. ${EXPORT_AGAIN}`);
  return {
    ...scene,
    codec: await decodableCodec(scene, name),
    blocks: scene.shape.map((voxels) => Math.ceil(voxels / DATA_VOXELS)),
    gridToWorld: matrixOfRows(scene.grid_to_world),
    networkFromWorld: new Matrix4().setFromMatrix3(new Matrix3(...scene.view_rotation.flat())),
  };
}

/** The first of a scene's codecs that this browser decodes. The images of each lie beside those of the others. */
async function decodableCodec(scene, name) {
  for (const codec of [scene.codec, ...(scene.alternatives ?? [])]) {
    if (await decodes(codec.name)) return codec;
  }
  throw new ViewerError(`This browser decodes no ${scene.codec.name}, and ${name} names no other codec. ${EXPORT_AGAIN}`);
}

/** The first key of scene.json whose value is missing or invalid, or undefined. */
function invalidKey(scene) {
  const [bx, by, bz] = isShape(scene.atlas_blocks) ? scene.atlas_blocks : [0, 0, 0];
  const valid = {
    voxel_size: Number.isFinite(scene.voxel_size) && scene.voxel_size > 0,
    shape: isShape(scene.shape),
    grid_to_world: isArray(scene.grid_to_world, [4, 4]),
    view_rotation: isArray(scene.view_rotation, [3, 3]),
    near: Number.isFinite(scene.near),
    codec: isCodecs([scene.codec]),
    alternatives: scene.alternatives === undefined || isCodecs(scene.alternatives),
    atlas_blocks: isShape(scene.atlas_blocks),
    cells: Number.isSafeInteger(scene.cells) && scene.cells >= 0 && scene.cells <= bx * by * bz,
    network_transmittance: Number.isFinite(scene.network_transmittance),
    network: scene.network === null || isNetwork(scene.network),
    ndc: scene.ndc === null || isNdc(scene.ndc),
    fill_holes: typeof scene.fill_holes === "boolean",
  };
  return Object.keys(valid).find((key) => !valid[key]);
}

function isCodecs(codecs) {
  return Array.isArray(codecs) && codecs.every((codec) => CODECS.includes(codec?.name) && [undefined, true, false].includes(codec.half_features));
}

function isNetwork(network) {
  return typeof network === "object" && Object.entries(NETWORK_SHAPES).every(([key, shape]) => isArray(network?.[key], shape));
}

function isNdc(ndc) {
  const isPositive = (value) => value > 0 && Number.isFinite(value);
  return isArray(ndc?.camera_to_world, [4, 4]) && isArray(ndc.focal, [2]) && [...ndc.focal, ndc.near].every(isPositive);
}

/**
 * The cell of each macroblock, or -1 where a macroblock is empty: Int32Array, x fastest, then y, then z.
 *
 * Throws a ViewerError where the file is damaged or a number is not below scene.cells.
 */
export async function readIndirection(name, scene) {
  const [bx, by, bz] = scene.blocks;
  const pixels = await decodePng(await readFile(name), name, bx, by * bz, 3);
  const cells = new Int32Array(bx * by * bz);
  for (let i = 0; i < cells.length; i++) cells[i] = pixels[3 * i] + 256 * pixels[3 * i + 1] + 65536 * pixels[3 * i + 2] - 1;
  if (cells.some((cell) => cell >= scene.cells)) {
    throw new ViewerError(`The file ${name} is damaged: it points outside the atlas. ${EXPORT_AGAIN}`);
  }
  return cells;
}

/**
 * The cameras of cameras.json, each with its pose as `cameraToWorld` (Matrix4) and with a name where it has none.
 *
 * Throws a ViewerError where the file is no list of cameras.
 */
export async function readCameras(name) {
  const value = await readJson(name);
  if (!Array.isArray(value?.cameras) || !value.cameras.every(isCamera)) {
    throw new ViewerError(`The file ${name} is damaged: it is not a list of cameras. ${EXPORT_AGAIN}`);
  }
  return value.cameras.map((camera, i) => ({
    ...camera,
    name: typeof camera.name === "string" && camera.name ? camera.name : `Camera ${i + 1}`,
    cameraToWorld: matrixOfRows(camera.camera_to_world),
  }));
}

function isCamera(camera) {
  return (
    camera !== null &&
    typeof camera === "object" &&
    isPositiveInteger(camera.width) &&
    isPositiveInteger(camera.height) &&
    isArray(camera.focal, [2]) &&
    camera.focal.every((f) => f > 0) &&
    isArray(camera.centre, [2]) &&
    isArray(camera.camera_to_world, [4, 4]) &&
    Number.isFinite(camera.near) &&
    (camera.far === undefined || camera.far > camera.near) &&
    ["perspective", "orthographic"].includes(camera.projection)
  );
}
