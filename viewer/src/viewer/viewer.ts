// A viewer in any element of a page: a canvas with a scene, its cameras, and the controls that move between them. It draws no buttons.
import { Matrix4, Quaternion, Scene, Vector3, WebGLRenderer } from "three";
import { type LayerOrder, type PartName, readCameras, type SnergCamera, type WorldUnits } from "../data/cameras";
import { EmbeddedFiles, type FileSource, readJson, ServerFiles, sourceOf } from "../data/files";
import { matrixOfRows } from "../data/scene";
import { type LoadProgress, SnergScene } from "../data/snerg_scene";
import { EXPORT_AGAIN, TooLarge, ViewerError } from "../errors";
import { loadOptional } from "../load_optional";
import type { BenchmarkOptions, BenchmarkResult } from "../optional/benchmark";
import type { CameraPath, PathCamera, PathPlayer, PathState } from "../optional/path";
import { type GrowthOptions, SnergVolume } from "../volume/volume";
import { drawCovering } from "./backdrop";
import { between, eased, wantsLessMotion } from "./flight";
import { type Mode, Navigation } from "./navigation";
import { type Colour, ProgressiveRenderer, type ShownImage } from "./progressive_renderer";
import { PRESETS, pixelRatioOf, presetFor, type QualityName, readDevice, tooMuchFor } from "./quality";
import type { OrbitLimits } from "./rig";
import { rowsOf } from "./shared_view";
import { View } from "./view";

const NO_WEBGL =
  "This browser offers no WebGL 2, which renders the scene. Switch on graphics acceleration in its settings, or use a newer browser.";
const TOO_LARGE = "this device's graphics memory or driver does not hold the whole";
const LOST = "The graphics driver was reset and the scene was lost from its memory. Reload the page.";

export interface ViewerOptions {
  /** The address of a folder that holds cameras.json and scene/, as `snerg bundle` writes it. Without it, the page's own files. */
  src?: string | URL | FileSource;
  /** The name of the camera to begin with, or its number as text; the first without it. */
  camera?: string | null;
  background?: Colour;
  /** The canvas's size in CSS pixels; else it follows the container. */
  size?: { width: number; height: number };
  limits?: OrbitLimits;
  /** Play the camera path, if there is one, as soon as the scene is there; not for people who asked for less motion. */
  play?: boolean;
  /** How much the device is asked for; without it, what suits the device. */
  quality?: QualityName | null;
  signal?: AbortSignal;
  /** Whether something lies over the canvas, such as a poster, so that unfinished pictures need not be drawn. */
  covered?: () => boolean;
}

export interface ViewerEvents {
  progress: LoadProgress;
  image: ShownImage & { coarse: boolean; whole: boolean }; // coarse: until all that the first camera sees is there; whole: the rest, too
  view: ViewerState;
  path: PathState; // somebody plays, stops or moves along the camera path
  error: ViewerError;
  missing: ViewerError; // of an optional file, which is missing or damaged: the scene is shown without it
  mode: Mode;
  quality: QualityName; // another preset is in force
  notice: string | null; // a sentence on why the scene is shown at a quarter of its resolution; null when it no longer is
  said: string; // something that the page should say in words, as the speed of a flight
  scroll: undefined; // somebody turned the wheel without Ctrl inside the frame of another page
}

export interface ViewerState {
  camera: string; // the name of the camera that was shown last; "" for none
  atCamera: boolean; // whether the view is still that camera's own
  cameraToWorld: number[][]; // of the view: four rows, Blender's axes
  zoom: number; // of an orthographic camera, from its own
  mode: Mode;
  frame: [number, number, number, number]; // where the camera's image lies: left, top, width, height in CSS pixels
  path: PathState | null; // null where there is no camera path
}

