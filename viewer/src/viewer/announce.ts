// Says in words what the picture shows, for people who do not see it: how far the scene has arrived, the camera, how one moves.
import type { Viewer } from "./interface";
import type { Mode } from "./navigation";

const AFTER = 700; // milliseconds without a change after which the view is told
const PARTS = ["", "A quarter of the scene has arrived.", "Half of the scene has arrived.", "Three quarters of the scene have arrived."];
const SIDES = ["front", "front right", "right", "back right", "back", "back left", "left", "front left"] as const; // Blender's
const MODES: Readonly<Record<Mode, string>> = {
  orbit: "Orbit: the camera turns around the scene. Arrow keys turn it, plus and minus zoom.",
  fly: "Fly: W, A, S and D move, Q and E sink and rise, arrow keys look around.",
  walk: "Walk: W, A, S and D move on the level, Q and E change the height, arrow keys look around.",
};

/** From which side a camera looks, in words. cameraToWorld: four rows, Blender's axes. */
export function whereFrom(cameraToWorld: number[][]): string {
  const [x, y, z] = cameraToWorld.map((row) => row[2]); // backward
  const degrees = Math.round((Math.asin(Math.min(Math.max(z, -1), 1)) * 180) / Math.PI);
  if (Math.abs(degrees) > 80) return `Seen from ${degrees > 0 ? "above" : "below"}.`;
  const side = SIDES[(Math.round(Math.atan2(x, -y) / (Math.PI / 4)) + 8) % 8];
  return `Seen from the ${side}${degrees ? `, ${Math.abs(degrees)} degrees ${degrees > 0 ? "above" : "below"}` : ""}.`;
}

/** Writes into a live region, which screen readers read out. */
export class Announcer {
  private told = ""; // of the view
  private part = 0; // of PARTS
  private timer = 0;
  private notice: string | null = null;

  constructor(
    private readonly region: HTMLElement,
    private readonly viewer: Viewer,
  ) {
    this.say("Loading the scene.");
    viewer.on("progress", ({ slices, totalSlices }) => {
      const part = Math.floor((PARTS.length * slices) / totalSlices);
      if (part > this.part && part < PARTS.length) this.say(PARTS[part]);
      this.part = part;
    });
    viewer.on("view", () => {
      clearTimeout(this.timer);
      this.timer = window.setTimeout(() => this.sayView(), AFTER);
    });
    viewer.on("mode", (mode) => this.say(MODES[mode]));
    viewer.on("notice", (text) => {
      this.notice = text;
      if (text) this.say(text);
    });
    viewer.on("said", (text) => this.say(text));
    viewer.ready.then(
      () => this.say(`${this.notice ?? "The whole scene is shown."} ${this.view}`),
      () => {}, // the alert says it
    );
  }

  say(text: string): void {
    this.region.textContent = text;
  }

  private get view(): string {
    const { cameras, state } = this.viewer;
    const index = cameras.findIndex((camera) => camera.name === state.camera);
    if (!state.atCamera || index < 0) return whereFrom(state.cameraToWorld);
    return `Camera ${state.camera}, ${index + 1} of ${cameras.length}.`;
  }

  private sayView(): void {
    const text = this.view;
    if (text !== this.told) this.say(text);
    this.told = text;
  }
}
