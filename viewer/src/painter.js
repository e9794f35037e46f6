// Pictures on demand: nothing is drawn while nothing changes. A slow device (software GL) draws a coarse picture first and while
// the view moves, then the full one in bands, so that the page answers all the time and no draw call meets a driver's time limit.
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

const BUDGET = 30; // milliseconds of drawing at a time
const SETTLE = 120; // milliseconds without change after which a view counts as still
const COARSEST = 8;

const COPY = `precision highp float;
uniform sampler2D picture;
uniform vec2 size;
out vec4 colour;
void main() { colour = vec4(texture(picture, gl_FragCoord.xy / size).rgb, 1.0); }
`;

export class Painter {
  /** textures: {rgba: [...], feature: [...], skip: [...], indirection}; `onPicture({width, height, milliseconds, full})`. */
  constructor(renderer, scene, textures, onPicture) {
    this.renderer = renderer;
    this.gl = renderer.getContext();
    this.onPicture = onPicture;
    this.march = quad(fragmentShader(scene, textures.skip.length), marchUniforms(scene, textures));
    this.copy = quad(COPY, { picture: { value: null }, size: { value: new Vector2() } });
    this.draft = target(LinearFilter);
    this.full = target(NearestFilter);
    this.cost = null; // milliseconds a pixel, as measured
    this.view = null;
    this.frames = 0;
    this.changed = false;
    this.rows = 0; // of the full picture that are done, from the top
    this.waiting = [];
    this.scheduled = false;
  }

  resize(width, height) {
    if (width === this.width && height === this.height) return;
    [this.width, this.height] = [width, height];
    this.renderer.setSize(width, height, false);
    this.full.setSize(width, height);
    this.change();
  }

  /** view: what `View.uniforms` gives for a width of 1: a function of the size of the picture. */
  paint(view) {
    this.view = view;
    this.change();
  }

  change() {
    this.changed = true;
    this.moved = performance.now();
    this.schedule(0);
  }

  /** Resolves when the picture on the page is the full one of the view as it is. */
  settled() {
    return new Promise((resolve) => {
      this.waiting.push(resolve);
      this.schedule(0);
    });
  }

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

  tick() {
    if (!this.view || !this.width || this.gl.isContextLost()) return;
    if (this.sync && !this.finished()) return this.schedule(2);
    if (this.changed) return this.begin();
    if (this.rows < this.height) {
      const rest = this.moved + SETTLE - performance.now();
      return this.frames > 0 && rest > 0 ? this.schedule(rest) : this.band();
    }
    this.waiting.splice(0).forEach((resolve) => resolve());
  }

  /** The first picture of a view: the full one where that is quick, else a coarse one. */
  begin() {
    this.changed = false;
    this.rows = 0;
    this.spent = 0;
    const affordable = this.cost === null ? 0 : BUDGET / (this.cost * this.width * this.height);
    if (affordable >= 0.8) return this.band(this.height);
    // Sizes come in steps, so that the target is seldom made anew.
    const scale = 2 ** Math.max(-Math.log2(COARSEST), Math.floor(Math.log2(affordable || 1e-9)) / 2);
    const size = [Math.max(1, Math.round(this.width * scale)), Math.max(1, Math.round(this.height * scale))];
    if (this.draft.width !== size[0] || this.draft.height !== size[1]) this.draft.setSize(...size);
    this.draw(this.draft, 0, size[1]);
    this.show(this.draft, 0, this.height);
  }

  /** The next rows of the full picture. */
  band(most = Math.floor(BUDGET / (this.cost * this.width))) {
    const rows = Math.min(this.height - this.rows, Math.max(8, most));
    this.draw(this.full, this.rows, rows);
    if (this.rows > 0 || rows < this.height) this.show(this.draft, this.rows + rows, this.height - this.rows - rows);
    this.rows += rows;
    this.show(this.full, 0, this.rows);
  }

