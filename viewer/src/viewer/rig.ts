// Where a camera stands and what it turns around, and how it eases from one place to the next. Knows no mouse, no keys and no page.
import { Matrix4, Quaternion, Vector3 } from "three";
import { positionOf } from "../data/scene";

const SETTLING = 0.07; // seconds in which 63 % of a move is done
const STILL = 1e-4; // radians, and of the distance to the pivot: what is left of a move when it is over
const STRAIGHT = 1e-4; // radians from straight down or up, where the heading is the picture's and there is no roll
const [X, Z] = [new Vector3(1, 0, 0), new Vector3(0, 0, 1)];
const SPAN = 1000; // of the extent of an orthographic camera, from its own

/** A camera that looks at a pivot. Angles in radians, lengths in units of the scene. */
export interface Stance {
  pivot: Vector3;
  heading: number; // around Z; at 0 the camera stands on the side of -Y
  elevation: number; // of the camera above the pivot's horizon
  roll: number; // of the camera around its view axis, counterclockwise
  distance: number; // from the pivot
  extent: number; // of an orthographic camera's image, from its own
}

/** Where a camera may go. */
export interface OrbitLimits {
  distance?: [number, number]; // nearest and farthest, in units of the scene, from the point that is looked at
  elevation?: [number, number]; // lowest and highest, in degrees above the horizon
}

/** What stays in its place while a camera turns: what it looks at, or the camera. */
export type Anchor = "pivot" | "position";

export const copyOf = (stance: Stance): Stance => ({ ...stance, pivot: stance.pivot.clone() });

/** The rotation of the camera's axes: x right, y up, z backward. */
export function rotationOf({ heading, elevation, roll }: Stance): Quaternion {
  const turn = (axis: Vector3, angle: number) => new Quaternion().setFromAxisAngle(axis, angle);
  return turn(Z, heading)
    .multiply(turn(X, Math.PI / 2 - elevation))
    .multiply(turn(Z, roll));
}

export const positionIn = (stance: Stance): Vector3 =>
  new Vector3(0, 0, stance.distance).applyQuaternion(rotationOf(stance)).add(stance.pivot);

export const matrixOf = (stance: Stance): Matrix4 => new Matrix4().compose(positionIn(stance), rotationOf(stance), new Vector3(1, 1, 1));

/** The stance of a camera with that pose and distance from its pivot. */
export function stanceOf(cameraToWorld: Matrix4, distance: number): Stance {
  const [right, , backward] = [0, 1, 2].map((column) => new Vector3().setFromMatrixColumn(cameraToWorld, column));
  const pivot = positionOf(cameraToWorld).addScaledVector(backward, -distance);
  const elevation = Math.asin(Math.min(Math.max(backward.z, -1), 1));
  if (Math.hypot(backward.x, backward.y) < STRAIGHT) {
    return { pivot, heading: Math.atan2(right.y, right.x), elevation, roll: 0, distance, extent: 1 };
  }
  const heading = Math.atan2(backward.x, -backward.y);
  const level = new Vector3(Math.cos(heading), Math.sin(heading), 0);
  const roll = Math.atan2(right.dot(backward.clone().cross(level)), right.dot(level));
  return { pivot, heading, elevation, roll, distance, extent: 1 };
}

/** A camera that eases to its goal, at the same pace at any frame rate. */
export class Rig {
  now: Stance; // what is shown
  goal: Stance;
  private anchor: Anchor = "pivot";
  private easing: Anchor = "pivot"; // what stays in its place on the way to the goal
  private home = new Vector3(); // what a camera that flies keeps its limits around
  private readonly distances: [number, number];
  private readonly elevations: [number, number];

  /** size: of the scene, in its units. */
  constructor(
    readonly size: number,
    private readonly limits: OrbitLimits = {},
  ) {
    this.distances = limits.distance ?? [1e-3 * size, 100 * size];
    const [low, high] = limits.elevation ?? [-90, 90];
    this.elevations = [(low * Math.PI) / 180, (high * Math.PI) / 180];
    this.goal = { pivot: new Vector3(), heading: 0, elevation: 0, roll: 0, distance: size, extent: 1 };
    this.now = this.goal;
  }

  /** Stand there at once. */
  stand(stance: Stance): void {
    this.now = this.goal = stance;
    this.home.copy(stance.pivot);
  }

  /** What turning leaves in its place from now on. A camera that flies keeps the limits around what it looked at before. */
  holdOn(anchor: Anchor): void {
    this.anchor = anchor;
    this.home.copy(this.goal.pivot);
  }

