// cameras.json: the cameras that were exported with a scene.
import type { Matrix4 } from "three";
import { EXPORT_AGAIN, ViewerError } from "../errors";
import { type FileSource, readJson } from "./files";
import { isArray, isPositiveInteger, matrixOfRows } from "./scene";

const THUMBNAIL = /^thumbnails\/\d+\.webp$/; // nothing but a file of the bundle's own

/** A pinhole or orthographic camera. Pixels are counted from the top left corner; lengths are in units of the scene. */
export interface SnergCamera {
  name: string;
  projection: "perspective" | "orthographic";
  width: number; // pixels
  height: number;
  focal: [number, number]; // pixels; of an orthographic camera, pixels a unit
  centre: [number, number]; // the principal point, pixels
  near: number; // of the clip planes, along the view axis
  far?: number;
  distortion?: unknown; // of the lens; not shown
  thumbnail?: string; // the file of its small picture, in the bundle
  cameraToWorld: Matrix4; // rigid; x right, y up, the camera looks along -z
}

/** The optional code that a page loads by itself. */
export type PartName = "annotations" | "measure" | "vr";
const PARTS: readonly PartName[] = ["annotations", "measure", "vr"];
const SYSTEMS = ["metric", "imperial", "none"] as const;

/** What a unit of the scene is, and in which system lengths are told. */
export interface WorldUnits {
  metres: number; // of a unit
  system: (typeof SYSTEMS)[number]; // none: in units of the scene
}

/** The layers of the atlas in the order of their importance to the first camera, of which the first `seen` hold all that it sees. */
export interface LayerOrder {
  order: number[];
  seen: number;
}

/** What cameras.json says. */
export interface CameraList {
  cameras: SnergCamera[];
  coarse: boolean; // whether the bundle also has the scene at a quarter of its resolution, in coarse/
  path: boolean; // whether it has a camera path, in path.json
  parts: PartName[];
  units: WorldUnits;
  layers: LayerOrder | null; // what the scene's cells are read by; null where it does not matter
}

/** The cameras of a file; one without a name gets one. Rejects with a ViewerError where the file is no list of cameras. */
export async function readCameras(source: FileSource, name: string, signal?: AbortSignal): Promise<CameraList> {
  const value = (await readJson(source, name, signal)) as { [key in keyof CameraList]?: unknown } | null;
  if (!Array.isArray(value?.cameras) || !value.cameras.every(isCamera)) {
    throw new ViewerError(`The file ${name} is damaged: it is not a list of cameras. ${EXPORT_AGAIN}`);
  }
  const cameras = value.cameras.map((camera, i) => ({
    ...camera,
    name: typeof camera.name === "string" && camera.name ? camera.name : `Camera ${i + 1}`,
    cameraToWorld: matrixOfRows(camera.camera_to_world),
  }));
  const parts = PARTS.filter((part) => Array.isArray(value.parts) && value.parts.includes(part));
  const layers = isLayerOrder(value.layers) ? value.layers : null;
  return { cameras, coarse: value.coarse === true, path: value.path === true, layers, parts, units: unitsOf(value.units) };
}

/** The index of a camera by its name, or by its index as text; -1 if there is none. */
export function findCamera(cameras: readonly SnergCamera[], text: string | null): number {
  if (text === null) return -1;
  const named = cameras.findIndex((camera) => camera.name === text);
  if (named >= 0) return named;
  return /^\d+$/.test(text) && Number(text) < cameras.length ? Number(text) : -1;
}

/** Units as a file gives them; metres where they are missing or damaged. */
function unitsOf(value: unknown): WorldUnits {
  const { metres, system } = (value ?? {}) as Partial<WorldUnits>;
  return {
    metres: typeof metres === "number" && metres > 0 && Number.isFinite(metres) ? metres : 1,
    system: SYSTEMS.find((each) => each === system) ?? "metric",
  };
}

function isLayerOrder(value: unknown): value is LayerOrder {
  const { order, seen } = (value ?? {}) as Partial<LayerOrder>;
  return Array.isArray(order) && order.every((layer) => Number.isSafeInteger(layer) && layer >= 0) && Number.isSafeInteger(seen);
}

function isCamera(camera: (SnergCamera & { camera_to_world: unknown }) | null): boolean {
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
    ["perspective", "orthographic"].includes(camera.projection) &&
    (camera.thumbnail === undefined || (typeof camera.thumbnail === "string" && THUMBNAIL.test(camera.thumbnail)))
  );
}
