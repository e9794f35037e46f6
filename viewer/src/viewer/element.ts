// <snerg-viewer>: a viewer with its bar, its progress and its messages.
import { findCamera } from "../data/cameras";
import { asViewerError, type ViewerError } from "../errors";
import { loadOptional } from "../load_optional";
import type { BenchmarkResult } from "../optional/benchmark";
import type { PathBar } from "../optional/path";
import { Announcer } from "./announce";
import { colourOf } from "./backdrop";
import { Backgrounds } from "./backgrounds";
import { Bar, MAX_SIDE } from "./bar";
import type { Viewer } from "./interface";
import { MODES } from "./navigation";
import { qualityOf } from "./quality";
import { QualityChoice } from "./quality_choice";
import { Shortcuts } from "./shortcuts";
import style from "./style.css";
import template from "./template.html";
import { createViewer } from "./viewer";

const HINT_SHOWN = 1500; // milliseconds
const FLIGHT = 1.2; // seconds to the camera of an annotation

/**
 * Shows the scene of a bundle. Attributes, which are read when it is put into the page:
 *
 *   src         the bundle's folder (with cameras.json and scene/); without it, the folder or the single file of the page itself
 *   camera      the name or the number of the camera to begin with
 *   background  white, grey, black, #rrggbb, transparent, or image for the picture of `background-image`
 *   background-image  a picture behind the scene
 *   mode        orbit, fly or walk: how one moves at first
 *   poster      a picture that is shown until the scene is there
 *   distance    "MIN MAX": how near and far one may orbit, in units of the scene, from the point that is looked at
 *   elevation   "MIN MAX": how low and high one may orbit, in degrees above the horizon
 *   play        where there, the camera path plays as soon as the scene is there, but not for people who asked for less motion
 *   quality     phone, balanced or full: how fine the picture is, and how much memory the scene may take; without it, what suits the device
 *   ui          "none": without the bar
 *   width, height  of the picture in CSS pixels; else it fills the element
 *
 * Events: "picture" with the first picture, "view" when the view changes, "load" when the scene is there, "error" with the message in `detail`, "camera" with a camera's name in `detail` when it is chosen.
 */
export class SnergViewerElement extends HTMLElement {
  /** The viewer; null until the element is in a page, and where the browser cannot show it. */
  viewer: Viewer | null = null;
  /** The message that is shown in place of the scene, or null. */
  problem: string | null = null;
  /** Resolves to whether the scene is shown. */
  readonly ready: Promise<boolean>;
  /** The bar and what it can do; null until there is a picture. */
  bar: Bar | null = null;
  private pathBar: PathBar | null = null;
  private leaving = new AbortController(); // tells the optional code that the viewer is closed
  private backgrounds: Backgrounds | null = null;
  private shortcuts: Shortcuts | null = null;
  private settle!: (shown: boolean) => void;
  private readonly root = this.attachShadow({ mode: "open" });

  constructor() {
    super();
    this.ready = new Promise((resolve) => {
      this.settle = resolve;
    });
  }

  connectedCallback(): void {
    if (this.viewer) return;
    this.leaving = new AbortController();
    this.root.innerHTML = template;
    const sheet = new CSSStyleSheet();
    sheet.replaceSync(style);
    this.root.adoptedStyleSheets = [sheet];
    this.find("reload").onclick = () => location.reload();
    this.find("close-missing").onclick = () => {
      this.find("missing-list").replaceChildren();
      this.find("close-missing").hidden = true;
    };
    this.shortcuts = new Shortcuts(this.find<HTMLInputElement>("shortcuts"));
    const poster = this.getAttribute("poster");
    if (poster) this.showPoster(poster);
    try {
      this.start();
    } catch (error) {
      this.fail(asViewerError(error));
    }
  }

  disconnectedCallback(): void {
    this.leaving.abort();
    this.viewer?.destroy();
    this.viewer = null;
    this.bar = null;
    this.pathBar = null;
  }

  /** What is behind the scene, in the words of the attribute. */
  get background(): string {
    return this.backgrounds?.current ?? "";
  }

  /** Show a message in place of the scene. */
  fail(error: ViewerError): void {
    this.problem = error.message;
    this.find("loading").hidden = true;
    this.find("bar").hidden = true;
    this.find("problem").hidden = false;
    this.find("problem-text").textContent = error.message;
    this.dispatchEvent(new CustomEvent("error", { detail: error.message }));
    this.settle(false);
  }

