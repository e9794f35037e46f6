// Camera paths: what path.json says, the camera at any frame, and the clock that plays them. A page without a path loads none of this, and so
// it uses nothing of three.js, and throws no errors, whose class would be another one than the viewer's. core/geometry/camera_state.py interpolates by the same rules.
import { isArray, isPositiveInteger } from "../../data/scene";

const VERSIONS = [1, 2]; // of the format; only the second has curves
const CURVE = 11; // numbers in each half of a curve
const LONGEST_LENS = 50; // logarithm of a focal length, at most: a curve of a damaged file does not overflow
const NO_ROTATION = 1e-6; // length of a quaternion below which it says nothing
const NEARLY_SAME = 1e-9; // radians between two quaternions below which spherical and linear interpolation are equal
const LONGEST_STEP = 1; // seconds of the clock a picture at most: while a tab is hidden, the path stands still
const MAX_SPEED = 16;

/** A camera on a path. Pixels are counted from the top left corner; lengths are in units of the scene. */
export interface PathCamera {
  name: string;
  projection: "perspective" | "orthographic";
  width: number; // pixels
  height: number;
  position: number[]; // [3]
  rotation: number[]; // [4], a unit quaternion x, y, z, w
  focal: [number, number];
  centre: [number, number];
  near: number;
  far?: number;
}

interface Key extends Omit<PathCamera, "name" | "projection" | "width" | "height"> {
  frame: number;
  distance: number; // how far before the camera the point lies that it turns around
  curve?: Curve; // to the next key; without one, interpolation is linear
}

/** The velocities, a frame, with which a curve leaves its first key and reaches its last, in the order of docs/file-format.md. */
type Curve = [number[], number[]];

interface Shot {
  name: string;
  projection: "perspective" | "orthographic";
  keys: Key[];
}

interface PathFile {
  format: string;
  version: number;
  fps: number;
  start: number;
  end: number;
  width: number;
  height: number;
  shots: Shot[];
}

/** The path that a file's value describes; null where it is none. */
export const pathOf = (value: unknown): CameraPath | null => (isPath(value as PathFile | null) ? new CameraPath(value as PathFile) : null);

export class CameraPath {
  readonly fps: number;
  readonly start: number; // the first frame
  readonly end: number; // the last frame, which is shown as long as every other one
  private readonly shots: Shot[];

  constructor(private readonly file: PathFile) {
    this.fps = file.fps;
    this.start = file.start;
    this.end = file.end;
    this.shots = file.shots.map((shot) => ({ ...shot, keys: filled(shot.keys, file) }));
  }

  /** The camera at a frame, which need not be whole. It moves with the point that it turns around, and the distance from it; rotations turn by the shorter way; lenses are interpolated in logarithms. */
  at(frame: number): PathCamera {
    const shot =
      this.shots[
        Math.max(
          lastBefore(this.shots, frame, (each) => each.keys[0].frame),
          0,
        )
      ];
    const index = Math.max(
      lastBefore(shot.keys, frame, (key) => key.frame),
      0,
    );
    const [a, b] = [shot.keys[index], shot.keys[index + 1] ?? shot.keys[index]];
    const part = b.frame > a.frame ? Math.max(0, (frame - a.frame) / (b.frame - a.frame)) : 0;
    const { width, height } = this.file;
    return { name: shot.name, projection: shot.projection, width, height, ...between(a, b, part) };
  }
}

/** The camera between two keys: near and far linearly, all else along the curve, where there is one. */
function between(a: Key, b: Key, part: number): Omit<Key, "frame" | "distance" | "curve"> {
  const mix = (x: number, y: number) => x + (y - x) * part;
  const weights = hermite(part, b.frame - a.frame);
  /** index: of the velocity in the curve's halves. */
  const blend = (x: number, y: number, index: number) => (a.curve ? cubic(x, y, a.curve[0][index], a.curve[1][index], weights) : mix(x, y));
  const far = mix(a.far === undefined ? 0 : 1 / a.far, b.far === undefined ? 0 : 1 / b.far);
  const rotation = a.curve ? turnAlong(a.curve, a.rotation, b.rotation, weights) : slerp(a.rotation, b.rotation, part);
  const [one, other, back] = [a, b, { rotation }].map((key) => backward(key.rotation));
  const target = a.position.map((x, i) => blend(x - a.distance * one[i], b.position[i] - b.distance * other[i], i));
  const distance = blend(a.distance, b.distance, 10);
  const lens = a.focal.map((x, i) => blend(Math.log(x), Math.log(b.focal[i]), 6 + i));
  return {
    position: target.map((x, i) => x + distance * back[i]),
    rotation,
    focal: lens.map((x) => Math.exp(Math.min(Math.max(x, -LONGEST_LENS), LONGEST_LENS))) as [number, number],
    centre: a.centre.map((x, i) => blend(x, b.centre[i], 8 + i)) as [number, number],
    near: mix(a.near, b.near),
    ...(far > 0 ? { far: 1 / far } : {}),
  };
}

