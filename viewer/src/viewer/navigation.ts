// Moves a view by hand: around its pivot, or through the scene, with a mouse, fingers, a pen or keys.
import { Vector3 } from "three";
import { wantsLessMotion } from "./flight";
import { angle, type Drag, Gestures, type Hands, type Point, shortest } from "./gestures";
import { rotationOf, type Stance } from "./rig";
import type { View } from "./view";

/** orbit: around a point; fly: freely through the scene; walk: upright, and level with the ground. */
export type Mode = "orbit" | "fly" | "walk";
export const MODES: readonly Mode[] = ["orbit", "fly", "walk"];

const ORBIT_TURN = 1.6 * Math.PI; // radians for a drag across the picture's height
const KEY_TURN = Math.PI / 36; // radians a key press
const KEY_APPROACH = 1.1; // a key press
const KEY_SLIDE = 0.05; // of the picture's height, a key press
const CROSSING = 6; // seconds in which one flies through the scene
const HURRY = 4; // times as fast with Shift
const SPEEDS = [1 / 32, 32] as const; // of a flight, from its own
const NOWHERE = new Vector3();
const LONGEST = 0.25; // seconds a frame: a page that hung does not leap

const ARROWS: ReadonlyMap<string, [number, number]> = new Map([
  ["ArrowLeft", [-1, 0]],
  ["ArrowRight", [1, 0]],
  ["ArrowUp", [0, 1]],
  ["ArrowDown", [0, -1]],
]);
// By their place on the keyboard: right, up and backward.
const DRIVES: ReadonlyMap<string, [number, number, number]> = new Map([
  ["KeyW", [0, 0, -1]],
  ["KeyS", [0, 0, 1]],
  ["KeyA", [-1, 0, 0]],
  ["KeyD", [1, 0, 0]],
  ["KeyE", [0, 1, 0]],
  ["KeyQ", [0, -1, 0]],
]);

export interface NavigationEvents {
  /** Somebody takes the camera. */
  started(): void;
  mode(mode: Mode): void;
  /** Something to say in words. */
  said(text: string): void;
  /** The point of the scene that is seen at a place of the canvas; null where there is none. */
  pick(at: Point): Vector3 | null;
}

export class Navigation implements Hands {
  private current: Mode = "orbit";
  private speed = 1;
  private readonly held = new Set<string>(); // keys of DRIVES
  private hurried = false;
  private readonly stick = new Vector3(); // of `drive`
  private frame = 0; // the one that was asked for; 0 at rest
  private last = 0; // milliseconds, of the last frame
  private waiting: (() => void)[] = [];
  private readonly gestures: Gestures;
  private readonly end = new AbortController();

  constructor(
    private readonly view: View,
    private readonly canvas: HTMLCanvasElement,
    private readonly events: NavigationEvents,
  ) {
    this.gestures = new Gestures(canvas, this);
    const { signal } = this.end;
    window.addEventListener("keyup", (event) => this.release(event), { signal });
    window.addEventListener("blur", () => this.held.clear(), { signal });
  }

  get mode(): Mode {
    return this.current;
  }

  set mode(mode: Mode) {
    if (mode === this.current) return;
    this.current = mode;
    this.held.clear();
    this.stick.set(0, 0, 0);
    const { rig } = this.view;
    if (mode === "orbit") {
      const middle = this.events.pick([this.canvas.clientWidth / 2, this.canvas.clientHeight / 2]);
      if (middle) rig.focusOn(middle);
    }
    rig.holdOn(mode === "orbit" ? "pivot" : "position");
    if (mode === "walk" && rig.goal.roll !== 0) {
      this.change((goal) => {
        goal.roll = 0;
      });
    }
    this.events.mode(mode);
  }

  /** Move on through the scene until it is 0: to the right, up and forward, each from -1 to 1. */
  drive(right: number, up: number, forward: number): void {
    this.stick.set(right, up, -forward);
    if (this.stick.length() > 0) this.begin();
    this.run();
  }

  /** Turn by radians: an orbit around its pivot, otherwise the camera where it is. */
  turn(right: number, up: number): void {
    this.begin();
    const sign = this.current === "orbit" ? 1 : -1; // an orbit goes to the left to look to the right
    this.view.rig.turn(sign * right, sign * up);
    this.run();
  }

  /** Resolves when nothing moves any more. */
  rested(): Promise<void> {
    return this.frame ? new Promise((resolve) => this.waiting.push(resolve)) : Promise.resolve();
  }

  dispose(): void {
    cancelAnimationFrame(this.frame);
    this.end.abort();
    this.gestures.dispose();
  }

  // Hands

  begin(): void {
    this.events.started();
  }

  drag(how: Drag, from: Point, to: Point, direct: boolean): void {
    const [x, y] = [to[0] - from[0], to[1] - from[1]];
    const orbits = this.current === "orbit";
    if (how === "slide") return this.hold(from, to);
    if (how === "roll") {
      const middle: Point = [this.canvas.clientWidth / 2, this.canvas.clientHeight / 2];
      return this.roll(shortest(angle(middle, to) - angle(middle, from)));
    }
    const pixel = orbits ? ORBIT_TURN / this.canvas.clientHeight : this.view.anglePerPixel * (direct ? -1 : 1);
    this.view.rig.turn(-x * pixel, y * pixel);
    this.run();
  }

