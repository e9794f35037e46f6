// The cameras of the paper's benchmark (supplement, appendix C): 150 frames on an orbit round the scene, or, where the scene is
// forward-facing, on a circle in the cameras' plane, at the resolution and the field of view of the paper's photographs.
import { Matrix4, PerspectiveCamera, Vector3 } from "three";
import type { SnergCamera } from "../../data/cameras";
import { matrixOfRows, positionOf, type SceneDescription } from "../../data/scene";
import { sphereOf } from "../../volume/volume";

export const FRAMES = 150;

/** width and height in pixels; fieldOfView: horizontal, degrees. */
export const KINDS = {
  synthetic: { width: 800, height: 800, fieldOfView: 39 },
  "forward-facing": { width: 1006, height: 756, fieldOfView: 53 },
  "360": { width: 990, height: 773, fieldOfView: 53 },
} as const;
export type BenchmarkKind = keyof typeof KINDS;

const SYNTHETIC_BELOW = 46; // degrees of the first camera's field of view: between the 39 and the 53 of the paper's kinds
const DISTANCE = 1.6; // of the orbit from the centre, in diameters of the scene, where there is no camera
const ELEVATION = 30; // degrees, where there is no camera
const HIGHEST = 80; // degrees of an orbit's elevation: above, it would hardly move
const SWAY = 0.25; // radius of the circle in distances of the near plane, where fewer than 3 cameras say how far they lie apart
const REACH = 0.9; // quantile of the cameras' distances from their mean that the circle reaches, as in the original NeRF

/** The kind of a scene: from its coordinates, and from the first camera's field of view, which real photographs have wider. */
export function kindOf(scene: SceneDescription, cameras: readonly SnergCamera[]): BenchmarkKind {
  if (scene.ndc) return "forward-facing";
  const camera = cameras[0];
  if (!camera || camera.projection === "orthographic") return "synthetic";
  return (2 * Math.atan(camera.width / (2 * camera.focal[0])) * 180) / Math.PI < SYNTHETIC_BELOW ? "synthetic" : "360";
}

/** The camera at a part of the path, in [0, 1). */
export function frameCamera(
  scene: SceneDescription,
  cameras: readonly SnergCamera[],
  kind: BenchmarkKind,
  part: number,
): PerspectiveCamera {
  const { width, height, fieldOfView } = KINDS[kind];
  const vertical = 2 * Math.atan((Math.tan((fieldOfView * Math.PI) / 360) * height) / width);
  const { center, radius } = sphereOf(scene);
  const camera = new PerspectiveCamera((vertical * 180) / Math.PI, width / height, 1e-3 * radius, 1e3 * radius);
  const angle = 2 * Math.PI * part;
  camera.matrixAutoUpdate = false;
  camera.matrix.copy(scene.ndc ? swayed(scene, cameras, angle) : orbited(center, radius, cameras, angle));
  camera.updateMatrixWorld(true);
  return camera;
}

/** On a circle round the vertical axis through the centre, as far and as high as the first camera. */
function orbited(centre: Vector3, radius: number, cameras: readonly SnergCamera[], angle: number): Matrix4 {
  const first = cameras[0] ? positionOf(cameras[0].cameraToWorld).sub(centre) : new Vector3();
  const distance = first.length() > 0 ? first.length() : 2 * DISTANCE * radius;
  const given = first.length() > 0 ? Math.asin(first.z / distance) : (ELEVATION * Math.PI) / 180;
  const highest = (HIGHEST * Math.PI) / 180;
  const elevation = Math.max(-highest, Math.min(given, highest));
  const begin = first.length() > 0 ? Math.atan2(first.y, first.x) : -Math.PI / 2;
  const flat = distance * Math.cos(elevation);
  const offset = new Vector3(flat * Math.cos(begin + angle), flat * Math.sin(begin + angle), distance * Math.sin(elevation));
  return new Matrix4().lookAt(offset, new Vector3(), new Vector3(0, 0, 1)).setPosition(offset.add(centre));
}

/** On a circle in the plane of the frame, looking ahead. */
function swayed(scene: SceneDescription, cameras: readonly SnergCamera[], angle: number): Matrix4 {
  const { camera_to_world, near } = scene.ndc as NonNullable<SceneDescription["ndc"]>;
  const pose = matrixOfRows(camera_to_world);
  const fromWorld = pose.clone().invert();
  const places = cameras.map((camera) => positionOf(camera.cameraToWorld).applyMatrix4(fromWorld));
  const reach = (axis: 0 | 1) => {
    const far = places.map((place) => Math.abs(place.getComponent(axis))).sort((a, b) => a - b);
    return places.length < 3 ? SWAY * near : far[Math.min(far.length - 1, Math.floor(REACH * far.length))];
  };
  const offset = new Vector3(reach(0) * Math.cos(angle), reach(1) * Math.sin(angle), 0);
  return pose.clone().setPosition(offset.applyMatrix4(pose));
}
