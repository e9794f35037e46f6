// The labels in the page: HTML over the canvas, so that people can select, hear and reach them with the keyboard.
import type { ProjectedPoint } from "../../viewer/interface";
import { addStyle, barButton, draw, followView, makeDrawing, makeElement, onStill, type PartHost, shape, undoAtEnd } from "../parts/host";
import { placeLabels } from "./layout";
import { type Annotation, readAnnotations } from "./read";
import style from "./style.css";

const VOXELS = 3; // before the point that may lie there without hiding it: a surface is as thick as that

interface Note {
  annotation: Annotation;
  label: HTMLElement;
  dot: SVGCircleElement;
  line: SVGLineElement;
  point: ProjectedPoint;
  place: number;
}

/** Show the bundle's annotations. Rejects with a ViewerError where their file is missing or damaged. */
export async function attach(host: PartHost): Promise<void> {
  const annotations = await readAnnotations(host.viewer.bundle as NonNullable<typeof host.viewer.bundle>);
  if (!annotations.length || host.signal.aborted) return;
  addStyle(host, style);
  const layer = makeElement("div", "notes");
  const [drawing, list] = [makeDrawing(), makeElement("ul", "labels")];
  list.setAttribute("aria-label", "Annotations");
  layer.append(drawing, list);
  const notes = annotations.map((annotation) => makeNote(host, annotation, drawing, list));
  host.stage.append(layer);
  const update = followView(host, () => arrange(host, notes));
  onStill(host, () => {
    findHidden(host, notes);
    update();
  });
  const button = barButton(host, "Notes", "Show or hide the annotations", () => {
    layer.hidden = !layer.hidden;
    button.setAttribute("aria-pressed", String(!layer.hidden));
    update();
  });
  button.setAttribute("aria-pressed", "true");
  undoAtEnd(
    host,
    () => layer.remove(),
    () => button.remove(),
  );
}

function makeNote(host: PartHost, annotation: Annotation, drawing: SVGSVGElement, list: HTMLUListElement): Note {
  const { camera } = annotation;
  const label = makeElement(camera ? "button" : "p", "label");
  const text = makeElement("span", "text");
  text.textContent = annotation.text; // never HTML
  label.append(text);
  label.tabIndex = 0;
  if (camera) {
    label.title = `Show the camera ${camera}`;
    label.addEventListener("click", () => host.choose(camera));
  }
  const item = document.createElement("li");
  item.append(label);
  list.append(item);
  const [line, dot] = [shape("line", "leader"), shape("circle", "anchor")];
  dot.setAttribute("r", "3.5");
  drawing.append(line, dot);
  return { annotation, label, dot, line, point: { x: 0, y: 0, depth: 0 }, place: -1 };
}

/** Bring points, lines and labels to where they are in the view. */
function arrange({ viewer }: PartHost, notes: readonly Note[]): void {
  const { clientWidth: width, clientHeight: height } = viewer.canvas;
  for (const note of notes) note.point = viewer.project(note.annotation.position);
  const seen = notes.filter(({ point: { x, y, depth } }) => depth > 0 && x >= 0 && y >= 0 && x <= width && y <= height);
  const labels = seen.map(({ point: { x, y }, label, place }) => ({ x, y, width: label.offsetWidth, height: label.offsetHeight, place }));
  const places = placeLabels(labels, width, height);
  for (const note of notes) {
    const index = seen.indexOf(note);
    const placed = index < 0 ? null : places[index];
    // What is outside of the picture or finds no room is not shown, but keys and screen readers reach it.
    note.label.classList.toggle("away", !placed || placed.crowded);
    for (const part of [note.line, note.dot]) part.classList.toggle("away", !placed || (part === note.line && placed.crowded));
    note.place = placed?.place ?? -1;
    if (!placed) {
      const { x, y, depth } = note.point; // where a label that is focused shows, though its point is out of the picture
      const [left, top] = depth > 0 ? [clamped(x, 8, width - 160), clamped(y, 8, height - 48)] : [8, height - 48];
      note.label.style.transform = `translate(${left.toFixed(1)}px, ${top.toFixed(1)}px)`;
      continue;
    }
    note.label.style.transform = `translate(${placed.left.toFixed(1)}px, ${placed.top.toFixed(1)}px)`;
    const { x, y } = note.point;
    draw(note.dot, { cx: x, cy: y });
    const [right, bottom] = [placed.left + labels[index].width, placed.top + labels[index].height];
    draw(note.line, { x1: x, y1: y, x2: clamped(x, placed.left, right), y2: clamped(y, placed.top, bottom) });
  }
}

const clamped = (value: number, low: number, high: number): number => Math.max(low, Math.min(value, high));

/** Fade the labels of points behind what is seen. */
function findHidden({ viewer }: PartHost, notes: readonly Note[]): void {
  for (const note of notes) note.point = viewer.project(note.annotation.position);
  const picked = viewer.pick(notes.map(({ point }) => [point.x, point.y]));
  notes.forEach(({ point, label, line, dot }, i) => {
    const seen = picked[i];
    const behind = seen !== null && point.depth > seen.depth + VOXELS * seen.voxel;
    for (const part of [label, line, dot]) part.classList.toggle("behind", behind);
  });
}
