// Where a scene stands in the room of a headset: metres, Y up, the floor at 0, and the person at the origin, who looks along -Z.
import { type Box3, Matrix4, Vector3 } from "three";

const OBJECT = 1; // metres: a scene whose radius is less is an object before the person, a larger one is a room to stand in
const HAND_HEIGHT = 1.2; // metres above the floor: where an object's centre is
const REACH = 0.6; // metres from the person to an object's sphere
const EYE_HEIGHT = 1.6; // metres

/** What is placed. Lengths are in units of the scene, axes are Blender's. */
export interface Placed {
  centre: Vector3;
  radius: number;
  box: Box3 | null; // null where nothing bounds the scene below, as in a forward-facing one
  eye: Matrix4; // camera-to-world of the page's view
  metres: number; // of a unit
}

/**
 * The transform from Blender's world to the room. Both kinds of scene show the person the side that the page shows. An object floats at the
 * height of hands. A room begins where the page's camera stands, with its lowest point as the floor.
 */
export function placement({ centre, radius, box, eye, metres }: Placed): Matrix4 {
  const upright = new Matrix4().makeRotationX(-Math.PI / 2);
  const forward = new Vector3().setFromMatrixColumn(eye, 2).negate().applyMatrix4(upright);
  if (Math.hypot(forward.x, forward.z) < 1e-3) forward.setFromMatrixColumn(eye, 1).applyMatrix4(upright); // it looks straight down or up
  const turned = new Matrix4()
    .makeRotationY(Math.atan2(forward.x, -forward.z))
    .multiply(new Matrix4().makeScale(metres, metres, metres))
    .multiply(upright);
  if (radius * metres < OBJECT) {
    const from = centre.clone().applyMatrix4(turned);
    return turned.setPosition(new Vector3(0, HAND_HEIGHT, -(REACH + 2 * radius * metres)).sub(from));
  }
  const from = new Vector3().setFromMatrixPosition(eye).applyMatrix4(turned);
  const floor = box ? box.clone().applyMatrix4(turned).min.y : from.y - EYE_HEIGHT;
  return turned.setPosition(-from.x, -floor, -from.z);
}
