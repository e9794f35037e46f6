// A flight from one camera to another: around the point that each looks at, with the distance from it and the lens in logarithms.
import { Matrix4, Quaternion, Vector3 } from "three";
import type { SnergCamera } from "../data/cameras";

/** The part of the way after a part of the time: slow at both ends, without a jump in the acceleration. */
export const eased = (part: number): number => part * part * part * (10 + part * (6 * part - 15));

/**
 * A camera on the way: part 0 is the first, 1 the second. Both are of the same projection.
 *
 * distances: how far before each camera lies the point that it looks at. The camera turns by the shorter way, through poles too.
 */
export function between<T extends Omit<SnergCamera, "name">>(from: T, to: T, part: number, distances: readonly [number, number]): T {
  const [a, b] = [from, to].map(({ cameraToWorld }, i) => {
    const [position, rotation] = [new Vector3(), new Quaternion()];
    cameraToWorld.decompose(position, rotation, new Vector3());
    return { rotation, target: backward(rotation).multiplyScalar(-distances[i]).add(position) };
  });
  const rotation = a.rotation.clone().slerp(b.rotation, part);
  const distance = distances[0] * (distances[1] / distances[0]) ** part;
  // From the target, and not from a sum of positions: far from the origin that would lose nothing either, but a circle stays round.
  const position = a.target.lerp(b.target, part).addScaledVector(backward(rotation), distance);
  const scale = to.height / from.height; // the lens, in heights of the picture
  const focal = from.focal.map((f, i) => f * scale * (to.focal[i] / (f * scale)) ** part) as [number, number];
  const centre = from.centre.map((c, i) => c * (i ? scale : to.width / from.width) * (1 - part) + to.centre[i] * part) as [number, number];
  return { ...to, focal, centre, cameraToWorld: new Matrix4().compose(position, rotation, new Vector3(1, 1, 1)) };
}

const backward = (rotation: Quaternion): Vector3 => new Vector3(0, 0, 1).applyQuaternion(rotation);

export const wantsLessMotion = (): boolean => matchMedia("(prefers-reduced-motion: reduce)").matches;
