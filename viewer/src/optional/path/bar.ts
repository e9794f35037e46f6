// The row above the bar that plays a camera path: play, time, loop and speed, and the keys for them.

import style from "./bar.css";
import template from "./bar.html";
import type { PathPlayer } from "./path";

const PLAY = "M3 1.5v13l11-6.5z";
const PAUSE = "M3 2h3.5v12H3zM9.5 2H13v12H9.5z";
const SVG = "http://www.w3.org/2000/svg";

export class PathBar {
  private readonly row = document.createElement("div");
  private readonly icon = document.createElementNS(SVG, "path");

  constructor(
    root: ShadowRoot,
    private readonly player: PathPlayer,
  ) {
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(style);
    root.adoptedStyleSheets = [...root.adoptedStyleSheets, sheet];
    this.row.id = "path";
    this.row.setAttribute("role", "group");
    this.row.setAttribute("aria-label", "Camera move");
    this.row.innerHTML = template;
    root.getElementById("bar")?.before(this.row);
    const svg = document.createElementNS(SVG, "svg");
    svg.setAttribute("viewBox", "0 0 16 16");
    svg.setAttribute("aria-hidden", "true");
    svg.append(this.icon);
    this.find("play").append(svg);
    this.find("play").onclick = () => this.toggle();
    this.find("loop").onclick = () => this.toggleLoop();
    const speed = this.find<HTMLSelectElement>("speed");
    speed.onchange = () => {
      player.speed = Number(speed.value);
    };
    const scrub = this.find<HTMLInputElement>("scrub");
    const { start, end, fps } = player.state;
    Object.assign(scrub, { min: String(start), max: String(end) });
    scrub.oninput = () => {
      player.pause();
      player.seek(Number(scrub.value));
    };
    scrub.onkeydown = (event) => this.stepBySecond(event, fps);
    this.update();
  }

  set hidden(hidden: boolean) {
    this.row.hidden = hidden;
  }

  /** Show the player's state. */
  update(): void {
    const { frame, start, end, fps, playing, loop, speed } = this.player.state;
    const play = this.find("play");
    if (this.row.dataset.playing !== String(playing)) {
      this.row.dataset.playing = String(playing);
      play.setAttribute("aria-label", playing ? "Pause" : "Play");
      play.title = playing ? "Pause (Space)" : "Play (Space)";
      this.icon.setAttribute("d", playing ? PAUSE : PLAY);
    }
    const shown = Math.min(frame, end);
    const scrub = this.find<HTMLInputElement>("scrub");
    scrub.value = String(shown);
    const [at, length] = [(shown - start) / fps, (end + 1 - start) / fps];
    const [now, whole] = this.find("clock").children;
    now.textContent = minutes(at);
    whole.textContent = ` / ${minutes(length)}`;
    const spoken = `${at.toFixed(1)} of ${length.toFixed(1)} seconds`;
    if (!playing) scrub.setAttribute("aria-valuetext", spoken); // not at every picture: a screen reader would read each
    this.find("loop").setAttribute("aria-pressed", String(loop));
    const select = this.find<HTMLSelectElement>("speed");
    if ([...select.options].some((option) => Number(option.value) === speed)) select.value = String(speed);
  }

  /** Take a key; returns whether it means something. Space presses a button that has the focus, and is left to it. */
  press(key: string, onButton: boolean): boolean {
    if (key === " " && !onButton) this.toggle();
    else if (key === "l") this.toggleLoop();
    else if (key === "," || key === ".") this.step(key === "." ? 1 : -1);
    else return false;
    return true;
  }

  private find<T extends HTMLElement>(id: string): T {
    return this.row.querySelector(`#${id}`) as T;
  }

  private toggle(): void {
    if (this.player.playing) this.player.pause();
    else this.player.play();
  }

  private toggleLoop(): void {
    this.player.loop = !this.player.loop;
  }

  /** Show the next or the last whole frame. */
  private step(by: number): void {
    this.player.pause();
    const { frame } = this.player.state;
    this.player.seek(by > 0 ? Math.floor(frame + 1e-6) + 1 : Math.ceil(frame - 1e-6) - 1);
  }

  /** On the slider, arrow keys go by a frame, and page keys by a second. */
  private stepBySecond(event: KeyboardEvent, fps: number): void {
    const step = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1, PageUp: fps, PageDown: -fps }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    if (Math.abs(step) === 1) return this.step(step);
    this.player.pause();
    this.player.seek(this.player.state.frame + step);
  }
}

/** Seconds as "0:03.4". */
function minutes(seconds: number): string {
  const tenths = Math.floor(seconds * 10 + 1e-6);
  return `${Math.floor(tenths / 600)}:${String(Math.floor(tenths / 10) % 60).padStart(2, "0")}.${tenths % 10}`;
}