  pinch(from: Point, to: Point, apart: number, turned: number): void {
    const { rig, orthographic } = this.view;
    this.hold(from, to, (goal) => {
      if (this.current !== "walk") goal.roll += turned;
      if (this.current === "orbit") rig.approach(goal, apart, orthographic);
    });
    if (this.current !== "orbit") this.advance(new Vector3(0, 0, -Math.log(apart) * CROSSING * 0.5));
  }

  wheel(at: Point, amount: number): void {
    if (this.current !== "orbit") return this.hasten(2 * amount);
    this.begin();
    this.approach(Math.exp(amount), at);
  }

  tapTwice(at: Point): void {
    this.centre(at);
  }

  /** Take a key; returns whether it means something. */
  press(event: KeyboardEvent): boolean {
    this.hurried = event.shiftKey;
    if (event.ctrlKey || event.metaKey || event.altKey) return false;
    if (this.current !== "orbit" && DRIVES.has(event.code)) {
      this.held.add(event.code);
      this.begin();
      this.run();
      return true;
    }
    const arrow = ARROWS.get(event.key);
    const key = event.key?.toLowerCase();
    const nearer = key === "+" || key === "=";
    if (arrow && event.shiftKey) this.slide(arrow);
    else if (arrow) this.turn(arrow[0] * KEY_TURN, arrow[1] * KEY_TURN);
    else if (nearer || key === "-") this.zoom(nearer);
    else if (key === "<" || key === ">") this.tilt(key === "<");
    else if (key === "c") this.centre([this.canvas.clientWidth / 2, this.canvas.clientHeight / 2]);
    else if (key === "v") this.mode = MODES[(MODES.indexOf(this.current) + 1) % MODES.length];
    else return false;
    return true;
  }

  private release(event: KeyboardEvent): void {
    this.hurried = event.shiftKey;
    this.held.delete(event.code);
  }

  private slide([x, y]: [number, number]): void {
    this.begin();
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.hold([width / 2, height / 2], [width / 2 - x * KEY_SLIDE * height, height / 2 + y * KEY_SLIDE * height]);
  }

  private zoom(nearer: boolean): void {
    if (this.current !== "orbit") return this.hasten(nearer ? 0.2 : -0.2);
    this.begin();
    this.approach(nearer ? KEY_APPROACH : 1 / KEY_APPROACH, this.view.middle);
  }

  private tilt(left: boolean): void {
    this.begin();
    this.roll(left ? -KEY_TURN : KEY_TURN);
  }

  /** Turn the picture clockwise by radians. Who walks stays upright. */
  private roll(radians: number): void {
    if (this.current === "walk") return;
    this.change((goal) => {
      goal.roll += radians;
    });
  }

  /** Come nearer to what lies under a point. */
  private approach(factor: number, at: Point): void {
    this.hold(at, at, (goal) => this.view.rig.approach(goal, factor, this.view.orthographic));
  }

  /** Fly faster or slower, by the logarithm of a factor. */
  private hasten(log: number): void {
    this.speed = Math.min(Math.max(this.speed * Math.exp(log), SPEEDS[0]), SPEEDS[1]);
    this.events.said(`Speed: ${this.speed.toPrecision(2)}`);
  }

  /** Turn to the point of the scene that is seen there, and around it from then on. */
  private centre(at: Point): void {
    const point = this.events.pick(at);
    if (!point) return this.events.said("There is nothing at this place.");
    this.begin();
    this.view.rig.turnTo(point, this.view.orthographic);
    this.run();
    this.events.said(this.current === "orbit" ? "The view turns around this point." : "The camera looks at this point.");
  }

  /** Change the goal so that what was under one point of the page comes under another. */
  private hold(from: Point, to: Point, change: (goal: Stance) => void = () => {}): void {
    const { view } = this;
    this.change((goal) => {
      const before = view.beside(goal, from);
      change(goal);
      goal.pivot.add(before).sub(view.beside(goal, to));
    });
  }

  private change(change: (goal: Stance) => void): void {
    this.view.rig.change(change);
    this.run();
  }

  /** Move through the scene by seconds of a flight: to the right, up and backward. */
  private advance(seconds: Vector3): void {
    const { rig, orthographic } = this.view;
    this.change((goal) => {
      const way = seconds.clone().multiplyScalar((rig.size / CROSSING) * this.speed * (this.hurried ? HURRY : 1));
      if (orthographic) rig.approach(goal, Math.exp(-way.z / rig.size), true);
      const level = { ...goal, elevation: 0, roll: 0 };
      goal.pivot.add(way.applyQuaternion(rotationOf(this.current === "walk" ? level : goal)));
    });
  }

  private get driven(): Vector3 {
    const sum = this.stick.clone();
    for (const code of this.held) sum.add(new Vector3(...(DRIVES.get(code) as [number, number, number])));
    return sum.clampLength(0, 1);
  }

  /** Go on with every frame until nothing moves. */
  private run(): void {
    if (this.frame) return;
    this.last = performance.now();
    this.frame = requestAnimationFrame(() => this.tick());
  }

  private tick(): void {
    const now = performance.now();
    const seconds = Math.min((now - this.last) / 1000, LONGEST);
    this.last = now;
    const { rig } = this.view;
    const driven = this.current === "orbit" ? NOWHERE : this.driven;
    if (driven.length() > 0) this.advance(driven.clone().multiplyScalar(seconds));
    if (rig.step(seconds, !wantsLessMotion())) this.view.moved();
    const goesOn = driven.length() > 0 || !rig.resting;
    this.frame = goesOn ? requestAnimationFrame(() => this.tick()) : 0;
    if (!goesOn) for (const resolve of this.waiting.splice(0)) resolve();
  }
}
