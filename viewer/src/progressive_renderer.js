// Renders the view when it changes, and only then. A slow device (software GL) renders a draft at low resolution while the view moves,
// then the full image in bands of rows: the page stays responsive, and no draw call exceeds a driver's time limit.
import {
  BufferAttribute,
  BufferGeometry,
  GLSL3,
  LinearFilter,
  Matrix3,
  Mesh,
  NearestFilter,
  OrthographicCamera,
  RawShaderMaterial,
  Scene,
  Vector2,
  Vector3,
  Vector4,
  WebGLRenderTarget,
} from "three";
import { VERTEX_SHADER, fragmentShader } from "./shader.js";

const BUDGET = 30; // milliseconds of rendering at a time
const STILL_AFTER = 120; // milliseconds without change before the full image is begun
const MAX_DOWNSCALE = 8; // of a draft's width and height
const MIN_BAND_ROWS = 8;
const WAIT_OVERHEAD = 6; // milliseconds that waiting for the card takes by itself; not counted as rendering

const COPY_SHADER = `precision highp float;
uniform sampler2D image;
uniform vec2 size;
out vec4 colour;
void main() { colour = vec4(texture(image, gl_FragCoord.xy / size).rgb, 1.0); }
`;

export class ProgressiveRenderer {
  /**
   * textures: {rgba: [...], feature: [...], distance: [...], indirection}, a texture a page but for the last.
   * onImage({width, height, milliseconds, full}): called when a draft or a full image is on the page.
   */
  constructor(renderer, scene, textures, onImage) {
    this.renderer = renderer;
    this.gl = renderer.getContext();
    this.onImage = onImage;
    this.march = fullScreen(fragmentShader(scene, textures.distance.length), marchUniforms(scene, textures));
    this.copy = fullScreen(COPY_SHADER, { image: { value: null }, size: { value: new Vector2() } });
    this.draft = renderTarget(LinearFilter);
    this.full = renderTarget(NearestFilter);
    this.cost = null; // measured milliseconds a pixel
    this.view = null;
    this.frames = 0; // draw calls that are done
    this.changed = false;
    this.rows = 0; // of the full image that are rendered, from the top
    this.waiting = []; // resolve functions of `settled`
    this.scheduled = false;
  }

  /** The canvas's size in pixels. */
  resize(width, height) {
    if (width === this.width && height === this.height) return;
    [this.width, this.height] = [width, height];
    this.renderer.setSize(width, height, false);
    this.full.setSize(width, height);
    this.change();
  }

  /** Render a view from now on. view(width, height): the uniforms for an image of that size, see `View.uniforms`. */
  setView(view) {
    this.view = view;
    this.change();
  }

  /** Render again: the view or the background has changed. */
  change() {
    this.changed = true;
    this.changedAt = performance.now();
    this.schedule(0);
  }

  /** Resolves when the page shows the full image of the current view. */
  settled() {
    return new Promise((resolve) => {
      this.waiting.push(resolve);
      this.schedule(0);
    });
  }

