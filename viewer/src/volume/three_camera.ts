import { Matrix4, OrthographicCamera, PerspectiveCamera, type Quaternion, Vector3 } from "three";
import type { SnergCamera } from "../data/cameras";

/**
 * An exported camera as one of three.js, with its lens, shift and clip planes, for a picture of its own aspect ratio.
 *
 * yUp: as of `SnergVolume`. far: the far plane, in units of the scene, of a camera that has none.
 */
export function threeCamera(
  camera: SnergCamera,
  { yUp = false, far = 1000 }: { yUp?: boolean; far?: number } = {},
): PerspectiveCamera | OrthographicCamera {
  const [[fx, fy], [cx, cy]] = [camera.focal, camera.centre];
  const { width, height } = camera;
  const last = camera.far ?? far;
  const near = Math.max(camera.near, last * 1e-5); // a depth buffer wants one above 0
  let made: PerspectiveCamera | OrthographicCamera;
  if (camera.projection === "orthographic") {
    made = new OrthographicCamera(-cx / fx, (width - cx) / fx, cy / fy, (cy - height) / fy, near, last);
  } else {
    const aspect = (width * fy) / (height * fx);
    made = new PerspectiveCamera((2 * Math.atan(height / (2 * fy)) * 180) / Math.PI, aspect, near, last);
    if (cx !== width / 2 || cy !== height / 2) made.setViewOffset(width, height, width / 2 - cx, height / 2 - cy, width, height);
    made.aspect = aspect; // setViewOffset sets that of square pixels
  }
  const pose = new Matrix4();
  if (yUp) pose.makeRotationX(-Math.PI / 2);
  else made.up.set(0, 0, 1);
  pose.multiply(camera.cameraToWorld).decompose(made.position, made.quaternion as Quaternion, new Vector3());
  made.updateProjectionMatrix();
  made.updateMatrixWorld();
  return made;
}
