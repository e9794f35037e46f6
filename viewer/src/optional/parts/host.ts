// What optional parts of the page share: where they are put, their style, their buttons, and lines over the picture.
import type { Viewer } from "../../viewer/interface";

/** The element that a part is added to. */
export interface PartHost {
  viewer: Viewer;
  root: ShadowRoot; // of the element: its style, its bar
  stage: HTMLElement; // which holds the canvas
  signal: AbortSignal; // aborted when the element leaves its page
  choose(camera: string): void; // flies to a camera
}

/** Anything that is undone when the element leaves its page. */
export type Undo = () => void;

export function undoAtEnd({ signal }: PartHost, ...undos: Undo[]): void {
  const undo = () => {
    for (const each of undos) each();
  };
  if (signal.aborted) undo();
  else signal.addEventListener("abort", undo, { once: true });
}

export function addStyle({ root }: PartHost, text: string): void {
  const sheet = new CSSStyleSheet();
  sheet.replaceSync(text);
  root.adoptedStyleSheets = [...root.adoptedStyleSheets, sheet];
}

/** A button of the bar, before the one that shares the view. */
export function barButton({ root }: PartHost, text: string, title: string, act: () => void): HTMLButtonElement {
  const button = makeButton(text, act);
  button.title = title;
  const next = root.getElementById("share");
  if (next) next.before(button);
  else root.getElementById("bar")?.append(button);
  return button;
}

export function makeButton(text: string, act: () => void): HTMLButtonElement {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = text;
  button.addEventListener("click", act);
  return button;
}

export function makeElement<Name extends keyof HTMLElementTagNameMap>(name: Name, className: string): HTMLElementTagNameMap[Name] {
  const element = document.createElement(name);
  element.className = className;
  return element;
}

/** A drawing over the picture, which nobody can touch and no screen reader hears. */
export function makeDrawing(): SVGSVGElement {
  const svg = shape("svg", "lines");
  svg.setAttribute("aria-hidden", "true");
  return svg;
}

export function shape<Name extends keyof SVGElementTagNameMap>(name: Name, className: string): SVGElementTagNameMap[Name] {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  element.setAttribute("class", className);
  return element;
}

/** Set attributes of a shape to numbers. */
export function draw(element: SVGElement, values: Record<string, number>): void {
  for (const [name, value] of Object.entries(values)) element.setAttribute(name, value.toFixed(1));
}

/** Call `update` at most once a frame: after the view or the canvas's size has changed, and after the returned function is called. */
export function followView(host: PartHost, update: () => void): () => void {
  let waiting = 0;
  const later = () => {
    cancelAnimationFrame(waiting);
    waiting = requestAnimationFrame(update);
  };
  const observer = new ResizeObserver(later);
  observer.observe(host.viewer.canvas);
  undoAtEnd(
    host,
    host.viewer.on("view", later),
    () => observer.disconnect(),
    () => cancelAnimationFrame(waiting),
  );
  later();
  return later;
}

/** Call `look` when the page shows the full image of a view that stands still. */
export function onStill(host: PartHost, look: () => void): void {
  undoAtEnd(
    host,
    host.viewer.on("image", ({ full }) => {
      if (full) look();
    }),
  );
}
