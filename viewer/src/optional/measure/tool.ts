// The mode in which two points are picked: a bar over the picture, a cross for keys, and a line with its length for each pair.
import type { ScenePoint } from "../../viewer/interface";
import {
  addStyle,
  barButton,
  draw,
  followView,
  makeButton,
  makeDrawing,
  makeElement,
  type PartHost,
  shape,
  undoAtEnd,
} from "../parts/host";
import { lengthText } from "./length";
import style from "./style.css";

const CLICK = 5; // pixels that a pointer may move between down and up: more is a drag, which turns the view
const GAP = 10; // pixels from a line to its label
const STEP = 10; // pixels that an arrow key moves the cross; 1 with Shift
const ARROWS: ReadonlyMap<string, readonly [number, number]> = new Map([
  ["ArrowLeft", [-1, 0]],
  ["ArrowRight", [1, 0]],
  ["ArrowUp", [0, -1]],
  ["ArrowDown", [0, 1]],
]);
const FIRST = "Choose the first point: click it, or move the cross with the arrow keys and press Enter.";
const NEXT = "Choose the first point of another length, or end with Done.";
const SECOND = "Choose the second point.";
const NOTHING = "There is nothing here: more than half of the light comes through. Choose another point.";

interface Measure {
  points: [ScenePoint, ScenePoint];
  line: SVGLineElement;
  dots: SVGCircleElement[];
  label: HTMLElement;
}

export async function attach(host: PartHost): Promise<void> {
  if (host.signal.aborted) return;
  addStyle(host, style);
  new Tool(host);
}

class Tool {
  private readonly layer = makeElement("div", "measure");
  private readonly drawing = makeDrawing();
  private readonly list = makeElement("ul", "lengths");
  private readonly panel = makeElement("div", "tool");
  private readonly status = makeElement("p", "status");
  private readonly cross = shape("path", "cross");
  private readonly first = shape("circle", "end");
  private readonly button: HTMLButtonElement;
  private measures: Measure[] = [];
  private start: ScenePoint | null = null; // the first point of a pair
  private at: [number, number] = [0, 0]; // of the cross
  private down: [number, number] | null = null; // where a pointer went down
  private readonly update: () => void;

  constructor(private readonly host: PartHost) {
    const { viewer, stage, root } = host;
    this.list.setAttribute("aria-label", "Measured lengths");
    this.status.setAttribute("role", "status");
    this.panel.setAttribute("role", "group");
    this.panel.setAttribute("aria-label", "Measure");
    this.panel.append(
      this.status,
      makeButton("Clear", () => this.clear()),
      makeButton("Done", () => this.show(false)),
    );
    this.first.setAttribute("r", "4");
    this.drawing.append(this.first, this.cross);
    this.layer.append(this.drawing, this.list);
    stage.append(this.layer, this.panel);
    this.button = barButton(host, "Measure", "Measure between two points", () => this.show(!this.active));
    this.update = followView(host, () => this.arrange());
    this.show(false);
    const press = (event: Event) => this.press(event as KeyboardEvent);
    root.addEventListener("keydown", press, { capture: true }); // before the view takes the arrow keys
    const down = (event: PointerEvent) => {
      this.down = event.isPrimary && event.button === 0 ? [event.clientX, event.clientY] : null;
    };
    viewer.canvas.addEventListener("pointerdown", down);
    viewer.canvas.addEventListener("pointerup", this.up);
    undoAtEnd(
      host,
      () => root.removeEventListener("keydown", press, { capture: true }),
      () => viewer.canvas.removeEventListener("pointerdown", down),
      () => viewer.canvas.removeEventListener("pointerup", this.up),
      () => this.layer.remove(),
      () => this.panel.remove(),
      () => this.button.remove(),
    );
  }

  private get active(): boolean {
    return !this.panel.hidden;
  }

  /** Begin or end to measure. What was measured stays. */
  private show(active: boolean): void {
    this.panel.hidden = !active;
    this.button.setAttribute("aria-pressed", String(active));
    this.start = null;
    this.say(FIRST);
    const { canvas } = this.host.viewer;
    canvas.classList.toggle("measuring", active);
    this.at = [canvas.clientWidth / 2, canvas.clientHeight / 2];
    if (active) canvas.focus({ preventScroll: true });
    this.update();
  }

  private say(text: string): void {
    this.status.textContent = text;
  }

  private clear(): void {
    for (const measure of this.measures) remove(measure);
    this.measures = [];
    this.start = null;
    this.say(FIRST);
    this.update();
  }

  private readonly up = (event: PointerEvent): void => {
    const [x, y] = this.down ?? [Number.NaN, Number.NaN];
    this.down = null;
    if (!this.active || !(Math.hypot(event.clientX - x, event.clientY - y) <= CLICK)) return;
    const { left, top } = this.host.viewer.canvas.getBoundingClientRect();
    this.at = [event.clientX - left, event.clientY - top];
    this.choose();
  };