export interface Viewer {
  /** Resolves when the scene is on the card, all of it that the quality and the device hold; rejects with a ViewerError. */
  ready: Promise<void>;
  readonly cameras: readonly SnergCamera[];
  readonly state: ViewerState;
  readonly canvas: HTMLCanvasElement;
  /** What else the bundle holds; null until there is a picture. */
  readonly bundle: Bundle | null;
  background: Colour;
  /** A picture that the page shows behind the canvas, which saved pictures have behind the scene. */
  backdrop: HTMLImageElement | null;
  /** The preset that is in force. Set null to let the device choose. */
  get quality(): QualityName;
  set quality(name: QualityName | null);
  on<Name extends keyof ViewerEvents>(name: Name, listener: (event: ViewerEvents[Name]) => void): () => void;
  /** Show a camera, by its name or number; without one, the whole scene. duration: seconds of a flight there. */
  goTo(camera?: string | number, options?: { duration?: number }): Promise<void>;
  /** The camera path: `seek`, `loop` and `speed`; null without one, and until there is a picture. */
  readonly path: PathPlayer | null;
  /** Play the camera path from where it stands; nothing happens without one. */
  play(): void;
  pause(): void;
  /** Look from a pose, camera-to-world in four rows, with the lens of the camera that is shown. zoom: of an orthographic camera. */
  lookFrom(cameraToWorld: number[][], zoom?: number): void;
  /** The small picture of a camera; null where it has none, or the file does not arrive. */
  thumbnail(index: number): Promise<Blob | null>;
  /** How hands and keys move the camera. */
  mode: Mode;
  /** Turn by radians: an orbit around its pivot, otherwise the camera where it is. */
  turn(right: number, up: number): void;
  /** Fly or walk on until all are 0: to the right, up and forward, each from -1 to 1. Does nothing in an orbit. */
  drive(right: number, up: number, forward: number): void;
  /** Take a key that was pressed; returns whether it means something. */
  press(event: KeyboardEvent): boolean;
  /** Resolves when the page shows the full image of the view, with smooth edges where the quality has them. */
  settled(): Promise<void>;
  /** The picture as a PNG. alpha: without the background. */
  capture(options?: { width?: number; height?: number; alpha?: boolean }): Promise<Blob>;
  /**
   * The points of the scene that are seen at places of the canvas, [x, y] in CSS pixels from its top left corner: where half of the light
   * is gone, in Blender's axes; null where more comes through.
   */
  pick(places: readonly [number, number][]): (ScenePoint | null)[];
  /** Where a point of the scene lies in the view. */
  project(point: readonly number[]): ProjectedPoint;
  fullscreen(): Promise<void>;
  /** For optional code: leave the canvas and the volume to somebody else until `release` is called; null until the scene is there. */
  lend(): Lent | null;
  /** Measure the frames a second on the paper's orbit. Rejects with the signal's reason. */
  benchmark(options?: BenchmarkOptions): Promise<BenchmarkResult>;
  destroy(): void;
}

/** What a bundle holds beside the scene and its cameras, and its files by their paths. */
export interface Bundle extends FileSource {
  parts: readonly PartName[]; // optional code that its page shows
  units: WorldUnits;
}

/** What draws a viewer. */
export interface Lent {
  renderer: WebGLRenderer;
  volume: SnergVolume; // in Blender's axes and units
  release(): void;
}

/** A point that is seen. */
export interface ScenePoint {
  position: [number, number, number]; // in Blender's axes
  depth: number; // from the camera, along its view axis
  voxel: number; // the longest edge of a voxel there: how exact the point is
}

