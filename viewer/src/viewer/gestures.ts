// What a mouse, fingers and a pen do on an element: drags, pinches, turns of the wheel and double taps.

/** CSS pixels from the element's top left corner. */
export type Point = readonly [number, number];

export type Drag = "turn" | "slide" | "roll";

export interface Hands {
  /** A drag that begins, or another finger that joins in. */
  begin(): void;
  /** direct: of a finger, which takes the picture along; a mouse or a pen points where to look. */
  drag(how: Drag, from: Point, to: Point, direct: boolean): void;
  /** Two fingers whose middle goes from one point to another, apart by a factor, turned clockwise by radians. */
  pinch(from: Point, to: Point, apart: number, turned: number): void;
  /** amount: above 0 is forward; a notch of a mouse is 0.1. */
  wheel(at: Point, amount: number): void;
  tapTwice(at: Point): void;
}

const SLOP = { mouse: 2, pen: 4, touch: 6 } as const; // pixels that a pointer moves before it drags: a tap shakes
const TWICE = 350; // milliseconds between the taps of a double tap
const TWICE_APART = 24; // pixels
const TWIST_SLOP = Math.PI / 18; // radians that two fingers turn before the picture turns with them
const NOTCH = 1000; // pixels that the wheel scrolls for an amount of 1
const PINCHED = 100; // the same of two fingers on a trackpad, which browsers send as a wheel with Ctrl
const MOST = 0.25; // of an amount at a time
const SCROLLED = [1, 16, 400]; // pixels a unit of `deltaMode`

interface Pointer {
  at: Point;
  began: Point;
  how: Drag;
  type: keyof typeof SLOP;
  dragged: boolean;
}

export class Gestures {
  private readonly pointers = new Map<number, Pointer>();
  private several = false; // whether more than one finger touched since the last was lifted: no tap
  private twist = 0; // radians that two fingers have turned
  private tapped: { at: Point; when: number } | null = null;
  private readonly end = new AbortController();

  constructor(
    private readonly element: HTMLElement,
    private readonly hands: Hands,
  ) {
    const listen = <Name extends keyof HTMLElementEventMap>(name: Name, act: (event: HTMLElementEventMap[Name]) => void) =>
      element.addEventListener(name, act, { signal: this.end.signal, passive: false });
    listen("pointerdown", (event) => this.down(event));
    listen("pointermove", (event) => this.move(event));
    listen("pointerup", (event) => this.up(event, true));
    listen("pointercancel", (event) => this.up(event, false));
    listen("lostpointercapture", (event) => this.up(event, false));
    listen("wheel", (event) => this.wheel(event));
    listen("contextmenu", (event) => event.preventDefault()); // the right button slides
  }

  dispose(): void {
    this.end.abort();
  }

  private point(event: MouseEvent): Point {
    const { left, top } = this.element.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  }

  private down(event: PointerEvent): void {
    const type = event.pointerType === "touch" || event.pointerType === "pen" ? event.pointerType : "mouse";
    const others = [...this.pointers.values()].map((pointer) => pointer.type);
    if (type === "touch" ? others.includes("pen") || others.length > 1 : others.length) return; // a hand that rests beside its pen
    if (type !== "touch") event.preventDefault(); // no text is selected
    this.element.focus({ preventScroll: true });
    this.element.setPointerCapture(event.pointerId);
    const at = this.point(event);
    this.pointers.set(event.pointerId, { at, began: at, how: dragOf(event), type, dragged: false });
    this.several = this.pointers.size > 1;
    this.twist = 0;
    this.hands.begin();
  }

  private move(event: PointerEvent): void {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    const [from, to] = [pointer.at, this.point(event)];
    const other = [...this.pointers.values()].find((one) => one !== pointer);
    if (!other && !pointer.dragged && apart(pointer.began, to) < SLOP[pointer.type]) return;
    pointer.dragged = true;
    pointer.at = to;
    if (!other) return this.hands.drag(pointer.how, from, to, pointer.type === "touch");
    const turned = shortest(angle(other.at, to) - angle(other.at, from));
    const before = this.twist;
    this.twist += turned;
    const twisted = Math.abs(before) > TWIST_SLOP;
    if (twisted) this.twist = Math.sign(before) * Number.POSITIVE_INFINITY;
    const apartNow = apart(other.at, to) / Math.max(apart(other.at, from), 1);
    this.hands.pinch(middle(other.at, from), middle(other.at, to), apartNow, twisted ? turned : 0);
  }

  private up(event: PointerEvent, tap: boolean): void {
    const pointer = this.pointers.get(event.pointerId);
    if (!pointer) return;
    this.pointers.delete(event.pointerId);
    for (const other of this.pointers.values()) other.began = other.at;
    if (!tap || pointer.dragged || this.several || pointer.how !== "turn") return;
    const { at } = pointer;
    const [last, when] = [this.tapped, event.timeStamp];
    const twice = last !== null && when - last.when < TWICE && apart(last.at, at) < TWICE_APART;
    this.tapped = twice ? null : { at, when };
    if (twice) this.hands.tapTwice(at);
  }

  private wheel(event: WheelEvent): void {
    event.preventDefault();
    const scrolled = -event.deltaY * (SCROLLED[event.deltaMode] ?? 1);
    const amount = scrolled / (event.ctrlKey ? PINCHED : NOTCH);
    this.hands.wheel(this.point(event), Math.min(Math.max(amount, -MOST), MOST));
  }
}

/** The right and the middle button slide, as does Shift; Alt rolls. */
function dragOf(event: PointerEvent): Drag {
  if (event.button === 1 || event.button === 2 || event.shiftKey || event.ctrlKey || event.metaKey) return "slide";
  return event.altKey ? "roll" : "turn";
}

const apart = (a: Point, b: Point): number => Math.hypot(b[0] - a[0], b[1] - a[1]);
const middle = (a: Point, b: Point): Point => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];

/** Clockwise, since y points down. */
export const angle = (from: Point, to: Point): number => Math.atan2(to[1] - from[1], to[0] - from[0]);
export const shortest = (radians: number): number => radians - 2 * Math.PI * Math.round(radians / (2 * Math.PI));