  get resting(): boolean {
    return this.now === this.goal;
  }

  /** Set out for another place: `change` says what is different there. */
  change(change: (goal: Stance) => void): void {
    if (this.resting) this.now = copyOf(this.goal);
    this.easing = this.anchor;
    change(this.goal);
    this.bound();
  }

  /** Take a point for the pivot, as far as the camera looks at it; the picture stays. */
  focusOn(point: Vector3): void {
    for (const stance of new Set([this.now, this.goal])) {
      const backward = new Vector3(0, 0, 1).applyQuaternion(rotationOf(stance));
      const position = positionIn(stance);
      const depth = position.clone().sub(point).dot(backward);
      if (depth <= 0) continue;
      stance.distance = clamp(depth, this.distances);
      stance.pivot.copy(position).addScaledVector(backward, -stance.distance);
    }
  }

  /** Bring a goal nearer by a factor above 1, or farther by one below; an orthographic camera zooms. */
  approach(goal: Stance, factor: number, orthographic: boolean): void {
    if (orthographic) goal.extent = clamp(goal.extent / factor, [1 / SPAN, SPAN]);
    else goal.distance = clamp(goal.distance / factor, this.distances);
  }

  /** Turn by radians, to the right and up as the picture shows them. */
  turn(right: number, up: number): void {
    const [cos, sin] = [Math.cos(this.goal.roll), Math.sin(this.goal.roll)];
    this.change((goal) => {
      const position = positionIn(goal);
      goal.heading += right * cos - up * sin;
      goal.elevation = clamp(goal.elevation + right * sin + up * cos, [-Math.PI / 2, Math.PI / 2]);
      if (this.anchor === "position") goal.pivot.add(position.sub(positionIn(goal)));
    });
  }

  /** Turn to a point without leaving the place; an orthographic camera slides there. It is the pivot from then on. */
  turnTo(point: Vector3, orthographic: boolean): void {
    this.change((goal) => {
      if (!orthographic) {
        const back = positionIn(goal).sub(point);
        goal.distance = back.length();
        goal.elevation = Math.asin(clamp(back.z / goal.distance, [-1, 1]));
        const heading = Math.atan2(back.x, -back.y);
        goal.heading += shortest(heading - goal.heading);
      }
      goal.pivot.copy(point);
    });
    if (!orthographic) this.easing = "position";
  }

  /** Go on for some seconds. Returns whether the picture has changed. */
  step(seconds: number, eased: boolean): boolean {
    if (this.resting) return false;
    const { now, goal } = this;
    const part = eased ? 1 - Math.exp(-seconds / SETTLING) : 1;
    const position = positionIn(now).lerp(positionIn(goal), part);
    for (const key of ["heading", "elevation", "roll", "distance", "extent"] as const) now[key] += (goal[key] - now[key]) * part;
    now.pivot.lerp(goal.pivot, part);
    if (this.easing === "position") now.pivot.add(position.sub(positionIn(now)));
    if (this.isClose()) this.now = goal;
    return true;
  }

  private isClose(): boolean {
    const { now, goal } = this;
    const angles = (["heading", "elevation", "roll"] as const).every((key) => Math.abs(goal[key] - now[key]) < STILL);
    const lengths = positionIn(now).distanceTo(positionIn(goal)) + now.pivot.distanceTo(goal.pivot);
    return angles && lengths < STILL * goal.distance && Math.abs(now.extent / goal.extent - 1) < STILL;
  }

  /** Keep the goal within the limits. */
  private bound(): void {
    const { goal } = this;
    goal.extent = clamp(goal.extent, [1 / SPAN, SPAN]);
    if (this.anchor === "pivot") {
      goal.elevation = clamp(goal.elevation, this.elevations);
      goal.distance = clamp(goal.distance, this.distances);
      return;
    }
    const position = positionIn(goal);
    const away = position.clone().sub(this.home);
    const distance = clamp(away.length(), [this.limits.distance?.[0] ?? 0, this.distances[1]]);
    const elevation = clamp(Math.atan2(away.z, Math.hypot(away.x, away.y)), this.elevations);
    const heading = Math.atan2(away.y, away.x);
    const flat = distance * Math.cos(elevation);
    const allowed = new Vector3(flat * Math.cos(heading), flat * Math.sin(heading), distance * Math.sin(elevation)).add(this.home);
    goal.pivot.add(allowed.sub(position));
  }
}

const clamp = (value: number, [low, high]: [number, number]): number => Math.min(Math.max(value, low), high);

/** The same angle between -π and π. */
const shortest = (angle: number): number => angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
