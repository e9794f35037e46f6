// Renders a scene of three.js when it changes, and only then. A slow device (software GL) renders a draft at low resolution while the view
// moves, then the full image in bands of rows: the page stays responsive, and no draw call exceeds a driver's time limit.
import {
  type Camera,
  GLSL3,
  LinearFilter,
  Mesh,
  NearestFilter,
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

const BUDGET = 30; // milliseconds of rendering at a time
const STILL_AFTER = 120; // milliseconds without change before the full image is begun
const MAX_DOWNSCALE = 8; // of a draft's width and height
const MIN_BAND_ROWS = 8;
const WAIT_OVERHEAD = 6; // milliseconds that waiting for the card takes by itself; not counted as rendering

const COPY_SHADER = `precision highp float;
uniform sampler2D image;
uniform vec2 size;
out vec4 colour;
void main() { colour = texture(image, gl_FragCoord.xy / size); }
`;
const CAMERA = new OrthographicCamera(); // three wants one; the vertex shader does not use it

/** An image that is on the page. */
export interface ShownImage {
  width: number; // pixels
  height: number;
  milliseconds: number; // that it took to render
  full: boolean; // else it is a draft
}

/** Red, green, blue and alpha in [0, 1], sRGB, not premultiplied. */
export type Colour = [number, number, number, number];

export class ProgressiveRenderer {
  frames = 0; // draw calls that are done
  background: Colour = [1, 1, 1, 1];
  private readonly gl: WebGL2RenderingContext;
  private readonly copy: { scene: Scene; uniforms: { image: { value: unknown }; size: { value: Vector2 } } };
  private readonly draft = renderTarget(LinearFilter);
  private readonly full = renderTarget(NearestFilter);
  private readonly image: Vector2 = new Vector2(0, 0); // the canvas's size in pixels
  private cost: number | null = null; // measured milliseconds a pixel
  private changed = false;
  private changedAt = 0;
  private rows = 0; // of the full image that are rendered, from the top
  private under = this.draft; // what the other rows show
  private spent = 0; // milliseconds on the full image so far
  private sync: WebGLSync | null = null;
  private drawn = { pixels: 1, since: 0, full: false, width: 0, height: 0 };
  private waiting: (() => void)[] = []; // resolve functions of `settled`
  private scheduled = false;
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
    this.copy = fullScreen(COPY_SHADER, { image: { value: null }, size: { value: new Vector2() } });
  }

  /** The canvas's size in pixels. */
  resize(width: number, height: number): void {
    if (width === this.image.x && height === this.image.y) return;
    this.image.set(width, height);
    this.renderer.setSize(width, height, false);
    this.full.setSize(width, height);
    this.change();
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
    this.schedule(0);
  }

  /** Resolves when the page shows the full image of the current view. */
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
    this.draft.dispose();
    this.full.dispose();
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

  /** Call `tick` at the next animation frame, or after `delay` milliseconds if above 0. */
  private schedule(delay: number): void {
    if (this.scheduled) return;
    this.scheduled = true;
    const run = () => {
      this.scheduled = false;
      this.tick();
    };
    if (delay > 0) setTimeout(run, delay);
    else requestAnimationFrame(run);
  }

  /** Do what is due next: wait for the card, begin a changed view, render the next band, or tell who waits in `settled`. */
  private tick(): void {
    if (this.stopped || this.paused || !this.image.x || this.gl.isContextLost()) return;
    if (this.sync && !this.finished(this.sync)) return this.schedule(2);
    if (this.changed) return this.begin();
    if (this.rows < this.image.y) {
      const wait = this.changedAt + STILL_AFTER - performance.now();
      return this.frames > 0 && wait > 0 ? this.schedule(wait) : this.renderBand();
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
    const affordable = this.cost === null ? 0 : BUDGET / (this.cost * width * height);
    if (affordable >= 0.8) return this.renderBand(height);
    // Scales are powers of the square root of 2, so that the draft's texture is seldom allocated again.
    const scale = 2 ** Math.max(-Math.log2(MAX_DOWNSCALE), Math.floor(Math.log2(affordable || 1e-9)) / 2);
    const [w, h] = [Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))];
    if (this.draft.width !== w || this.draft.height !== h) this.draft.setSize(w, h);
    this.draw(this.draft, 0, h);
    this.show(this.draft, 0, height);
  }

  /** Render the next rows of the full image, at most `maxRows`: by default as many as the budget allows. */
  private renderBand(maxRows = Math.floor(BUDGET / ((this.cost as number) * this.image.x))): void {
    const height = this.image.y;
    const rows = Math.min(height - this.rows, Math.max(MIN_BAND_ROWS, maxRows));
    this.draw(this.full, this.rows, rows);
    if (this.rows > 0 || rows < height) this.show(this.under, this.rows + rows, height - this.rows - rows);
    this.rows += rows;
    this.show(this.full, 0, this.rows);
  }

  /** Render rows of a target, and ask the card to tell when it is done. */
  private draw(target: WebGLRenderTarget, top: number, rows: number): void {
    this.render(target, top, rows, this.background);
    const { width, height } = target;
    this.drawn = { pixels: width * rows, since: performance.now(), full: target === this.full, width, height };
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
    const { pixels, since, full, width, height } = this.drawn;
    const elapsed = performance.now() - since;
    this.spent += elapsed;
    const cost = Math.max(elapsed - WAIT_OVERHEAD, 0.2) / pixels;
    this.cost = this.cost === null || cost < this.cost ? cost : 0.5 * (this.cost + cost);
    this.frames++;
    const whole = full && this.rows >= this.image.y;
    if (!full || whole) this.onImage({ width, height, milliseconds: full ? this.spent : elapsed, full });
    this.schedule(0);
    return true;
  }
}

/** A triangle that covers the image, with a fragment shader. */
function fullScreen<T extends Record<string, { value: unknown }>>(fragmentShader: string, uniforms: T): { scene: Scene; uniforms: T } {
  const settings = { glslVersion: GLSL3, vertexShader: COVERING_VERTEX_SHADER, depthTest: false, depthWrite: false } as const;
  const mesh = new Mesh(coveringTriangle(), new RawShaderMaterial({ ...settings, fragmentShader, uniforms }));
  mesh.frustumCulled = false;
  const scene = new Scene();
  scene.add(mesh);
  return { scene, uniforms };
}

function renderTarget(filter: TextureFilter): WebGLRenderTarget {
  return new WebGLRenderTarget(1, 1, { depthBuffer: false, generateMipmaps: false, minFilter: filter, magFilter: filter as never });
}
