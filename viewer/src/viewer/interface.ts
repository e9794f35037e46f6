// What a viewer is to those who use it: its options, its events, and what it can do.
import type { WebGLRenderer } from "three";
import type { PartName, SnergCamera, WorldUnits } from "../data/cameras";
import type { FileSource } from "../data/files";
import type { LoadProgress } from "../data/snerg_scene";
import type { ViewerError } from "../errors";
import type { BenchmarkOptions, BenchmarkResult } from "../optional/benchmark";
import type { PathPlayer, PathState } from "../optional/path";
import type { SnergVolume } from "../volume/volume";
import type { Mode } from "./navigation";
import type { Colour, ShownImage } from "./progressive_renderer";
import type { QualityName } from "./quality";
import type { OrbitLimits } from "./rig";

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
