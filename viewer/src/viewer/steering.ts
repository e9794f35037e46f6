// How one moves: the choice between orbit, flight and walk, and the stick for those who have no keys.
import type { Viewer } from "./interface";
import { MODES, type Mode } from "./navigation";

const DEAD = 0.12; // of the stick's radius, around its middle

/** Give the stick and the list of modes their work. */
export function steer(stick: HTMLElement, list: HTMLSelectElement, viewer: Viewer): void {
  const show = (mode: Mode) => {
    list.value = mode;
    stick.hidden = mode === "orbit";
  };
  show(viewer.mode);
  viewer.on("mode", show);
  list.onchange = () => {
    viewer.mode = MODES.find((mode) => mode === list.value) ?? "orbit";
  };
  const knob = stick.firstElementChild as HTMLElement;
  const push = (event: PointerEvent) => {
    const { left, top, width, height } = stick.getBoundingClientRect();
    let [x, y] = [(2 * (event.clientX - left)) / width - 1, (2 * (event.clientY - top)) / height - 1];
    const length = Math.max(Math.hypot(x, y), 1);
    [x, y] = [x / length, y / length];
    knob.style.translate = `${x * 50}% ${y * 50}%`;
    if (Math.hypot(x, y) < DEAD) viewer.drive(0, 0, 0);
    else viewer.drive(x, 0, -y);
  };
  const stop = () => {
    knob.style.translate = "";
    viewer.drive(0, 0, 0);
  };
  stick.onpointerdown = (event) => {
    stick.setPointerCapture(event.pointerId);
    push(event);
  };
  stick.onpointermove = (event) => {
    if (stick.hasPointerCapture(event.pointerId)) push(event);
  };
  stick.onlostpointercapture = stop;
}