  /** Call `tick` at the next animation frame, or after `delay` milliseconds if above 0. */
  schedule(delay) {
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
  tick() {
    if (!this.view || !this.width || this.gl.isContextLost()) return;
    if (this.sync && !this.finished()) return this.schedule(2);
    if (this.changed) return this.begin();
    if (this.rows < this.height) {
      const wait = this.changedAt + STILL_AFTER - performance.now();
      return this.frames > 0 && wait > 0 ? this.schedule(wait) : this.renderBand();
    }
    this.waiting.splice(0).forEach((resolve) => resolve());
  }

  /** Render the first image of a changed view: the full image if the budget allows it, else a draft. */
  begin() {
    this.changed = false;
    this.rows = 0;
    this.spent = 0;
    const affordable = this.cost === null ? 0 : BUDGET / (this.cost * this.width * this.height);
    if (affordable >= 0.8) return this.renderBand(this.height);
    // Scales are powers of the square root of 2, so that the draft's texture is seldom allocated again.
    const scale = 2 ** Math.max(-Math.log2(MAX_DOWNSCALE), Math.floor(Math.log2(affordable || 1e-9)) / 2);
    const size = [Math.max(1, Math.round(this.width * scale)), Math.max(1, Math.round(this.height * scale))];
    if (this.draft.width !== size[0] || this.draft.height !== size[1]) this.draft.setSize(...size);
    this.draw(this.draft, 0, size[1]);
    this.show(this.draft, 0, this.height);
  }

  /** Render the next rows of the full image, at most `maxRows`: by default as many as the budget allows. */
  renderBand(maxRows = Math.floor(BUDGET / (this.cost * this.width))) {
    const rows = Math.min(this.height - this.rows, Math.max(MIN_BAND_ROWS, maxRows));
    this.draw(this.full, this.rows, rows);
    if (this.rows > 0 || rows < this.height) this.show(this.draft, this.rows + rows, this.height - this.rows - rows);
    this.rows += rows;
    this.show(this.full, 0, this.rows);
  }

  /** March the rays of `rows` rows of a render target, from row `top`, counted from the image's top edge. */
  draw(target, top, rows) {
    this.setUniforms(this.view(target.width, target.height));
    target.scissorTest = true;
    target.scissor.set(0, target.height - top - rows, target.width, rows);
    this.renderer.setRenderTarget(target);
    this.renderer.render(this.march.scene, CAMERA);
    this.renderer.setRenderTarget(null);
    const { width, height } = target;
    this.drawn = { pixels: width * rows, since: performance.now(), full: target === this.full, width, height };
    this.sync = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.schedule(2);
  }

  /**
   * Copy rows of a render target to the canvas, stretched to its size. The canvas is cleared between animation frames, so that every
   * frame copies all rows.
   */
  show(target, top, rows) {
    if (rows <= 0) return;
    const { uniforms } = this.copy.material;
    uniforms.image.value = target.texture;
    uniforms.size.value.set(this.width, this.height);
    this.renderer.setScissorTest(true);
    this.renderer.setScissor(new Vector4(0, this.height - top - rows, this.width, rows));
    this.renderer.render(this.copy.scene, CAMERA);
    this.renderer.setScissorTest(false);
  }

  /** Whether the card has done the last draw call. If so, update the measured cost a pixel and report the image. */
  finished() {
    const status = this.gl.clientWaitSync(this.sync, 0, 0);
    if (status === this.gl.TIMEOUT_EXPIRED) return false;
    this.gl.deleteSync(this.sync);
    this.sync = null;
    const { pixels, since, full, width, height } = this.drawn;
    const elapsed = performance.now() - since;
    this.spent += elapsed;
    const cost = Math.max(elapsed - WAIT_OVERHEAD, 0.2) / pixels;
    this.cost = this.cost === null || cost < this.cost ? cost : 0.5 * (this.cost + cost);
    this.frames++;
    const whole = full && this.rows >= this.height;
    if (!full || whole) this.onImage({ width, height, milliseconds: full ? this.spent : elapsed, full });
    this.schedule(0);
    return true;
  }

  /** Set the uniforms of march.glsl that follow the camera, as `View.uniforms` returns them. */
  setUniforms(values) {
    const { uniforms } = this.march.material;
    uniforms.focal.value.set(...values.focal);
    uniforms.principalPoint.value.set(...values.principalPoint);
    uniforms.imageHeight.value = values.imageHeight;
    uniforms.orthographic.value = values.orthographic;
    uniforms.cameraPosition.value.copy(values.cameraPosition);
    uniforms.raySpaceFromCamera.value.setFromMatrix4(values.raySpaceFromCamera);
    uniforms.networkFromCamera.value.setFromMatrix4(values.networkFromCamera);
    uniforms.nearDistance.value = values.nearDistance;
    uniforms.clipPlanes.value.set(...values.clipPlanes);
    uniforms.background.value.set(...values.background);
  }
}

const CAMERA = new OrthographicCamera(); // three wants one; the vertex shader does not use it

/** The uniforms of march.glsl: a scene's own, and those that `setUniforms` sets. */
function marchUniforms(scene, textures) {
  const uniforms = {
    focal: { value: new Vector2() },
    principalPoint: { value: new Vector2() },
    imageHeight: { value: 1 },
    orthographic: { value: false },
    cameraPosition: { value: new Vector3() },
    raySpaceFromCamera: { value: new Matrix3() },
    networkFromCamera: { value: new Matrix3() },
    nearDistance: { value: 0 },
    clipPlanes: { value: new Vector2() },
    gridShape: { value: new Vector3(...scene.shape) },
    gridBlocks: { value: new Vector3(...scene.blocks) },
    background: { value: new Vector3(1, 1, 1) },
    indirection: { value: textures.indirection },
  };
  for (const kind of ["rgba", "feature", "distance"]) {
    (textures[kind] ?? []).forEach((texture, i) => (uniforms[`${kind}_${i}`] = { value: texture }));
  }
  return uniforms;
}

/** A triangle that covers the image, with a fragment shader. */
function fullScreen(fragment, uniforms) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  const material = new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: VERTEX_SHADER,
    fragmentShader: fragment,
    uniforms,
    depthTest: false,
    depthWrite: false,
  });
  const mesh = new Mesh(geometry, material);
  mesh.frustumCulled = false;
  const scene = new Scene();
  scene.add(mesh);
  return { scene, material };
}

function renderTarget(filter) {
  return new WebGLRenderTarget(1, 1, { depthBuffer: false, generateMipmaps: false, minFilter: filter, magFilter: filter });
}