export interface ProjectedPoint {
  x: number; // CSS pixels of the canvas
  y: number;
  depth: number; // from the camera, along its view axis, in units of the scene; what is not above 0 is behind it
}

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
  private readonly listeners = new Map<string, Set<(event: never) => void>>();
  private renderer: ProgressiveRenderer | null = null;
  private view: View | null = null;
  private navigation: Navigation | null = null;
  private volume: SnergVolume | null = null;
  private scene: SnergScene | null = null;
  private coarse: SnergScene | null = null; // shown first, where the scene has not arrived, and where the whole is too large
  private layers: LayerOrder | null = null;
  private whole = false; // whether all of the scene is there, or of the coarse one in its place
  private fine = false; // whether all is there that the first camera sees
  private growing: SnergVolume | null = null;
  private grown = false; // since the picture was begun
  private chosen: QualityName | null; // null: the device chooses
  private readonly suggested: QualityName;
  private unfit = false; // whether the device turned out not to hold the whole scene
  private filling: Promise<void> = Promise.resolve(); // one after another
  private refining = false; // whether `refine` waits for a picture
  private losses = 0; // of the graphics context
  private flight = 0; // counts flights, so that a new one ends the one before
  private flying: Promise<void> | null = null;
  private makePlayer: MakePlayer | null = null;
  path: PathPlayer | null = null;
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
    container.append(this.canvas);
    options.signal?.addEventListener("abort", () => this.destroy(), { once: true });
    this.canvas.addEventListener("webglcontextlost", (event) => this.lose(event));
    this.canvas.addEventListener("webglcontextrestored", () => this.restore());
    this.canvas.addEventListener("keydown", (event) => this.press(event) && event.preventDefault());
    this.canvas.addEventListener("wheel", (event) => this.spareScrolling(event), { capture: true });
    this.ready = this.load();
    this.ready.catch((error: unknown) => this.fail(error));
  }

  private async load(): Promise<void> {
    const { signal } = this.abort;
    const { source } = this;
    const onProgress = (progress: LoadProgress) => this.emit("progress", progress);
    const [{ cameras, coarse, path, layers, parts, units }, scene] = await Promise.all([
      readCameras(source, "cameras.json", signal),
      SnergScene.load(source, { folder: "scene/", onProgress, signal }),
    ]);
    this.cameras = cameras;
    this.bundle = { parts, units, read: (name, stop) => source.read(name, stop ?? signal) };
    this.scene = scene;
    const leaveOut = (error: unknown) => this.leaveOut(error);
    if (path) this.makePlayer = await readPath(source, signal).catch(leaveOut);
    this.layers = layers;
    if (coarse) this.coarse = await SnergScene.load(source, { folder: "coarse/", signal, keep: true }).catch(leaveOut);
    this.filling = this.fill(scene);
    await this.filling;
    await this.renderer?.settled();
    this.follow(); // it may be smoothed from now on
    if (this.options.play && !wantsLessMotion()) this.play();
  }

  /** An optional file is missing or damaged: say so, and go on without it. Throws when the viewer is closed. */
  private leaveOut(error: unknown): null {
    if (this.abort.signal.aborted) throw error;
    this.emit("missing", asViewerError(error));
    return null;
  }

  /**
   * Show the scene: first the coarse one, then one that grows, unless it is too large. Begins again where the graphics context is lost
   * meanwhile; where that happens a second time, the scene is taken to be too large.
   */
  private async fill(scene: SnergScene, lostBefore = 0): Promise<void> {
    const { losses } = this;
    const { order, seen } = this.layers ?? {};
    try {
      if (this.coarse && (lostBefore || this.volume?.source !== this.coarse)) await this.showCoarse(this.coarse, losses);
      if (!this.tooLarge) await this.show(scene, { coarse: this.coarse ?? undefined, wanted: this.uncovered(), order, enough: seen });
    } catch (error) {
      if (this.abort.signal.aborted) throw error;
      const lost = losses === this.losses ? 0 : 1;
      if (!lost && !(this.coarse && error instanceof TooLarge && !this.unfit)) throw error;
      this.unfit ||= !lost || lostBefore > 0;
      if (lost) await this.restored();
      return this.fill(scene, lostBefore + lost);
    }
    this.whole = this.fine = true;
    this.notify(this.tooLarge);
    this.renderer?.refine();
  }

  /** Show the coarse scene; without it one waits longer for the picture. losses: of the graphics context, when it began. */
  private async showCoarse(coarse: SnergScene, losses: number): Promise<void> {
    try {
      await this.show(coarse);
    } catch (error) {
      if (losses !== this.losses) throw error;
      this.coarse = this.leaveOut(error);
    }
  }

  /** Why the coarse scene is shown in place of the whole one, or null. A scene without a coarse one is shown whole. */
  private get tooLarge(): string | null {
    if (!this.scene || !this.coarse) return null;
    return this.unfit ? TOO_LARGE : tooMuchFor(this.quality, this.scene.description);
  }

  private notify(reason: string | null): void {
    this.emit("notice", reason && `The scene is shown at a quarter of its resolution: ${reason}.`);
  }

  /** After a change of the quality: show the whole scene where it now fits, else the coarse one. */
  private async fit(): Promise<void> {
    const { scene, coarse, volume } = this;
    const wanted = this.tooLarge ? coarse : scene;
    if (!scene || !coarse || !volume) return;
    if (volume.source === wanted) return this.notify(this.tooLarge);
    this.whole = this.fine = false;
    this.follow();
    await this.fill(scene);
    this.follow();
  }

  /** Show a scene in place of the one before, as soon as there is something of it on the card. */
  private async show(scene: SnergScene, growth: GrowthOptions = {}): Promise<void> {
    const volume = new SnergVolume(scene, { srgbTargets: true });
    const dispose = () => volume.dispose();
    this.abort.signal.addEventListener("abort", dispose, { once: true }); // also while it is being read
    volume.addEventListener("change" as never, () => this.grow(volume));
    this.growing = volume;
    try {
      await volume.load(this.webgl, growth);
    } catch (error) {
      this.abort.signal.removeEventListener("abort", dispose);
      volume.dispose();
      throw error;
    } finally {
      if (this.growing === volume) this.growing = null;
    }
  }

  /** A volume looks different: bring it into the world, or the picture up to date. */
  private grow(volume: SnergVolume): void {
    if (this.volume !== volume) {
      this.world.remove(...(this.volume ? [this.volume] : []));
      this.volume?.dispose();
      this.volume = volume;
      this.world.add(volume);
      if (!this.renderer) this.begin(volume.source);
      else if (!this.coarse || this.whole) this.renderer.change();
    }
    const seen = this.layers?.seen ?? Number.POSITIVE_INFINITY;
    if (this.fine || volume.source !== this.scene || volume.layersArrived < seen) return void this.refine();
    this.fine = true; // all that the first camera sees is there
    this.renderer?.refine();
  }

  /** Resolves when nothing lies over the canvas any more. */
  private uncovered(): Promise<void> {
    const { covered } = this.options;
    if (!covered?.()) return Promise.resolve();
    return new Promise((resolve) => {
      const stop = this.on("image", () => {
        if (covered()) return;
        stop();
        resolve();
      });
    });
  }

  /** Bring the picture up to date, unless one is being drawn: then after it. */
  private async refine(): Promise<void> {
    this.grown = true;
    if (this.refining) return;
    this.refining = true;
    while (this.grown && !this.whole && !this.abort.signal.aborted) {
      await this.settled();
      this.grown = false;
      if (!this.options.covered?.()) this.renderer?.refine();
    }
    this.refining = false;
  }

  /** There is something to show: begin to render, and to follow the mouse. */
  private begin(scene: SnergScene): void {
    const { cameras } = this;
    const view = new View(scene.description, () => this.viewChanged(), this.options.limits);
    this.view = view;
    this.navigation = new Navigation(view, this.canvas, {
      started: () => this.stop(),
      mode: (mode) => this.emit("mode", mode),
      said: (text) => this.emit("said", text),
      pick: (at) => this.pointAt(at),
    });
    this.renderer = new ProgressiveRenderer(this.webgl, this.world, view.rendered, (image) =>
      this.emit("image", { ...image, coarse: !this.fine, whole: this.whole }),
    );
    this.renderer.background = this.colour;
    const first = Math.max(findCamera(cameras, this.options.camera ?? null), 0);
    if (cameras[first]) view.jump(cameras[first]);
    if (this.makePlayer) {
      this.path = this.makePlayer(
        (camera) => this.showPath(camera),
        () => this.pathChanged(),
      );
      if (!cameras[first]) this.path.seek(this.path.state.start);
    }
    this.observer.observe(this.container);
    this.follow();
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
    this.emit("quality", this.quality);
    this.filling = this.filling.then(() => this.fit());
    this.filling.catch((error: unknown) => this.fail(error));
  }

  /** How many images are averaged at rest. A picture of a given size is exact, unless somebody chose a quality. */
  private get samples(): number {
    return !this.whole || (this.options.size && !this.chosen) ? 1 : PRESETS[this.quality].samples;
  }

  get state(): ViewerState {
    const { view } = this;
    const path = this.path?.state ?? null;
    if (!view)
      return { camera: "", atCamera: false, cameraToWorld: rowsOf(new Matrix4()), zoom: 1, mode: this.mode, frame: [0, 0, 0, 0], path };
    return {
      camera: view.camera.name,
      atCamera: view.atCamera && !view.shared,
      cameraToWorld: rowsOf(view.pose()),
      zoom: view.zoom,
      mode: this.mode,
      frame: view.frame,
      path,
    };
  }

  on<Name extends keyof ViewerEvents>(name: Name, listener: (event: ViewerEvents[Name]) => void): () => void {
    const set = this.listeners.get(name) ?? new Set();
    this.listeners.set(name, set.add(listener));
    return () => set.delete(listener);
  }

  private emit<Name extends keyof ViewerEvents>(name: Name, event: ViewerEvents[Name]): void {
    for (const listener of this.listeners.get(name) ?? []) (listener as (event: ViewerEvents[Name]) => void)(event);
  }

  async goTo(camera?: string | number, { duration = 0 }: { duration?: number } = {}): Promise<void> {
    const { view } = this;
    if (!view) return;
    const index = camera === undefined ? -1 : typeof camera === "number" ? camera : findCamera(this.cameras, camera);
    if (camera !== undefined && !this.cameras[index]) throw new ViewerError(`There is no camera ${camera}.`);
    const target = this.cameras[index] ?? view.overview();
    this.stop();
    const flight = this.flight;
    if (duration > 0 && !wantsLessMotion() && target.projection === view.camera.projection) {
      this.flying = this.fly(target, duration, flight);
      await this.flying;
    }
    if (flight === this.flight) view.jump(target);
  }

  /** Move the view to a camera, until another flight begins. */
  private async fly(target: View["camera"], duration: number, flight: number): Promise<void> {
    const view = this.view as View;
    const from = view.current;
    const distances = [view.rig.now.distance, view.orbitDistance(target)] as const;
    const began = performance.now();
    for (let part = 0; part < 1 && flight === this.flight; ) {
      part = Math.min(((await nextFrame()) - began) / (1000 * duration), 1);
      if (flight === this.flight && part < 1) view.jump(between(from, target, eased(part), distances), true);
    }
  }

  /** End a flight, and leave the path. */
  private stop(): void {
    this.flight++;
    this.path?.leave();
  }

  play(): void {
    this.path?.play();
  }

  pause(): void {
    this.path?.pause();
  }

  private showPath(camera: PathCamera): void {
    this.flight++;
    this.view?.jump(cameraOf(camera), true);
  }

  private pathChanged(): void {
    if (this.path) this.emit("path", this.path.state);
  }

  lookFrom(cameraToWorld: number[][], zoom = 1): void {
    this.stop();
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
    await this.flying;
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
    const canvas = new OffscreenCanvas(w, h);
    const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
    const { backdrop } = this;
    context.putImageData(new ImageData(pixels, w, h), 0, 0);
    if (backdrop?.naturalWidth && !alpha) {
      context.globalCompositeOperation = "destination-over";
      drawCovering(context, backdrop);
    }
    return canvas.convertToBlob({ type: "image/png" });
  }

  pick(places: readonly [number, number][]): (ScenePoint | null)[] {
    const { view, volume } = this;
    if (!view || !volume) return places.map(() => null);
    const { clientWidth, clientHeight } = this.canvas;
    const points = places.map(([x, y]) => [(2 * x) / clientWidth - 1, 1 - (2 * y) / clientHeight] as const);
    return volume.pick(this.webgl, view.rendered, points).map((point) => {
      if (!point) return null;
      const { depth } = this.project(point.toArray());
      return { position: point.toArray(), depth, voxel: volume.voxelAt(point) };
    });
  }

  project(point: readonly number[]): ProjectedPoint {
    const camera = this.view?.rendered;
    if (!camera) return { x: 0, y: 0, depth: 0 };
    camera.updateMatrixWorld();
    const seen = new Vector3(...point).applyMatrix4(camera.matrixWorldInverse);
    const depth = -seen.z;
    const { x, y } = seen.applyMatrix4(camera.projectionMatrix);
    const { clientWidth, clientHeight } = this.canvas;
    return { x: ((x + 1) / 2) * clientWidth, y: ((1 - y) / 2) * clientHeight, depth };
  }

  async fullscreen(): Promise<void> {
    if (document.fullscreenElement) return document.exitFullscreen();
    await this.container.requestFullscreen();
  }

  lend(): Lent | null {
    const { renderer, volume } = this;
    if (!renderer || !volume || !this.whole) return null;
    this.flight++;
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
    return measure({ renderer: this.webgl, volume: this.volume as SnergVolume, cameras: this.cameras }, options);
  }

  destroy(): void {
    this.stop();
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
    if (this.view && !this.view.atCamera) this.stop(); // somebody moves it
    this.renderer?.change();
    this.emit("view", this.state);
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
    this.emit("scroll", undefined);
  }

  /** The graphics driver was reset. What is on its way to the card is given up; `fill` begins again. */
  private lose(event: Event): void {
    event.preventDefault();
    this.losses++;
    this.growing?.dispose();
    if (!this.volume || this.volume !== this.growing) return;
    this.world.remove(this.volume);
    this.volume = null;
  }

  /** Resolves when there is a graphics context again. */
  private restored(): Promise<void> {
    if (!this.webgl.getContext().isContextLost()) return Promise.resolve();
    return new Promise((resolve) => this.canvas.addEventListener("webglcontextrestored", () => resolve(), { once: true }));
  }

  /** Bring the scene to the card again, where it was there. */
  private async restore(): Promise<void> {
    if (!this.scene || !this.renderer) return;
    if (this.whole) {
      try {
        await this.show(this.volume?.source ?? this.scene);
      } catch {
        return this.fail(new ViewerError(LOST)); // the files inside a page can be read once
      }
    }
    this.renderer.restart();
  }

  private fail(error: unknown): void {
    if (this.abort.signal.aborted) return;
    if (!(error instanceof ViewerError)) console.error(error);
    this.emit("error", asViewerError(error));
  }
}

