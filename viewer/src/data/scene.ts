// scene.json and indirection.png: reads them, and checks every value that the viewer uses.
import { Matrix3, Matrix4, Vector3 } from "three";
import { EXPORT_AGAIN, ViewerError } from "../errors";
import { type FileSource, readJson } from "./files";
import { decodes } from "./image";
import { decodePng } from "./png";

export const DATA_VOXELS = 30; // voxels of a macroblock along an axis
export const CELL_VOXELS = 32; // the same with the apron of one voxel on each side, as stored in a cell of the atlas
const ROOTS_VERSION = 4; // of the format of scenes of square roots; others are of version 3
const CODECS = ["png", "webp", "jxl", "jpeg", "avif"]; // that browsers decode, JPEG XL not all of them
const NETWORK_SHAPES = { weights_0: [34, 16], bias_0: [16], weights_1: [16, 16], bias_1: [16], weights_2: [16, 3], bias_2: [3] };

type Triple = [number, number, number];

/** The weights of the network of the view dependence (paper, section 4.2): 34 inputs, 16, 16 and 3 outputs; rows are inputs. */
export interface NetworkWeights {
  weights_0: number[][];
  bias_0: number[];
  weights_1: number[][];
  bias_1: number[];
  weights_2: number[][];
  bias_2: number[];
}

/** The frame of a forward-facing scene, whose grid lies in its normalised device coordinates. */
export interface NdcFrame {
  camera_to_world: number[][]; // [4, 4], rigid
  focal: [number, number]; // focal lengths over half the frame's size
  near: number; // the near plane's distance, in units of the scene
}

/** How the images of a scene are stored. */
export interface Codec {
  name: "png" | "webp" | "jxl" | "jpeg" | "avif";
  half_features?: boolean; // whether features have half the resolution
}

/** What scene.json holds, checked, and what the viewer derives from it. Lengths are in units of the scene. */
export interface SceneDescription {
  voxel_size: number;
  shape: Triple; // voxels along x, y and z
  grid_to_world: number[][];
  view_rotation: number[][];
  near: number; // along each ray, where the scene begins
  codec: Codec; // the first of the scene's that this browser decodes
  alternatives?: Codec[]; // the images of each lie beside those of the others
  atlas_blocks: Triple; // cells of the atlas along x, y and z
  cells: number; // macroblocks that are not empty
  network_transmittance: number; // the network is evaluated where no more than this is left
  network: NetworkWeights | null; // null in a diffuse scene
  ndc: NdcFrame | null;
  fill_holes: boolean;
  square_roots: boolean; // whether texels hold the square roots of their values: in thin fog
  blocks: Triple; // macroblocks along x, y and z
  gridToWorld: Matrix4; // the rotation's columns are the grid's axes, the position is the grid's corner
  networkFromWorld: Matrix4; // a rotation, to the axes in which the network was trained
}

/** A rigid transform, given by its four rows as in the JSON files. */
export const matrixOfRows = (rows: number[][]): Matrix4 => new Matrix4().set(...(rows.flat() as Parameters<Matrix4["set"]>));

/** The rotation of a rigid transform, as a Matrix4. */
export const rotationOf = (pose: Matrix4): Matrix4 => pose.clone().setPosition(0, 0, 0);

export const positionOf = (pose: Matrix4): Vector3 => new Vector3().setFromMatrixPosition(pose);

/** Whether a value is an array of numbers of that shape. */
export const isArray = (value: unknown, shape: readonly number[]): boolean =>
  shape.length === 0
    ? Number.isFinite(value)
    : Array.isArray(value) && value.length === shape[0] && value.every((item) => isArray(item, shape.slice(1)));
export const isPositiveInteger = (value: unknown): boolean => Number.isSafeInteger(value) && (value as number) > 0;
const isShape = (value: unknown): value is Triple => Array.isArray(value) && value.length === 3 && value.every(isPositiveInteger);

