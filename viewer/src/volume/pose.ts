// Where a scene stands and how a camera sees it: the numbers that march.glsl wants, computed in double precision.
import { type Camera, Matrix4, Vector3, Vector4 } from "three";
import { matrixOfRows, positionOf, rotationOf, type SceneDescription } from "../data/scene";

const FARTHEST = 1e9; // ray space units: the far plane of cameras without one
const EVEN = 1e-4; // relative: how far the axes of a transform may be from equally long and perpendicular

/** The uniforms of march.glsl that follow the camera and the volume. */
export interface ViewUniforms {
  focal: [number, number];
  principalPoint: [number, number];
  viewport: [number, number, number];
  orthographic: boolean;
  cameraPosition: Vector3;
  raySpaceFromCamera: Matrix4;
  networkFromCamera: Matrix4;
  nearDistance: number;
  clipPlanes: [number, number];
  depthTerms: Vector4;
  clipFromGrid: Matrix4;
  unit: number; // of ray space, in units of the world
  moved: number; // ray space: how far before the camera depths begin
}

/** The pose of the space in which rays are given: the grid's, or of a forward-facing scene the frame's. */
export const raySpacePose = (scene: SceneDescription): Matrix4 => (scene.ndc ? matrixOfRows(scene.ndc.camera_to_world) : scene.gridToWorld);

/** The length of a unit of ray space: a voxel, or the distance of the frame's near plane. */
export const raySpaceUnit = (scene: SceneDescription): number => (scene.ndc ? scene.ndc.near : scene.voxel_size);

/** The rotation, the scale and the position of a transform; null where its scale is uneven, or it mirrors or shears. */
export function similarity(matrix: Matrix4): { rotation: Matrix4; scale: number; position: Vector3 } | null {
  const axes = [0, 1, 2].map((column) => new Vector3().setFromMatrixColumn(matrix, column));
  const [x, y, z] = axes;
  const scale = Math.cbrt(matrix.determinant());
  if (!(scale > 0) || !Number.isFinite(scale)) return null;
  const uneven = axes.some((axis) => Math.abs(axis.length() / scale - 1) > EVEN);
  if (uneven || [x.dot(y), y.dot(z), z.dot(x)].some((dot) => Math.abs(dot) > EVEN * scale * scale)) return null;
  for (const axis of axes) axis.divideScalar(scale);
  return { rotation: new Matrix4().makeBasis(x, y, z), scale, position: positionOf(matrix) };
}

/**
 * The uniforms for a camera of three.js, whose projection may be of any pinhole or orthographic kind.
 *
 * standing: of the volume, see `similarity`. viewport: x, y, width and height of the image in pixels. reversed: whether the depth buffer is.
 */
export function viewUniforms(
  scene: SceneDescription,
  standing: { rotation: Matrix4; scale: number; position: Vector3 },
  camera: Camera,
  viewport: Vector4,
  reversed: boolean,
): ViewUniforms {
  const unit = raySpaceUnit(scene) * standing.scale;
  const pose = raySpacePose(scene);
  const worldFromRaySpace = standing.rotation.clone().multiply(rotationOf(pose));
  const raySpaceFromWorld = worldFromRaySpace.clone().transpose(); // a rotation
  const corner = positionOf(pose).multiplyScalar(standing.scale).applyMatrix4(standing.rotation).add(standing.position);
  const rotation = new Matrix4().extractRotation(camera.matrixWorld);
  const raySpaceFromCamera = raySpaceFromWorld.clone().multiply(rotation);
  // Subtract first: far from the world's origin, the difference of two rotated positions would lose precision.
  const cameraPosition = positionOf(camera.matrixWorld).sub(corner).applyMatrix4(raySpaceFromWorld).divideScalar(unit);
  const clipFromGrid = boxProjection(camera, raySpaceFromCamera, cameraPosition, unit);
  const e = camera.projectionMatrix.elements;
  const orthographic = e[15] === 1;
  const moved = orthographic && !scene.ndc ? moveToBox(scene, cameraPosition, raySpaceFromCamera) : 0;
  const { near = 0, far = Number.POSITIVE_INFINITY } = camera as Camera & { near?: number; far?: number };
  const [width, height] = [viewport.z / 2, viewport.w / 2];
  const along = orthographic ? unit : 1; // world units a unit of the image plane
  const shift = orthographic ? [e[12], e[13]] : [-e[8], -e[9]];
  return {
    focal: [width * e[0] * along, height * e[5] * along],
    principalPoint: [width * (1 + shift[0]), height * (1 - shift[1])],
    viewport: [viewport.x, viewport.y, viewport.w],
    orthographic,
    cameraPosition,
    raySpaceFromCamera,
    networkFromCamera: scene.networkFromWorld.clone().multiply(standing.rotation.clone().transpose()).multiply(rotation),
    nearDistance: scene.near / raySpaceUnit(scene) - moved,
    clipPlanes: [near / unit - moved, Math.min(far / unit - moved, FARTHEST)],
    depthTerms: depthTerms(e, orthographic, unit, moved, reversed),
    clipFromGrid,
    unit,
    moved,
  };
}

/** See march.glsl. e: the elements of the projection matrix. */
function depthTerms(e: readonly number[], orthographic: boolean, unit: number, moved: number, reversed: boolean): Vector4 {
  const [scale, offset] = reversed ? [1, 0] : [0.5, 0.5];
  if (orthographic) return new Vector4(e[14] - e[10] * moved * unit, e[10] * unit, scale, offset);
  return new Vector4(e[14] / unit, e[10], scale, offset);
}

/** Clip coordinates from voxels of the grid. */
function boxProjection(camera: Camera, raySpaceFromCamera: Matrix4, cameraPosition: Vector3, unit: number): Matrix4 {
  const cameraFromGrid = raySpaceFromCamera.clone().setPosition(cameraPosition).invert(); // in voxels
  return camera.projectionMatrix
    .clone()
    .multiply(new Matrix4().makeScale(unit, unit, unit))
    .multiply(cameraFromGrid);
}

/** Move an orthographic camera forward to just before the box, where single precision resolves its rays. Returns by how many voxels. */
function moveToBox(scene: SceneDescription, position: Vector3, raySpaceFromCamera: Matrix4): number {
  const forward = new Vector3().setFromMatrixColumn(raySpaceFromCamera, 2).negate();
  const halfBox = new Vector3(...scene.shape).multiplyScalar(0.5);
  const distance = Math.max(0, halfBox.clone().sub(position).dot(forward) - halfBox.length() - 1);
  position.addScaledVector(forward, distance);
  return distance;
}