/** An error that a person can read. */
export function asViewerError(error: unknown): ViewerError {
  if (error instanceof ViewerError) return error;
  const text = error instanceof Error ? error.message : String(error);
  return new ViewerError(`The viewer failed (${text}). Reload the page, or try another browser.`);
}

/** The index of a camera by its name, or by its index as text; -1 if there is none. */
export function findCamera(cameras: readonly SnergCamera[], text: string | null): number {
  if (text === null) return -1;
  const named = cameras.findIndex((camera) => camera.name === text);
  if (named >= 0) return named;
  return /^\d+$/.test(text) && Number(text) < cameras.length ? Number(text) : -1;
}

type MakePlayer = (show: (camera: PathCamera) => void, changed: () => void) => PathPlayer;

/** What plays the camera path of a bundle. Rejects with a ViewerError where it, or the code that plays it, is missing or damaged. */
async function readPath(source: FileSource, signal: AbortSignal): Promise<MakePlayer> {
  const [{ pathOf, PathPlayer }, value] = await Promise.all([loadOptional("path"), readJson(source, "path.json", signal)]);
  const path: CameraPath | null = pathOf(value);
  if (!path) throw new ViewerError(`The file path.json is damaged: it is not a camera path. ${EXPORT_AGAIN}`);
  return (show, changed) => new PathPlayer(path, show, changed);
}