  private press(event: KeyboardEvent): void {
    if (!this.active || event.ctrlKey || event.metaKey || event.altKey) return;
    const onCanvas = event.composedPath()[0] === this.host.viewer.canvas;
    const arrow = ARROWS.get(event.key);
    if (event.key === "Escape") this.escape();
    else if (!onCanvas) return;
    else if (arrow) this.move(arrow, event.shiftKey ? 1 : STEP);
    else if (event.key === "Enter" || event.key === " ") this.choose();
    else if (event.key === "Delete" || event.key === "Backspace") this.clear();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  /** Give up the first point, or else end. */
  private escape(): void {
    if (!this.start) {
      this.show(false);
      this.button.focus();
      return;
    }
    this.start = null;
    this.say(FIRST);
    this.update();
  }

  private move([right, down]: readonly [number, number], by: number): void {
    const { clientWidth, clientHeight } = this.host.viewer.canvas;
    const within = (value: number, size: number) => Math.max(0, Math.min(value, size - 1));
    this.at = [within(this.at[0] + right * by, clientWidth), within(this.at[1] + down * by, clientHeight)];
    this.update();
  }

  /** Take the point under the cross. */
  private choose(): void {
    const [point] = this.host.viewer.pick([this.at]);
    if (!point) this.say(NOTHING);
    else if (!this.start) {
      this.start = point;
      this.say(SECOND);
    } else {
      const measure = this.makeMeasure(this.start, point);
      this.measures.push(measure);
      this.start = null;
      this.say(`${measure.label.firstElementChild?.textContent}. ${NEXT}`);
    }
    this.update();
  }

  private makeMeasure(from: ScenePoint, to: ScenePoint): Measure {
    const length = Math.hypot(...from.position.map((value, i) => value - to.position[i]));
    const error = Math.hypot(from.voxel, to.voxel); // each end is exact to a voxel
    const text = makeElement("span", "length");
    text.textContent = lengthText(length, error, this.host.viewer.bundle?.units ?? { metres: 1, system: "none" });
    const label = document.createElement("li");
    const close = makeButton("×", () => {
      remove(measure);
      this.measures = this.measures.filter((other) => other !== measure);
      this.host.viewer.canvas.focus({ preventScroll: true });
    });
    close.setAttribute("aria-label", `Remove ${text.textContent}`);
    label.append(text, close);
    this.list.append(label);
    const dots = [shape("circle", "end"), shape("circle", "end")];
    for (const dot of dots) dot.setAttribute("r", "4");
    const line = shape("line", "between");
    this.drawing.prepend(line, ...dots);
    const measure = { points: [from, to] as [ScenePoint, ScenePoint], line, dots, label };
    return measure;
  }

  private arrange(): void {
    const { viewer } = this.host;
    const [x, y] = this.at;
    this.cross.setAttribute("d", `M${x - 9} ${y}h18M${x} ${y - 9}v18`);
    this.cross.style.display = this.active ? "" : "none";
    const begun = this.start ? viewer.project(this.start.position) : null;
    this.first.style.display = begun && begun.depth > 0 ? "" : "none";
    if (begun) draw(this.first, { cx: begun.x, cy: begun.y });
    const shown: Middle[] = [];
    for (const { points, line, dots, label } of this.measures) {
      const ends = points.map((point) => viewer.project(point.position));
      const seen = ends.every(({ depth }) => depth > 0); // a line past the camera has no other end in the picture
      for (const part of [line, ...dots, label]) part.style.display = seen ? "" : "none";
      const [a, b] = ends;
      draw(line, { x1: a.x, y1: a.y, x2: b.x, y2: b.y });
      ends.forEach((end, i) => {
        draw(dots[i], { cx: end.x, cy: end.y });
      });
      if (seen) shown.push({ label, x: (a.x + b.x) / 2, y: (a.y + b.y) / 2 });
    }
    placeLengths(shown);
  }
}

/** The middle of a line, above which its label lies. */
interface Middle {
  label: HTMLElement;
  x: number;
  y: number;
}

/** Put each label above the middle of its line; one that would lie over another goes above that. */
function placeLengths(middles: Middle[]): void {
  const taken: (readonly [left: number, top: number, right: number, bottom: number])[] = [];
  for (const { label, x, y } of middles) {
    const { offsetWidth: width, offsetHeight: height } = label;
    const left = x - width / 2;
    let top = y - height - GAP;
    for (const [l, t, r] of [...taken].sort((a, b) => b[1] - a[1])) {
      if (left < r && left + width > l && top < t + height + 2 && top + height > t - 2) top = t - height - 3;
    }
    taken.push([left, top, left + width, top + height]);
    label.style.transform = `translate(${left.toFixed(1)}px, ${top.toFixed(1)}px)`;
  }
}

function remove({ line, dots, label }: Measure): void {
  for (const part of [line, ...dots, label]) part.remove();
}
