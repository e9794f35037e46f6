// A viewer in any element of a page: a canvas with a scene, its cameras, and the controls that move between them. It draws no buttons.
import { Matrix4, Scene, Vector3, type WebGLRenderer } from "three";
import { findCamera, type SnergCamera } from "../data/cameras";
import { EmbeddedFiles, type FileSource, ServerFiles, sourceOf } from "../data/files";
import { matrixOfRows } from "../data/scene";
import type { SnergScene } from "../data/snerg_scene";
import { asViewerError, ViewerError } from "../errors";
import { loadOptional } from "../load_optional";
import type { BenchmarkOptions, BenchmarkResult } from "../optional/benchmark";
import type { PathPlayer } from "../optional/path";
import type { SnergVolume } from "../volume/volume";
import { wantsLessMotion } from "./flight";
import { GrowingScene } from "./growing_scene";
import type { Bundle, Lent, ProjectedPoint, ScenePoint, Viewer, ViewerEvents, ViewerOptions, ViewerState } from "./interface";
import { Listeners } from "./listeners";
import { Motion } from "./motion";
import { type Mode, Navigation } from "./navigation";
import { type MakePlayer, openBundle } from "./open_bundle";
import { type Colour, ProgressiveRenderer } from "./progressive_renderer";
import { PRESETS, pixelRatioOf, presetFor, type QualityName, readDevice } from "./quality";
import { pngOf } from "./saved_picture";
import { pickPoints, projectPoint, type SeenIn } from "./scene_points";
import { rowsOf } from "./shared_view";
import { View } from "./view";
import { makeRenderer } from "./webgl";

const LOST = "The graphics driver was reset and the scene was lost from its memory. Reload the page.";

/** Show a scene in a container, which needs a size of its own. Throws a ViewerError when the browser has no WebGL 2. */
export const createViewer = (container: HTMLElement, options: ViewerOptions = {}): Viewer => new CanvasViewer(container, options);

class CanvasViewer implements Viewer {
  readonly canvas: HTMLCanvasElement;
  readonly ready: Promise<void>;
  cameras: readonly SnergCamera[] = [];
  bundle: Bundle | null = null;
  backdrop: HTMLImageElement | null = null;
  private readonly webgl: WebGLRenderer;
  private readonly world = new Scene();
  private readonly abort = new AbortController();
  private readonly source: FileSource;
  private readonly listeners = new Listeners<ViewerEvents>();
  private readonly growing: GrowingScene;
  private renderer: ProgressiveRenderer | null = null; // this and the next ones: null until there is something to draw
  private view: View | null = null;
  private navigation: Navigation | null = null;
  private motion: Motion | null = null;
  private makePlayer: MakePlayer | null = null;
  private chosen: QualityName | null; // null: the device chooses
  private readonly suggested: QualityName;
  private colour: Colour;
  private readonly observer = new ResizeObserver(() => this.follow());

  constructor(
    private readonly container: HTMLElement,
    private readonly options: ViewerOptions,
  ) {
    this.colour = options.background ?? [1, 1, 1, 1];
    this.source = options.src ? sourceOf(options.src) : ownFiles();
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.webgl = makeRenderer(this.canvas, (error) => this.fail(error));
    this.chosen = options.quality ?? null;
    this.suggested = presetFor(readDevice(this.webgl.getContext() as WebGL2RenderingContext));
    this.growing = this.makeGrowing();
    container.append(this.canvas);
    options.signal?.addEventListener("abort", () => this.destroy(), { once: true });
    this.canvas.addEventListener("webglcontextlost", (event) => this.lose(event));
    this.canvas.addEventListener("webglcontextrestored", () => this.restore());
    this.canvas.addEventListener("keydown", (event) => this.press(event) && event.preventDefault());
    this.canvas.addEventListener("wheel", (event) => this.spareScrolling(event), { capture: true });
    this.ready = this.load();
    this.ready.catch((error: unknown) => this.fail(error));
  }

  private makeGrowing(): GrowingScene {
    return new GrowingScene({
      renderer: this.webgl,
      world: this.world,
      signal: this.abort.signal,
      quality: () => this.quality,
      begun: () => this.renderer !== null,
      begin: (scene) => this.begin(scene),
      change: () => this.renderer?.change(),
      refine: () => this.renderer?.refine(),
      covered: () => this.covered,
      uncovered: () => this.uncovered(),
      settled: () => this.settled(),
      follow: () => this.follow(),
      notice: (text) => this.listeners.emit("notice", text),
      leaveOut: (error) => this.leaveOut(error),
      fail: (error) => this.fail(error),
    });
  }