/** The weights of cubic Hermite interpolation over so many frames: of the last value (the first has the rest to 1), and of both velocities. */
const hermite = (u: number, frames: number): [number, number, number] => [
  u * u * (3 - 2 * u),
  frames * u * (1 - u) ** 2,
  -frames * u * u * (1 - u),
];

const cubic = (a: number, b: number, leaving: number, reaching: number, [last, one, other]: [number, number, number]): number =>
  a + last * (b - a) + one * leaving + other * reaching;

/** A rotation along a curve, as in glTF: quaternions are interpolated, and their length then becomes 1. */
function turnAlong([leaving, reaching]: Curve, a: number[], towards: number[], weights: [number, number, number]): number[] {
  const b = facing(a, towards);
  const [one, other] = [spin(leaving.slice(3, 6), a), spin(reaching.slice(3, 6), b)];
  const turn = a.map((x, i) => cubic(x, b[i], one[i], other[i], weights));
  const length = Math.hypot(...turn);
  return length > NO_ROTATION ? turn.map((x) => x / length) : a;
}

/** The velocity of a quaternion that turns with an angular velocity about the world's axes. */
const spin = ([vx, vy, vz]: number[], [x, y, z, w]: number[]): number[] =>
  [w * vx + vy * z - vz * y, w * vy + vz * x - vx * z, w * vz + vx * y - vy * x, -vx * x - vy * y - vz * z].map((value) => value / 2);

/** The same rotation as `b`, as the quaternion that is nearer to `a`. */
function facing(a: number[], b: number[]): number[] {
  const dot = a.reduce((sum, x, i) => sum + x * b[i], 0);
  return dot < 0 ? b.map((x) => -x) : b;
}

/** The third axis of a rotation: a camera looks against it. */
const backward = ([x, y, z, w]: number[]): number[] => [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)];

/** Spherical interpolation between unit quaternions, the shorter way. */
function slerp(a: number[], other: number[], part: number): number[] {
  const b = facing(a, other);
  const angle = 2 * Math.atan2(Math.hypot(...a.map((x, i) => x - b[i])), Math.hypot(...a.map((x, i) => x + b[i])));
  if (angle < NEARLY_SAME) return a.map((x, i) => x + (b[i] - x) * part);
  const [first, second] = [Math.sin((1 - part) * angle) / Math.sin(angle), Math.sin(part * angle) / Math.sin(angle)];
  return a.map((x, i) => first * x + second * b[i]);
}