  /** March the pixels of `rows` rows from `top` (counted from the picture's top edge). */
  draw(into, top, rows) {
    this.set(this.view(into.width, into.height));
    into.scissorTest = true;
    into.scissor.set(0, into.height - top - rows, into.width, rows);
    this.renderer.setRenderTarget(into);
    this.renderer.render(this.march.scene, CAMERA);
    this.renderer.setRenderTarget(null);
    this.drawn = { pixels: into.width * rows, since: performance.now(), full: into === this.full, width: into.width, height: into.height };
    this.sync = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.schedule(2);
  }

  /** Copy rows of a target, stretched to the page's size, to the page. The canvas forgets between pictures, so all rows are shown. */
  show(from, top, rows) {
    if (rows <= 0) return;
    const { uniforms } = this.copy.material;
    uniforms.picture.value = from.texture;
    uniforms.size.value.set(this.width, this.height);
    this.renderer.setScissorTest(true);
    this.renderer.setScissor(new Vector4(0, this.height - top - rows, this.width, rows));
    this.renderer.render(this.copy.scene, CAMERA);
    this.renderer.setScissorTest(false);
  }

  /** Whether the card is done with what was last drawn; if so, what that cost is learnt. */
  finished() {
    const status = this.gl.clientWaitSync(this.sync, 0, 0);
    if (status === this.gl.TIMEOUT_EXPIRED) return false;
    this.gl.deleteSync(this.sync);
    this.sync = null;
    const { pixels, since, full, width, height } = this.drawn;
    const elapsed = performance.now() - since;
    this.spent += elapsed;
    // Waiting takes some milliseconds of its own, which a small picture must not be blamed for.
    const cost = Math.max(elapsed - 6, 0.2) / pixels;
    this.cost = this.cost === null || cost < this.cost ? cost : 0.5 * (this.cost + cost);
    this.frames++;
    const whole = full && this.rows >= this.height;
    if (!full || whole) this.onPicture({ width, height, milliseconds: full ? this.spent : elapsed, full });
    this.schedule(0);
    return true;
  }

  set({ focal, centre, height, parallel, eye, axesFromCamera, viewFromCamera, near, background }) {
    const { uniforms } = this.march.material;
    uniforms.focal.value.set(...focal);
    uniforms.centre.value.set(...centre);
    uniforms.height.value = height;
    uniforms.parallel.value = parallel;
    uniforms.eye.value.set(...eye);
    uniforms.axesFromCamera.value.set(...axesFromCamera.flat());
    uniforms.viewFromCamera.value.set(...viewFromCamera.flat());
    uniforms.near.value = near;
    uniforms.background.value.set(...background);
  }
}

const CAMERA = new OrthographicCamera();

function marchUniforms(scene, textures) {
  const uniforms = {
    focal: { value: new Vector2() },
    centre: { value: new Vector2() },
    height: { value: 1 },
    parallel: { value: false },
    eye: { value: new Vector3() },
    axesFromCamera: { value: new Matrix3() },
    viewFromCamera: { value: new Matrix3() },
    near: { value: 0 },
    shape: { value: new Vector3(...scene.shape) },
    blocks: { value: new Vector3(...scene.blocks) },
    background: { value: new Vector3(1, 1, 1) },
    indirection: { value: textures.indirection },
  };
  for (const kind of ["rgba", "feature", "skip"]) {
    (textures[kind] ?? []).forEach((texture, i) => (uniforms[`${kind}_${i}`] = { value: texture }));
  }
  return uniforms;
}

function quad(shader, uniforms) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array([-1, -1, 0, 3, -1, 0, -1, 3, 0]), 3));
  const material = new RawShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: VERTEX_SHADER,
    fragmentShader: shader,
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

function target(filter) {
  return new WebGLRenderTarget(1, 1, { depthBuffer: false, generateMipmaps: false, minFilter: filter, magFilter: filter });
}