  private async load(): Promise<void> {
    const { source } = this;
    const { signal } = this.abort;
    const { cameras, parts, units, scene, coarse, layers, makePlayer } = await openBundle(source, {
      onProgress: (progress) => this.listeners.emit("progress", progress),
      leaveOut: (error) => this.leaveOut(error),
      signal,
    });
    this.cameras = cameras;
    this.bundle = { parts, units, read: (name, stop) => source.read(name, stop ?? signal) };
    this.makePlayer = makePlayer;
    await this.growing.load(scene, coarse, layers);
    await this.renderer?.settled();
    this.follow(); // it may be smoothed from now on
    if (this.options.play && !wantsLessMotion()) this.play();
  }

  /** There is something to show: begin to render, and to follow the mouse. */
  private begin(scene: SnergScene): void {
    const { cameras, listeners, growing } = this;
    const view = new View(scene.description, () => this.viewChanged(), this.options.limits);
    this.view = view;
    this.navigation = new Navigation(view, this.canvas, {
      started: () => this.motion?.stop(),
      mode: (mode) => listeners.emit("mode", mode),
      said: (text) => listeners.emit("said", text),
      pick: (at) => this.pointAt(at),
    });
    this.renderer = new ProgressiveRenderer(this.webgl, this.world, view.rendered, (image) =>
      listeners.emit("image", { ...image, coarse: !growing.fine, whole: growing.whole }),
    );
    this.renderer.background = this.colour;
    const first = cameras[Math.max(findCamera(cameras, this.options.camera ?? null), 0)];
    if (first) view.jump(first);
    this.motion = new Motion(view, this.makePlayer, (state) => listeners.emit("path", state));
    if (this.path && !first) this.path.seek(this.path.state.start);
    this.observer.observe(this.container);
    this.follow();
  }

  get path(): PathPlayer | null {
    return this.motion?.path ?? null;
  }

  get background(): Colour {
    return this.colour;
  }

  set background(colour: Colour) {
    this.colour = colour;
    if (!this.renderer) return;
    this.renderer.background = colour;
    this.renderer.change();
  }

  get quality(): QualityName {
    return this.chosen ?? this.suggested;
  }

  set quality(name: QualityName | null) {
    const before = this.quality;
    this.chosen = name;
    this.follow();
    if (this.quality === before) return;
    this.listeners.emit("quality", this.quality);
    this.growing.changeQuality();
  }

  /** How many images are averaged at rest. A picture of a given size is exact, unless somebody chose a quality. */
  private get samples(): number {
    return !this.growing.whole || (this.options.size && !this.chosen) ? 1 : PRESETS[this.quality].samples;
  }

  get state(): ViewerState {
    const { view, mode } = this;
    const path = this.path?.state ?? null;
    if (!view) return { camera: "", atCamera: false, cameraToWorld: rowsOf(new Matrix4()), zoom: 1, mode, frame: [0, 0, 0, 0], path };
    return {
      camera: view.camera.name,
      atCamera: view.atCamera && !view.shared,
      cameraToWorld: rowsOf(view.pose()),
      zoom: view.zoom,
      mode,
      frame: view.frame,
      path,
    };
  }

  on<Name extends keyof ViewerEvents>(name: Name, listener: (event: ViewerEvents[Name]) => void): () => void {
    return this.listeners.on(name, listener);
  }

  async goTo(camera?: string | number, { duration = 0 }: { duration?: number } = {}): Promise<void> {
    const { view } = this;
    if (!view) return;
    const index = camera === undefined ? -1 : typeof camera === "number" ? camera : findCamera(this.cameras, camera);
    if (camera !== undefined && !this.cameras[index]) throw new ViewerError(`There is no camera ${camera}.`);
    await this.motion?.goTo(this.cameras[index] ?? view.overview(), duration);
  }

  play(): void {
    this.path?.play();
  }

  pause(): void {
    this.path?.pause();
  }

  lookFrom(cameraToWorld: number[][], zoom = 1): void {
    this.motion?.stop();
    this.view?.lookFrom(matrixOfRows(cameraToWorld), zoom);
  }

  async thumbnail(index: number): Promise<Blob | null> {
    const name = this.cameras[index]?.thumbnail;
    if (!name) return null;
    try {
      return new Blob([(await this.source.read(name, this.abort.signal)) as Uint8Array<ArrayBuffer>], { type: "image/webp" });
    } catch {
      return null; // the list has its label
    }
  }

  get mode(): Mode {
    return this.navigation?.mode ?? "orbit";
  }

  set mode(mode: Mode) {
    if (this.navigation) this.navigation.mode = mode;
  }

  turn(right: number, up: number): void {
    this.navigation?.turn(right, up);
  }

  drive(right: number, up: number, forward: number): void {
    this.navigation?.drive(right, up, forward);
  }

  press(event: KeyboardEvent): boolean {
    return this.navigation?.press(event) ?? false;
  }

  async settled(): Promise<void> {
    if (!this.renderer) return this.ready;
    await this.motion?.landed();
    await this.navigation?.rested();
    await this.renderer.settled();
  }

