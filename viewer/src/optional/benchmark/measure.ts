// The paper's benchmark in the page: mean time of 150 frames, graphics memory, and megabytes of files.
import { type WebGLRenderer, WebGLRenderTarget } from "three";
import type { SnergCamera } from "../../data/cameras";
import { ViewerError } from "../../errors";
import type { SnergVolume } from "../../volume/volume";
import { type BenchmarkKind, FRAMES, frameCamera, KINDS, kindOf } from "./path";

const WARM_UP = 1; // frames before the first one that counts: compiles the shader, fills caches
const TURN = 40; // milliseconds of rendering at most, where a frame allows it, until the page may do something else
const BYTES_A_PIXEL = 4; // of the image

/** What is measured: a volume that is on the card. */
export interface BenchmarkSubject {
  renderer: WebGLRenderer;
  volume: SnergVolume;
  cameras: readonly SnergCamera[];
}

export interface BenchmarkOptions {
  kind?: BenchmarkKind; // otherwise from the scene
  frames?: number; // on the whole path; the paper's 150 without it
  onProgress?: (frames: number, total: number) => void;
  signal?: AbortSignal;
}

/** What `snerg study --benchmark` reads, too. */
export interface BenchmarkResult {
  format: "snerg-benchmark";
  version: 1;
  title: string; // of the page
  kind: BenchmarkKind;
  width: number; // pixels
  height: number;
  field_of_view: number; // horizontal, degrees
  frames: number;
  ms: number; // mean time of a frame
  fps: number;
  memory_megabytes: number; // of graphics memory: all textures of the scene, and the image
  megabytes: number; // of the scene's files, as they were read
  voxels: [number, number, number];
  cells: number;
  codec: string;
  view_dependent: boolean;
  graphics: string; // the graphics card as the browser names it
  browser: string;
}

/** Render the benchmark's frames and measure them. Rejects with the signal's reason, or with a ViewerError when the context is lost. */
export async function measure(subject: BenchmarkSubject, options: BenchmarkOptions = {}): Promise<BenchmarkResult> {
  const scene = subject.volume.source.description;
  const kind = options.kind ?? kindOf(scene, subject.cameras);
  const frames = Math.max(1, Math.min(Math.floor(options.frames ?? FRAMES) || FRAMES, FRAMES));
  const { width, height, fieldOfView } = KINDS[kind];
  const target = new WebGLRenderTarget(width, height, { depthBuffer: false, generateMipmaps: false });
  try {
    const seconds = await renderFrames(subject, kind, frames, target, options);
    const ms = (1000 * seconds) / frames;
    return {
      format: "snerg-benchmark",
      version: 1,
      title: document.title,
      kind,
      width,
      height,
      field_of_view: fieldOfView,
      frames,
      ms,
      fps: 1000 / ms,
      memory_megabytes: (subject.volume.graphicsBytes + width * height * BYTES_A_PIXEL) / 1e6,
      megabytes: subject.volume.source.bytesRead / 1e6,
      voxels: scene.shape,
      cells: scene.cells,
      codec: scene.codec.name,
      view_dependent: scene.network !== null,
      graphics: graphicsOf(subject.renderer),
      browser: navigator.userAgent,
    };
  } finally {
    target.dispose();
  }
}

/** The seconds that the frames take, without those that the page has in between. */
async function renderFrames(
  { renderer, volume, cameras }: BenchmarkSubject,
  kind: BenchmarkKind,
  frames: number,
  target: WebGLRenderTarget,
  { onProgress, signal }: BenchmarkOptions,
): Promise<number> {
  const scene = volume.source.description;
  const world = volume.parent ?? volume;
  const pixel = new Uint8Array(4);
  let [milliseconds, began, batch, drawn] = [0, 0, 1, 0]; // batch: frames until the card is waited for
  for (let frame = -WARM_UP; frame < frames; frame++) {
    signal?.throwIfAborted();
    if (renderer.getContext().isContextLost()) throw new ViewerError("The graphics driver was reset during the benchmark. Begin it again.");
    if (frame === 0) began = performance.now();
    renderer.setRenderTarget(target);
    renderer.setClearColor(0xffffff, 1);
    renderer.clear();
    renderer.render(world, frameCamera(scene, cameras, kind, Math.max(frame, 0) / frames));
    renderer.setRenderTarget(null);
    if (frame >= 0 && frame < frames - 1 && ++drawn < batch) continue;
    renderer.readRenderTargetPixels(target, 0, 0, 1, 1, pixel); // waits for the card
    if (frame < 0) continue;
    const elapsed = performance.now() - began;
    milliseconds += elapsed;
    if (elapsed < TURN / 2) batch *= 2;
    drawn = 0;
    onProgress?.(frame + 1, frames);
    await new Promise((resolve) => setTimeout(resolve));
    began = performance.now();
  }
  return milliseconds / 1000;
}

function graphicsOf(renderer: WebGLRenderer): string {
  const gl = renderer.getContext();
  const named = gl.getExtension("WEBGL_debug_renderer_info");
  return String(gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
}
