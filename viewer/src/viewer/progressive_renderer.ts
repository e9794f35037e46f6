// Renders a scene of three.js when it changes, and only then. A slow device (software GL) renders a draft at low resolution while the view
// moves, then the full image in bands of rows: the page stays responsive, and no draw call exceeds a driver's time limit. At rest it may
// average a few more images, which smooths edges, and then stops.
import {
  AddEquation,
  type Camera,
  CustomBlending,
  GLSL3,
  LinearFilter,
  Mesh,
  NearestFilter,
  NoBlending,
  OneFactor,
  OrthographicCamera,
  RawShaderMaterial,
  Scene,
  type TextureFilter,
  Vector2,
  Vector4,
  type WebGLRenderer,
  WebGLRenderTarget,
} from "three";
import { COVERING_VERTEX_SHADER, coveringTriangle } from "../volume/full_screen";
import { DraftResolution } from "./draft_resolution";
import { Accumulation, jitterOf, withJitter } from "./smoothing";

const BUDGET = 30; // milliseconds of rendering at a time
const STILL_AFTER = 120; // milliseconds without change before the full image is begun
const MIN_BAND_ROWS = 8;
const WAIT_OVERHEAD = 6; // milliseconds that waiting for the card takes by itself; not counted as rendering

const COPY_SHADER = `precision highp float;
uniform highp sampler2D image; // an average has more than 8 bits; without a word it would be lowp
uniform vec2 size;
uniform float weight;
out vec4 colour;
void main() { colour = weight * texture(image, gl_FragCoord.xy / size); }
`;
const CAMERA = new OrthographicCamera(); // three wants one; the vertex shader does not use it

/** An image that is on the page. */
export interface ShownImage {
  width: number; // pixels
  height: number;
  milliseconds: number; // that it took to render
  full: boolean; // else it is a draft
  samples: number; // images of which it is the average; 1: each pixel is the ray through its centre
}

/** Red, green, blue and alpha in [0, 1], sRGB, not premultiplied. */
export type Colour = [number, number, number, number];

export class ProgressiveRenderer {
  frames = 0; // draw calls that are done
  background: Colour = [1, 1, 1, 1];
  private readonly gl: WebGL2RenderingContext;
  private readonly copy: FullScreen<{ image: { value: unknown }; size: { value: Vector2 }; weight: { value: number } }>;
  private readonly draft = renderTarget(LinearFilter);
  private readonly full = renderTarget(NearestFilter);
  private readonly average: Accumulation;
  private readonly resolution = new DraftResolution();
  private most = 1; // images that are averaged
  private readonly image: Vector2 = new Vector2(0, 0); // the canvas's size in pixels
  private cost: number | null = null; // measured milliseconds a pixel
  private changed = false;
  private changedAt = 0;
  private rows = 0; // of the full image that are rendered, from the top
  private under = this.draft; // what the other rows show
  private spent = 0; // milliseconds on the full image so far
  private sync: WebGLSync | null = null;
  private drawn = { pixels: 1, since: 0, target: this.draft };
  private waiting: (() => void)[] = []; // resolve functions of `settled`
  private scheduled = false;
  private timer = 0; // of a `tick` that is to come after a delay; 0 where it comes with the next animation frame
  private stopped = false;
  private paused = false;

  /** onImage: called when a draft or a full image is on the page. The camera's projection holds for an image of any size. */
  constructor(
    private readonly renderer: WebGLRenderer,
    private readonly scene: Scene,
    private readonly camera: Camera,
    private readonly onImage: (image: ShownImage) => void,
  ) {
    this.gl = renderer.getContext() as WebGL2RenderingContext;
    this.copy = fullScreen(COPY_SHADER, { image: { value: null }, size: { value: new Vector2() }, weight: { value: 1 } });
    this.average = new Accumulation(this.gl);
  }

  /** The canvas's size in pixels. */
  resize(width: number, height: number): void {
    if (width === this.image.x && height === this.image.y) return;
    this.image.set(width, height);
    this.renderer.setSize(width, height, false);
    this.full.setSize(width, height);
    this.change();
  }

  /** How many images to average when nothing moves, at most; 1 for the ray through each pixel's centre alone. */
  get samples(): number {
    return this.most;
  }

  set samples(most: number) {
    if (most === this.most) return;
    this.most = most;
    if (this.average.count) this.change();
    else this.schedule(0);
  }

  /** Render again: the view, the scene or the background has changed. */
  change(): void {
    this.changed = true;
    this.changedAt = performance.now();
    this.schedule(0);
  }

  /** Render the full image again in place of the one that is shown: the scene is finer, the view is the same. */
  refine(): void {
    if (!this.frames || this.changed) return this.change();
    if (this.rows >= this.image.y) this.under = this.full;
    this.rows = 0;
    this.spent = 0;
    this.average.reset();
    this.schedule(0);
  }