  async capture({ width, height, alpha = false }: { width?: number; height?: number; alpha?: boolean } = {}): Promise<Blob> {
    await this.ready;
    const [w, h] = [width ?? this.canvas.width, height ?? this.canvas.height];
    const renderer = this.renderer as ProgressiveRenderer;
    const view = this.view as View;
    const size = view.resize(w, h); // the same camera fits the picture
    const pixels = renderer.capture(w, h, alpha ? [0, 0, 0, 0] : this.colour);
    view.resize(...size);
    return pngOf(pixels, w, h, alpha ? null : this.backdrop);
  }

  pick(places: readonly [number, number][]): (ScenePoint | null)[] {
    const { volume } = this.growing;
    if (!this.view || !volume) return places.map(() => null);
    return pickPoints(this.webgl, volume, this.seenIn(this.view), places);
  }

  project(point: readonly number[]): ProjectedPoint {
    return this.view ? projectPoint(this.seenIn(this.view), point) : { x: 0, y: 0, depth: 0 };
  }

  private seenIn({ rendered }: View): SeenIn {
    return { camera: rendered, width: this.canvas.clientWidth, height: this.canvas.clientHeight };
  }

  async fullscreen(): Promise<void> {
    if (document.fullscreenElement) return document.exitFullscreen();
    await this.container.requestFullscreen();
  }

  lend(): Lent | null {
    const { renderer } = this;
    const { volume, whole } = this.growing;
    if (!renderer || !volume || !whole) return null;
    this.motion?.endFlight();
    renderer.pause(true);
    const release = () => {
      this.world.add(volume);
      renderer.pause(false);
      this.follow();
    };
    return { renderer: this.webgl, volume, release };
  }

  async benchmark(options?: BenchmarkOptions): Promise<BenchmarkResult> {
    const [{ measure }] = await Promise.all([loadOptional("benchmark"), this.ready]);
    await this.settled();
    return measure({ renderer: this.webgl, volume: this.growing.volume as SnergVolume, cameras: this.cameras }, options);
  }

  destroy(): void {
    this.motion?.stop();
    this.abort.abort(new ViewerError("The viewer was closed."));
    this.observer.disconnect();
    this.renderer?.dispose();
    this.navigation?.dispose();
    this.webgl.dispose();
    this.canvas.remove();
  }

  /** Give the canvas its size in device pixels. */
  private follow(): void {
    const { size } = this.options;
    const [width, height] = size ? [size.width, size.height] : [this.container.clientWidth, this.container.clientHeight];
    if (width < 1 || height < 1 || !this.view || !this.renderer) return;
    const ratio = size ? 1 : pixelRatioOf(PRESETS[this.quality], width, height, window.devicePixelRatio);
    this.renderer.samples = this.samples;
    this.view.resize(width, height);
    this.renderer.resize(Math.round(width * ratio), Math.round(height * ratio));
  }

  private viewChanged(): void {
    if (this.view && !this.view.atCamera) this.motion?.stop(); // somebody moves it
    this.renderer?.change();
    this.listeners.emit("view", this.state);
  }

  /** The point of the scene that is seen at a place of the canvas, in CSS pixels. */
  private pointAt(at: readonly [number, number]): Vector3 | null {
    const [found] = this.pick([[...at]]);
    return found ? new Vector3(...found.position) : null;
  }

  /** Inside the frame of another page the wheel scrolls that page, and zooms with Ctrl alone. */
  private spareScrolling(event: WheelEvent): void {
    if (window.self === window.top || event.ctrlKey || event.metaKey) return;
    event.stopImmediatePropagation();
    this.listeners.emit("scroll", undefined);
  }

  /** Whether something lies over the canvas. */
  private get covered(): boolean {
    return this.options.covered?.() ?? false;
  }

  /** Resolves when nothing lies over the canvas any more. */
  private uncovered(): Promise<void> {
    if (!this.covered) return Promise.resolve();
    return new Promise((resolve) => {
      const stop = this.on("image", () => {
        if (this.covered) return;
        stop();
        resolve();
      });
    });
  }

  /** The graphics driver was reset. */
  private lose(event: Event): void {
    event.preventDefault();
    this.growing.lose();
  }

  private async restore(): Promise<void> {
    if (!this.renderer) return;
    try {
      await this.growing.restore();
    } catch {
      return this.fail(new ViewerError(LOST));
    }
    this.renderer.restart();
  }

  /** An optional file is missing or damaged: say so, and go on without it. Throws when the viewer is closed. */
  private leaveOut(error: unknown): null {
    if (this.abort.signal.aborted) throw error;
    this.listeners.emit("missing", asViewerError(error));
    return null;
  }

  private fail(error: unknown): void {
    if (this.abort.signal.aborted) return;
    if (!(error instanceof ViewerError)) console.error(error);
    this.listeners.emit("error", asViewerError(error));
  }
}

/** Without an address, the files inside the page, or else those beside it. */
const ownFiles = (): FileSource => (EmbeddedFiles.areThere() ? new EmbeddedFiles("") : new ServerFiles("."));