/** The index of the last item whose frame is not after `frame`; -1 where there is none. */
function lastBefore<T>(items: T[], frame: number, frameOf: (item: T) => number): number {
  let [low, high] = [0, items.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (frameOf(items[middle]) <= frame) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** The keys with what each takes over from the one before it. */
function filled(keys: Partial<Key>[], { width, height }: PathFile): Key[] {
  let last: Partial<Key> = { near: 0, distance: 0, centre: [width / 2, height / 2] };
  return keys.map((key) => {
    last = { ...last, curve: undefined, ...key };
    const length = Math.hypot(...(last.rotation as number[]));
    const { far, curve } = { far: last.far ?? undefined, curve: last.curve ?? undefined }; // null in the file: none
    return { ...last, far, curve, rotation: (last.rotation as number[]).map((x) => x / length) } as Key;
  });
}

function isPath(value: PathFile | null): value is PathFile {
  return (
    value?.format === "snerg-path" &&
    VERSIONS.includes(value.version) &&
    value.fps > 0 &&
    Number.isFinite(value.fps) &&
    [value.start, value.end].every(Number.isSafeInteger) &&
    value.end >= value.start &&
    isPositiveInteger(value.width) &&
    isPositiveInteger(value.height) &&
    Array.isArray(value.shots) &&
    value.shots.length > 0 &&
    value.shots.every(isShot) &&
    inOrder(value.shots.map((shot) => shot.keys[0].frame))
  );
}

function isShot(shot: Shot | null): boolean {
  if (typeof shot?.name !== "string" || !["perspective", "orthographic"].includes(shot.projection)) return false;
  const { keys } = shot;
  if (!Array.isArray(keys) || keys.length === 0 || keys.some((key) => key === null || typeof key !== "object")) return false;
  const [first] = keys;
  const whole = isArray(first.position, [3]) && isArray(first.rotation, [4]) && isArray(first.focal, [2]);
  const leads = keys[keys.length - 1].curve ?? null; // to no key
  return whole && leads === null && keys.every(isKey) && inOrder(keys.map((key) => key.frame));
}

function isKey({ frame, position, rotation, distance, focal, centre, near, far, curve }: Key): boolean {
  const given = (value: unknown, length: number) => value === undefined || isArray(value, [length]);
  return (
    Number.isFinite(frame) &&
    given(position, 3) &&
    given(rotation, 4) &&
    (rotation === undefined || Math.hypot(...rotation) > 1e-6) &&
    (distance === undefined || distance >= 0) &&
    given(focal, 2) &&
    (focal === undefined || focal.every((f) => f > 0)) &&
    given(centre, 2) &&
    (curve === undefined || curve === null || isArray(curve, [2, CURVE])) &&
    (near === undefined || near >= 0) &&
    (far === undefined || far === null || far > 0)
  );
}

const inOrder = (frames: number[]): boolean => frames.every((frame, i) => i === 0 || frame > frames[i - 1]);

/** What a player tells of itself. */
export interface PathState {
  frame: number; // that is shown, or where playing would go on
  start: number;
  end: number;
  fps: number;
  playing: boolean;
  shown: boolean; // whether the view is the path's, and not one that somebody chose since
  loop: boolean;
  speed: number; // 1: as in Blender
}

/** Plays a path: a clock whose frames it shows. */
export class PathPlayer {
  frame: number;
  playing = false;
  shown = false;
  private repeats = true;
  private rate = 1;
  private last = 0; // time of the last picture, milliseconds
  private request = 0;

  /** show: shows a camera. changed: called when the state changes. */
  constructor(
    readonly path: CameraPath,
    private readonly show: (camera: PathCamera) => void,
    private readonly changed: () => void,
  ) {
    this.frame = path.start;
  }

  get state(): PathState {
    const { frame, playing, shown, loop, speed } = this;
    const { start, end, fps } = this.path;
    return { frame, start, end, fps, playing, shown, loop, speed };
  }

  get loop(): boolean {
    return this.repeats;
  }

  set loop(loop: boolean) {
    this.repeats = loop;
    this.changed();
  }

  get speed(): number {
    return this.rate;
  }

  /** Times as fast as in Blender, from 1 / 16 to 16. */
  set speed(speed: number) {
    this.rate = Math.min(Math.max(speed || 1, 1 / MAX_SPEED), MAX_SPEED);
    this.changed();
  }

  /** Play on from the frame; from the first one where the path was at its end. */
  play(): void {
    if (this.playing) return;
    if (!this.loop && this.frame >= this.path.end) this.frame = this.path.start;
    this.playing = true;
    this.last = performance.now();
    this.seek(this.frame);
    this.request = requestAnimationFrame(() => this.tick());
  }

  pause(): void {
    if (!this.playing) return;
    this.playing = false;
    cancelAnimationFrame(this.request);
    this.changed();
  }

  /** Show a frame, which need not be whole; the nearest of the path. */
  seek(frame: number): void {
    const { start, end } = this.path;
    // Between the last frame and the first one that follows it in a loop, the last frame's time goes on.
    this.frame = Math.min(Math.max(Number.isFinite(frame) ? frame : start, start), this.loop && this.playing ? end + 1 : end);
    this.shown = true;
    this.show(this.path.at(this.frame));
    this.changed();
  }

  /** Somebody moves the view, or chooses another one. */
  leave(): void {
    const was = this.shown;
    this.shown = false;
    this.pause();
    if (was) this.changed();
  }

  private tick(): void {
    if (!this.playing) return;
    const now = performance.now();
    const step = Math.min((now - this.last) / 1000, LONGEST_STEP) * this.path.fps * this.speed;
    const { start, end } = this.path;
    const length = end + 1 - start;
    this.last = now;
    let frame = this.frame + step;
    if (this.loop) frame = start + ((((frame - start) % length) + length) % length);
    else if (frame >= end) this.playing = false;
    this.seek(frame);
    if (this.playing) this.request = requestAnimationFrame(() => this.tick());
  }
}