/** Without an address, the files inside the page, or else those beside it. */
const ownFiles = (): FileSource => (EmbeddedFiles.areThere() ? new EmbeddedFiles("") : new ServerFiles("."));

function makeRenderer(canvas: HTMLCanvasElement, fail: (error: ViewerError) => void): WebGLRenderer {
  const options = { alpha: true, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" } as const;
  const context = canvas.getContext("webgl2", options);
  if (!context) throw new ViewerError(NO_WEBGL);
  const renderer = new WebGLRenderer({ canvas, context: context as never });
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, _vertex, fragment) => {
    const log = gl.getShaderInfoLog(fragment) || gl.getProgramInfoLog(program) || "it gives no reason";
    const reason = log
      .replace(/[\s\0]+/g, " ")
      .trim()
      .slice(0, 300);
    if (!gl.isContextLost()) fail(new ViewerError(`The graphics driver refuses the viewer's shader: ${reason}`));
  };
  return renderer;
}

const nextFrame = (): Promise<number> => new Promise((resolve) => requestAnimationFrame(() => resolve(performance.now())));

/** A path's camera as the viewer's others are. */
function cameraOf({ position, rotation, ...rest }: PathCamera): SnergCamera {
  const [x, y, z] = position;
  const turn = new Quaternion(...(rotation as [number, number, number, number]));
  return { ...rest, cameraToWorld: new Matrix4().compose(new Vector3(x, y, z), turn.normalize(), new Vector3(1, 1, 1)) };
}
