// Points of a scene and their places in a picture of it.
import { type Camera, Vector3, type WebGLRenderer } from "three";
import type { SnergVolume } from "../volume/volume";
import type { ProjectedPoint, ScenePoint } from "./interface";

/** The picture that points are seen in. */
export interface SeenIn {
  camera: Camera; // in Blender's axes
  width: number; // of the canvas, in CSS pixels
  height: number;
}

/** The points of a volume that are seen at places of the canvas, as `Viewer.pick` gives them. */
export function pickPoints(
  renderer: WebGLRenderer,
  volume: SnergVolume,
  seenIn: SeenIn,
  places: readonly (readonly [number, number])[],
): (ScenePoint | null)[] {
  const points = places.map(([x, y]) => [(2 * x) / seenIn.width - 1, 1 - (2 * y) / seenIn.height] as const);
  return volume.pick(renderer, seenIn.camera, points).map((point) => {
    if (!point) return null;
    const { depth } = projectPoint(seenIn, point.toArray());
    return { position: point.toArray(), depth, voxel: volume.voxelAt(point) };
  });
}

/** Where a point of the scene lies. */
export function projectPoint({ camera, width, height }: SeenIn, point: readonly number[]): ProjectedPoint {
  camera.updateMatrixWorld();
  const seen = new Vector3(...point).applyMatrix4(camera.matrixWorldInverse);
  const depth = -seen.z;
  const { x, y } = seen.applyMatrix4(camera.projectionMatrix);
  return { x: ((x + 1) / 2) * width, y: ((1 - y) / 2) * height, depth };
}