  /** Resolves when the page shows the full image of the current view, with smooth edges where they are wanted and the device affords them. */
  settled(): Promise<void> {
    return new Promise((resolve) => {
      this.waiting.push(resolve);
      this.schedule(0);
    });
  }

  /** The context was restored: what was on the card is lost. */
  restart(): void {
    this.sync = null;
    this.change();
  }

  /** Leave the canvas to somebody else, or take it back and render anew. */
  pause(paused: boolean): void {
    this.paused = paused;
    if (!paused) this.restart();
  }

  dispose(): void {
    this.stopped = true;
    for (const target of [this.draft, this.full, this.average]) target.dispose();
  }

  /** The whole image at any size, as its pixels from the top left corner: red, green, blue and alpha, not premultiplied. */
  capture(width: number, height: number, background: Colour): Uint8ClampedArray<ArrayBuffer> {
    const target = renderTarget(NearestFilter);
    target.setSize(width, height);
    this.render(target, 0, height, background);
    const bottomUp = new Uint8Array(4 * width * height);
    this.renderer.readRenderTargetPixels(target, 0, 0, width, height, bottomUp);
    target.dispose();
    const pixels = new Uint8ClampedArray(bottomUp.length);
    for (let row = 0; row < height; row++)
      pixels.set(bottomUp.subarray(4 * width * row, 4 * width * (row + 1)), 4 * width * (height - 1 - row));
    for (let i = 0; i < pixels.length; i += 4) {
      const alpha = pixels[i + 3];
      if (alpha > 0 && alpha < 255) for (let j = i; j < i + 3; j++) pixels[j] = (pixels[j] * 255) / alpha;
    }
    return pixels;
  }

  /** Call `tick` at the next animation frame, or after `delay` milliseconds if above 0. An animation frame takes the place of a delay. */
  private schedule(delay: number): void {
    if (this.scheduled && (delay > 0 || !this.timer)) return;
    clearTimeout(this.timer);
    this.timer = 0;
    this.scheduled = true;
    const run = () => {
      this.scheduled = false;
      this.timer = 0;
      this.tick();
    };
    if (delay > 0) this.timer = window.setTimeout(run, delay);
    else requestAnimationFrame(run);
  }

  /** Do what is due next: wait for the card, begin a changed view, render the next band, or tell who waits in `settled`. */
  private tick(): void {
    if (this.stopped || this.paused || !this.image.x || this.gl.isContextLost()) return;
    if (this.sync && !this.finished(this.sync)) return this.schedule(2);
    if (this.changed) return this.begin();
    const wait = this.changedAt + STILL_AFTER - performance.now();
    const whole = this.rows >= this.image.y;
    if (!whole || !this.average.done(this.most)) {
      if (this.frames > 0 && wait > 0) return this.schedule(wait);
      return whole ? this.smooth() : this.renderBand();
    }
    for (const resolve of this.waiting.splice(0)) resolve();
  }