  /** Say beside the scene what is missing from it. */
  report(error: ViewerError): void {
    const list = this.find("missing-list");
    if ([...list.children].some((line) => line.textContent === error.message)) return;
    list.append(Object.assign(document.createElement("p"), { textContent: error.message }));
    this.find("close-missing").hidden = false;
  }

  /** Show the camera of that name or number, as its entry in the list does. duration: seconds of a flight there. */
  choose(name: string | number, duration = 0): void {
    const { viewer } = this;
    if (!viewer) return;
    const index = typeof name === "number" ? name : findCamera(viewer.cameras, name);
    if (!viewer.cameras[index]) return;
    this.find<HTMLSelectElement>("camera").value = String(index);
    this.bar?.chosen();
    void viewer.goTo(index, { duration });
    this.dispatchEvent(new CustomEvent("camera", { detail: viewer.cameras[index].name }));
  }

  /**
   * Measure, and show the result in a dialog; null where it was cancelled. kind: of the scene, as the paper names them. frames: of the
   * path, where the paper's 150 take too long.
   */
  async benchmark(kind = "", frames?: number): Promise<BenchmarkResult | null> {
    if (!this.viewer) return null;
    const { openBenchmark } = await loadOptional("benchmark");
    return openBenchmark(this.root, this.viewer, kind, frames);
  }

  private find<T extends HTMLElement>(id: string): T {
    return this.root.getElementById(id) as T;
  }

  private start(): void {
    const stage = this.find("stage");
    const size = this.fixedSize();
    if (size) Object.assign(stage.style, { width: `${size.width}px`, height: `${size.height}px` });
    stage.classList.toggle("fixed", size !== undefined);
    const background = this.getAttribute("background") ?? "";
    const address = this.getAttribute("background-image");
    const backdrop = address === null ? null : this.find<HTMLImageElement>("backdrop");
    if (backdrop && address) backdrop.src = address;
    const viewer = createViewer(stage, {
      src: this.getAttribute("src") ?? undefined,
      camera: this.getAttribute("camera"),
      background: colourOf(background) ?? (backdrop ? [0, 0, 0, 0] : [1, 1, 1, 1]),
      size,
      play: this.hasAttribute("play"),
      quality: qualityOf(this.getAttribute("quality")),
      covered: () => !this.find("poster").hidden,
      limits: { distance: this.pair("distance"), elevation: this.pair("elevation") },
    });
    this.viewer = viewer;
    const { canvas } = viewer;
    canvas.id = "canvas";
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The scene. Arrow keys turn it, plus and minus zoom, V changes how one moves, H helps.");
    const announcer = new Announcer(this.find("spoken"), viewer);
    this.backgrounds = new Backgrounds(stage, this.root, viewer, backdrop, () => this.dispatchEvent(new CustomEvent("view")));
    const { backgrounds } = this;
    backgrounds.show(background);
    const quality = new QualityChoice(this.find("quality"), viewer, () => this.dispatchEvent(new CustomEvent("view")));
    quality.show(this.getAttribute("quality"));
    if (backdrop) {
      backdrop.onerror = () => {
        announcer.say("The background picture did not arrive.");
        backgrounds.show("white");
      };
    }
    viewer.on("error", (error) => this.fail(error));
    viewer.on("missing", (error) => this.report(error));
    viewer.on("progress", ({ slices, totalSlices, bytes }) => {
      this.find<HTMLProgressElement>("loading-bar").value = slices / totalSlices;
      const about = (bytes / slices) * totalSlices; // its slices are about equally large
      this.find("loading-text").textContent = `Loading the scene: ${megabytes(bytes)} of about ${megabytes(about)} MB`;
    });
    viewer.on("image", ({ width, height, milliseconds, coarse, whole }) => {
      // The poster is finer than the coarse scene, but it shows one view alone.
      const poster = this.find("poster");
      const { atCamera, camera } = viewer.state;
      if (!coarse || !atCamera || camera !== (viewer.cameras[0]?.name ?? "")) poster.hidden = true;
      this.find("loading").hidden = whole;
      this.find("loading").classList.add("beside");
      const time = milliseconds < 10 ? milliseconds.toFixed(1) : Math.round(milliseconds);
      this.find("readout").textContent = `${width} × ${height} · ${time} ms`;
      if (this.bar || this.problem) return;
      this.bar = new Bar(this.root, viewer, backgrounds, quality, (index, duration) => this.choose(index, duration));
      viewer.mode = MODES.find((mode) => mode === this.getAttribute("mode")) ?? "orbit";
      this.find("bar").hidden = this.getAttribute("ui") === "none";
      void this.addPathBar(viewer);
      this.addParts(viewer);
      this.dispatchEvent(new CustomEvent("picture"));
    });
    viewer.on("view", () => {
      this.bar?.showFrame();
      this.dispatchEvent(new CustomEvent("view"));
    });
    this.find("close-notice").onclick = () => {
      this.find("notice").hidden = true;
      viewer.canvas.focus();
    };
    viewer.on("notice", (text) => {
      this.find("notice").hidden = text === null;
      this.find("notice-text").textContent = text;
    });
    let hiding = 0;
    const hint = (text: string) => {
      this.find("hint").textContent = text;
      this.find("hint").hidden = false;
      clearTimeout(hiding);
      hiding = window.setTimeout(() => {
        this.find("hint").hidden = true;
      }, HINT_SHOWN);
    };
    viewer.on("scroll", () => hint("Hold Ctrl and turn the wheel to zoom."));
    viewer.on("said", hint);
    this.addEventListener("keydown", (event) => this.press(event));
    viewer.ready.then(
      () => {
        this.settle(this.problem === null);
        this.dispatchEvent(new CustomEvent("load"));
      },
      () => {}, // it was said by "error"
    );
  }

