// The points of a volume that a camera sees: where, along rays through single pixels, half of the light is gone.
import {
  type Camera,
  NearestFilter,
  NoBlending,
  type Object3D,
  RawShaderMaterial,
  Vector3,
  type WebGLRenderer,
  WebGLRenderTarget,
} from "three";

const PICTURE = 4096; // pixels of the picture along each side, of which the picked ones are rendered: bounds how far a ray misses its point

/** A position in the picture: -1 to 1 from left to right, and from the bottom to the top. */
export type PicturePoint = readonly [number, number];

/** The material that a volume has while it is picked. uniforms: of its own material, shared. */
export const pickingMaterial = (material: RawShaderMaterial, fragmentShader: string): RawShaderMaterial =>
  new RawShaderMaterial({
    glslVersion: material.glslVersion,
    vertexShader: material.vertexShader,
    fragmentShader,
    uniforms: material.uniforms,
    side: material.side,
    blending: NoBlending,
    depthTest: false,
    depthWrite: false,
  });

/**
 * The depths, in the unit of the shader's ray space, that an object with a `pickingMaterial` has at points of a camera's picture; 0 where
 * more than half of the light comes through. Draws one pixel a point, and reads them back.
 */
export function pickDepths(renderer: WebGLRenderer, object: Object3D, camera: Camera, points: readonly PicturePoint[]): Float32Array {
  const target = new WebGLRenderTarget(points.length, 1, { depthBuffer: false, minFilter: NearestFilter, magFilter: NearestFilter });
  const before = { target: renderer.getRenderTarget(), autoClear: renderer.autoClear, xr: renderer.xr.enabled };
  renderer.autoClear = false; // a new target holds zeros
  renderer.xr.enabled = false;
  target.scissorTest = true;
  points.forEach((point, i) => {
    const [x, y] = point.map(pixelOf);
    target.viewport.set(i - x, -y, PICTURE, PICTURE);
    target.scissor.set(i, 0, 1, 1);
    renderer.setRenderTarget(target);
    renderer.render(object, camera);
  });
  const bytes = new Uint8Array(4 * points.length);
  renderer.readRenderTargetPixels(target, 0, 0, points.length, 1, bytes);
  renderer.setRenderTarget(before.target);
  renderer.autoClear = before.autoClear;
  renderer.xr.enabled = before.xr;
  target.dispose();
  const view = new DataView(bytes.buffer);
  return Float32Array.from(points, (_, i) => view.getFloat32(4 * i, true));
}

/** The point of the world at a depth along the view axis, on the ray that `pickDepths` sends through a point of the picture. */
export function unproject(camera: Camera, point: PicturePoint, depth: number): Vector3 {
  const e = camera.projectionMatrix.elements;
  const [x, y] = point.map((value) => (2 * (pixelOf(value) + 0.5)) / PICTURE - 1);
  const local =
    e[15] === 1
      ? new Vector3((x - e[12]) / e[0], (y - e[13]) / e[5], -depth)
      : new Vector3((depth * (x + e[8])) / e[0], (depth * (y + e[9])) / e[5], -depth);
  const rotation = camera.matrixWorld.clone().setPosition(0, 0, 0);
  rotation.extractRotation(rotation);
  return local.applyMatrix4(rotation).add(new Vector3().setFromMatrixPosition(camera.matrixWorld));
}

const pixelOf = (value: number): number => Math.min(Math.max(Math.floor(((value + 1) / 2) * PICTURE), 0), PICTURE - 1);