  /** Render the first image of a changed view: the full image if the budget allows it, else a draft. */
  private begin(): void {
    const [width, height] = this.image;
    this.changed = false;
    this.under = this.draft;
    this.rows = 0;
    this.spent = 0;
    this.average.reset();
    const scale = this.resolution.next(this.cost, width * height);
    if (scale === 1) return this.renderBand(height);
    const [w, h] = [Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))];
    if (this.draft.width !== w || this.draft.height !== h) this.draft.setSize(w, h);
    this.draw(this.draft, 0, h);
    this.show(this.draft, 0, height);
  }

  /** Render the next rows of the full image, at most `maxRows`: by default as many as the budget allows. */
  private renderBand(maxRows?: number): void {
    const height = this.image.y;
    const rows = this.bandAfter(this.rows, maxRows);
    this.draw(this.full, this.rows, rows);
    if (this.rows > 0 || rows < height) this.show(this.under, this.rows + rows, height - this.rows - rows);
    this.rows += rows;
    this.show(this.full, 0, this.rows);
  }

  /** How many rows to render after the first `done` ones: as many as the budget allows, or at most `maxRows`. */
  private bandAfter(done: number, maxRows = Math.floor(BUDGET / ((this.cost as number) * this.image.x))): number {
    return Math.min(this.image.y - done, Math.max(MIN_BAND_ROWS, maxRows));
  }

  /** Render the next rows of the next image of the average. The page shows the average when it has all images: it changes once. */
  private smooth(): void {
    const { average } = this;
    const [width, height] = this.image;
    if (!average.count) {
      average.begin(this.most, this.spent, width, height);
      return this.schedule(0);
    }
    const rows = this.bandAfter(average.rows);
    const jitter = jitterOf(average.taken, average.count);
    withJitter(this.camera, jitter, width, height, () => this.draw(average.sample, average.rows, rows));
    average.rows += rows;
    if (average.rows < height) return;
    this.add(average.sample, average.sum, 1 / average.count, average.taken === 0);
    average.rows = 0;
    average.taken++;
  }

  /** Add a weight times a target to another of the same size, or put it in its place. */
  private add(from: WebGLRenderTarget, to: WebGLRenderTarget, weight: number, replace: boolean): void {
    const { scene, material, uniforms } = this.copy;
    uniforms.image.value = from.texture;
    uniforms.size.value.set(to.width, to.height);
    uniforms.weight.value = weight;
    material.blending = replace ? NoBlending : CustomBlending;
    this.renderer.setRenderTarget(to);
    this.renderer.render(scene, CAMERA);
    this.renderer.setRenderTarget(null);
    uniforms.weight.value = 1;
    material.blending = NoBlending;
  }

  /** Render rows of a target, and ask the card to tell when it is done. */
  private draw(target: WebGLRenderTarget, top: number, rows: number): void {
    this.render(target, top, rows, this.background);
    this.drawn = { pixels: target.width * rows, since: performance.now(), target };
    this.sync = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.schedule(2);
  }

  /** Render `rows` rows of a render target, from row `top`, counted from the image's top edge. */
  private render(target: WebGLRenderTarget, top: number, rows: number, [red, green, blue, alpha]: Colour): void {
    target.scissorTest = true;
    target.scissor.set(0, target.height - top - rows, target.width, rows);
    this.renderer.setRenderTarget(target);
    this.renderer.state.buffers.color.setClear(red, green, blue, alpha, true);
    this.gl.clear(this.gl.COLOR_BUFFER_BIT);
    this.renderer.render(this.scene, this.camera);
    this.renderer.setRenderTarget(null);
  }

  /**
   * Copy rows of a render target to the canvas, stretched to its size. The canvas is cleared between animation frames, so that every
   * frame that changes rows copies all of them.
   */
  private show(target: WebGLRenderTarget, top: number, rows: number): void {
    if (rows <= 0) return;
    const [width, height] = this.image;
    this.copy.uniforms.image.value = target.texture;
    this.copy.uniforms.size.value.set(width, height);
    this.renderer.setScissorTest(true);
    this.renderer.setScissor(new Vector4(0, height - top - rows, width, rows));
    this.renderer.render(this.copy.scene, CAMERA);
    this.renderer.setScissorTest(false);
  }

  /** Whether the card has done the last draw call. If so, update the measured cost a pixel and report the image. */
  private finished(sync: WebGLSync): boolean {
    if (this.gl.clientWaitSync(sync, 0, 0) === this.gl.TIMEOUT_EXPIRED) return false;
    this.gl.deleteSync(sync);
    this.sync = null;
    const { pixels, since, target } = this.drawn;
    const elapsed = performance.now() - since;
    this.spent += elapsed;
    const cost = Math.max(elapsed - WAIT_OVERHEAD, 0.2) / pixels;
    this.cost = this.cost === null || cost < this.cost ? cost : 0.5 * (this.cost + cost);
    this.frames++;
    this.report(target, elapsed);
    this.schedule(0);
    return true;
  }

  /** Tell which image is on the page, now that a draw call to a target is done, and show an average that has all its images. */
  private report(target: WebGLRenderTarget, elapsed: number): void {
    const { average } = this;
    const { width, height } = target;
    if (target === this.draft) return this.onImage({ width, height, milliseconds: elapsed, full: false, samples: 1 });
    if (target === this.full ? this.rows < height : average.taken < average.count) return;
    const samples = target === this.full ? 1 : average.count;
    if (samples > 1) this.show(average.sum, 0, height);
    this.onImage({ width, height, milliseconds: this.spent, full: true, samples });
  }
}

interface FullScreen<T> {
  scene: Scene;
  material: RawShaderMaterial;
  uniforms: T;
}

/** A triangle that covers the image, with a fragment shader. Where its material blends, it adds. */
function fullScreen<T extends Record<string, { value: unknown }>>(fragmentShader: string, uniforms: T): FullScreen<T> {
  const settings = { glslVersion: GLSL3, vertexShader: COVERING_VERTEX_SHADER, depthTest: false, depthWrite: false } as const;
  const adding = { blending: NoBlending, blendEquation: AddEquation, blendSrc: OneFactor, blendDst: OneFactor } as const;
  const material = new RawShaderMaterial({ ...settings, ...adding, fragmentShader, uniforms });
  const mesh = new Mesh(coveringTriangle(), material);
  mesh.frustumCulled = false;
  const scene = new Scene();
  scene.add(mesh);
  return { scene, material, uniforms };
}

function renderTarget(filter: TextureFilter): WebGLRenderTarget {
  return new WebGLRenderTarget(1, 1, { depthBuffer: false, generateMipmaps: false, minFilter: filter, magFilter: filter as never });
}