/** The description in a file. Rejects with a ViewerError that names the file and the key where a value is missing or invalid. */
export async function readScene(source: FileSource, name: string, signal?: AbortSignal): Promise<SceneDescription> {
  const value = (await readJson(source, name, signal)) as (SceneDescription & { format: unknown; version: unknown }) | null;
  if (value === null || typeof value !== "object" || value.format !== "snerg-scene") {
    throw new ViewerError(`The file ${name} is damaged: it does not describe a SNeRG scene. ${EXPORT_AGAIN}`);
  }
  if (value.version !== 3 && value.version !== ROOTS_VERSION) {
    throw new ViewerError(`The file ${name} has version ${value.version} of the format, which this viewer does not read. ${EXPORT_AGAIN}`);
  }
  if (value.version === 3) value.square_roots = false;
  const invalid = invalidKey(value);
  if (invalid) throw new ViewerError(`The file ${name} is damaged: "${invalid}" is missing or invalid. ${EXPORT_AGAIN}`);
  return {
    ...value,
    codec: await decodableCodec(value, name),
    blocks: value.shape.map((voxels) => Math.ceil(voxels / DATA_VOXELS)) as Triple,
    gridToWorld: matrixOfRows(value.grid_to_world),
    networkFromWorld: new Matrix4().setFromMatrix3(new Matrix3().set(...(value.view_rotation.flat() as Parameters<Matrix3["set"]>))),
  };
}

/** The first of a scene's codecs that this browser decodes. */
async function decodableCodec(scene: SceneDescription, name: string): Promise<Codec> {
  for (const codec of [scene.codec, ...(scene.alternatives ?? [])]) {
    if (await decodes(codec.name)) return codec;
  }
  throw new ViewerError(`This browser decodes no ${scene.codec.name}, and ${name} names no other codec. ${EXPORT_AGAIN}`);
}

/** The first key of scene.json whose value is missing or invalid, or undefined. */
function invalidKey(scene: SceneDescription): string | undefined {
  const [bx, by, bz] = isShape(scene.atlas_blocks) ? scene.atlas_blocks : [0, 0, 0];
  const valid: Record<string, boolean> = {
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
    square_roots: typeof scene.square_roots === "boolean",
  };
  return Object.keys(valid).find((key) => !valid[key]);
}

function isCodecs(codecs: unknown): boolean {
  const halves = [undefined, true, false];
  return Array.isArray(codecs) && codecs.every((codec) => CODECS.includes(codec?.name) && halves.includes(codec.half_features));
}

function isNetwork(network: unknown): boolean {
  const values = network as Record<string, unknown> | undefined;
  return typeof network === "object" && Object.entries(NETWORK_SHAPES).every(([key, shape]) => isArray(values?.[key], shape));
}

function isNdc(ndc: NdcFrame | undefined): boolean {
  const isPositive = (value: number) => value > 0 && Number.isFinite(value);
  return isArray(ndc?.camera_to_world, [4, 4]) && isArray(ndc?.focal, [2]) && !!ndc && [...ndc.focal, ndc.near].every(isPositive);
}

/**
 * The cell of each macroblock, or -1 where a macroblock is empty: x fastest, then y, then z.
 *
 * Rejects with a ViewerError where the file is damaged or a number is not below scene.cells.
 */
export async function readIndirection(
  source: FileSource,
  name: string,
  scene: SceneDescription,
  signal?: AbortSignal,
): Promise<Int32Array<ArrayBuffer>> {
  const [bx, by, bz] = scene.blocks;
  const pixels = await decodePng(await source.read(name, signal), name, bx, by * bz, 3);
  const cells = new Int32Array(bx * by * bz);
  for (let i = 0; i < cells.length; i++) cells[i] = pixels[3 * i] + 256 * pixels[3 * i + 1] + 65536 * pixels[3 * i + 2] - 1;
  if (cells.some((cell) => cell >= scene.cells)) {
    throw new ViewerError(`The file ${name} is damaged: it points outside the atlas. ${EXPORT_AGAIN}`);
  }
  return cells;
}