  private async addPathBar(viewer: Viewer): Promise<void> {
    if (!viewer.path) return;
    const { PathBar } = await loadOptional("path"); // it is there: the viewer plays with it
    if (this.viewer !== viewer) return;
    const bar = new PathBar(this.root, viewer.path);
    bar.hidden = this.getAttribute("ui") === "none";
    viewer.on("path", () => bar.update());
    this.pathBar = bar;
  }

  /** Load the optional code that the bundle calls for. Without a part the scene is still shown; what is missing is said. */
  private addParts(viewer: Viewer): void {
    const host = { viewer, root: this.root, stage: this.find("stage"), choose: (name: string) => this.choose(name, FLIGHT) };
    for (const name of viewer.bundle?.parts ?? []) {
      const added = loadOptional(name).then(({ attach }) => attach({ ...host, signal: this.leaving.signal }));
      added.catch((error: unknown) => this.report(asViewerError(error)));
    }
  }

  private fixedSize(): { width: number; height: number } | undefined {
    const [width, height] = ["width", "height"].map((key) => Math.min(Number.parseInt(this.getAttribute(key) ?? "", 10) || 0, MAX_SIDE));
    return width > 0 && height > 0 ? { width, height } : undefined;
  }

  /** Two numbers of an attribute, the smaller one first; undefined where there are none. */
  private pair(name: string): [number, number] | undefined {
    const values = (this.getAttribute(name) ?? "").trim().split(/\s+/).map(Number);
    return values.length === 2 && values.every(Number.isFinite) && values[0] <= values[1] ? [values[0], values[1]] : undefined;
  }

  private showPoster(address: string): void {
    const poster = this.find<HTMLImageElement>("poster");
    poster.src = address;
    poster.hidden = false;
    poster.onerror = () => {
      poster.hidden = true;
    };
    this.find("loading").classList.add("beside");
  }

  /** Keys, also those that the page passes on from outside the element. */
  press(event: KeyboardEvent): void {
    const origin = event.composedPath()[0];
    const typed = origin instanceof HTMLElement && origin.matches("input, select, textarea, dialog *");
    if (event.defaultPrevented || event.ctrlKey || event.metaKey || event.altKey || typed) return;
    if (origin !== this.viewer?.canvas && !this.shortcuts?.allows(event)) return;
    const onButton = origin instanceof HTMLElement && origin.matches("button");
    if (this.pathBar?.press(event.key, onButton)) return event.preventDefault();
    const key = (event.key ?? "").toLowerCase(); // null when the browser fills in a form
    if (this.bar?.press(key) || this.viewer?.press(event)) event.preventDefault();
  }
}

const megabytes = (bytes: number): string => (bytes / 1e6).toFixed(bytes < 1e7 ? 1 : 0);

export function defineElement(): void {
  if (!customElements.get("snerg-viewer")) customElements.define("snerg-viewer", SnergViewerElement);
}
