// Where the picture is taken from: an exported camera, to the digit, until somebody moves; then an orbit around the box.
import { OrthographicCamera, PerspectiveCamera } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const NAVIGATION_TILT = 1e-4; // a camera looking straight down keeps its heading by leaning this much

const transpose = (m) => m[0].map((_, j) => m.map((row) => row[j]));
const multiply = (a, b) => a.map((row) => b[0].map((_, j) => row.reduce((sum, value, k) => sum + value * b[k][j], 0)));
const apply = (m, v) => m.map((row) => row.reduce((sum, value, k) => sum + value * v[k], 0));
const subtract = (a, b) => a.map((value, i) => value - b[i]);
const dot = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0);
const rotationOf = (pose) => pose.slice(0, 3).map((row) => row.slice(0, 3));
const positionOf = (pose) => pose.slice(0, 3).map((row) => row[3]);

/** The camera whose picture is a forward-facing scene's device coordinates from -1 to 1. */
function frameCamera({ camera_to_world, focal }) {
  const [width, height] = [(1000 * focal[1]) / focal[0], 1000];
  const centre = [width / 2, height / 2];
  return { width, height, focal: [focal[0] * centre[0], focal[1] * centre[1]], centre, projection: "perspective", near: 0, name: "", camera_to_world };
}

/**
 * All in double precision, and orbiting in units of the box around its centre: a scene far from the origin, tiny or huge,
 * behaves like any other.
 */
export class View {
  constructor(scene, element, onChange) {
    this.scene = scene;
    this.onChange = () => {};
    // What the shader is given rays in: the grid's voxels, or the frame of a forward-facing scene and its near plane.
    const pose = scene.ndc ? scene.ndc.camera_to_world : scene.grid_to_world;
    this.axes = rotationOf(pose);
    this.corner = positionOf(pose);
    this.length = scene.ndc ? scene.ndc.near : scene.voxel_size;
    // What one orbits: the box; in front of a frame, the depth that is in the middle of its device coordinates.
    const half = scene.ndc ? [0, 0, -2 * scene.ndc.near] : scene.shape.map((voxels) => (voxels * scene.voxel_size) / 2);
    this.centre = apply(this.axes, half).map((value, i) => value + this.corner[i]);
    this.unit = 2 * Math.hypot(...half);
    this.size = [1, 1];
    this.background = [1, 1, 1];
    this.handles = { perspective: new PerspectiveCamera(), orthographic: new OrthographicCamera() };
    for (const handle of Object.values(this.handles)) handle.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.handles.perspective, element);
    Object.assign(this.controls, { rotateSpeed: 0.8, minDistance: 1e-3, maxDistance: 100, minZoom: 1e-2, maxZoom: 1e3 });
    this.controls.addEventListener("change", () => {
      if (this.syncing) return;
      this.exact = false;
      this.onChange();
    });
    this.jump(this.overview());
    this.onChange = onChange;
  }

  /** A camera that sees the whole box, from the front, the right and above; or a forward-facing scene's own frame. */
  overview() {
    if (this.scene.ndc) return frameCamera(this.scene.ndc);
    const back = [0.45, -0.8, 0.4];
    const length = Math.hypot(...back);
    const z = back.map((value) => value / length);
    const flat = Math.hypot(z[0], z[1]);
    const x = [-z[1] / flat, z[0] / flat, 0];
    const y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]];
    const eye = this.centre.map((value, i) => value + 1.6 * this.unit * z[i]);
    const pose = [0, 1, 2].map((i) => [x[i], y[i], z[i], eye[i]]);
    const camera = { width: 1000, height: 1000, focal: [1500, 1500], centre: [500, 500], projection: "perspective", near: 0, name: "" };
    return { ...camera, camera_to_world: [...pose, [0, 0, 0, 1]] };
  }

  jump(camera) {
    this.camera = camera;
    this.exact = true;
    const rotation = rotationOf(camera.camera_to_world);
    const position = positionOf(camera.camera_to_world);
    const handle = this.handles[camera.projection];
    const forward = rotation.map((row) => -row[2]);
    const up = rotation.map((row) => row[1]);
    const distance = Math.max(dot(subtract(this.centre, position), forward) / this.unit, 0.02);
    const from = subtract(position, this.centre).map((value) => value / this.unit);
    const steep = Math.hypot(forward[0], forward[1]) < NAVIGATION_TILT ? NAVIGATION_TILT * Math.sign(-forward[2]) * distance : 0;
    const target = from.map((value, i) => value + distance * forward[i] + (i < 2 ? steep * up[i] : 0));
    this.syncing = true;
    this.controls.object = handle;
    handle.position.set(...from);
    handle.zoom = 1;
    this.controls.target.set(...target);
    this.fit();
    this.controls.update();
    this.syncing = false;
    this.onChange();
  }

  turn(right, up) {
    this.controls.rotateLeft(-right);
    this.controls.rotateUp(up);
    this.controls.update();
  }

  resize(width, height) {
    this.size = [width, height];
    this.fit();
  }

  /** The camera's frame fits into the page; the page shows what lies around it too. */
  get scale() {
    return Math.min(this.size[0] / this.camera.width, this.size[1] / this.camera.height);
  }

  /** The frame on the page: [left, top, width, height] in the units of `resize`. */
  get frame() {
    const [width, height] = [this.camera.width * this.scale, this.camera.height * this.scale];
    return [(this.size[0] - width) / 2, (this.size[1] - height) / 2, width, height];
  }

  /** Tell the controls how far a pixel goes. */
  fit() {
    const [width, height] = this.size;
    const focal = this.camera.focal[1] * this.scale;
    const { perspective, orthographic } = this.handles;
    perspective.fov = (2 * Math.atan(height / (2 * focal)) * 180) / Math.PI;
    perspective.aspect = width / height;
    orthographic.right = width / (2 * focal * this.unit);
    orthographic.top = height / (2 * focal * this.unit);
    [orthographic.left, orthographic.bottom] = [-orthographic.right, -orthographic.top];
  }

  /** [rotation 3 x 3, position 3] to the world. */
  pose() {
    if (this.exact) return [rotationOf(this.camera.camera_to_world), positionOf(this.camera.camera_to_world)];
    const handle = this.controls.object;
    handle.updateMatrixWorld();
    const m = handle.matrixWorld.elements; // column by column
    const rotation = [0, 1, 2].map((i) => [m[i], m[4 + i], m[8 + i]]);
    return [rotation, handle.position.toArray().map((value, i) => value * this.unit + this.centre[i])];
  }

  /** What the shader needs for a picture of that size (which has the page's proportions). */
  uniforms(width, height) {
    const { scene, camera } = this;
    const parallel = camera.projection === "orthographic";
    const [rotation, position] = this.pose();
    const toAxes = transpose(this.axes);
    const axesFromCamera = multiply(toAxes, rotation);
    let eye = apply(toAxes, subtract(position, this.corner)).map((value) => value / this.length);
    let near = Math.max(scene.near, camera.near) / this.length;
    if (parallel && !scene.ndc) [eye, near] = this.closer(eye, near, axesFromCamera);
    const [sx, sy] = [width / this.size[0], height / this.size[1]];
    const [left, top] = this.frame;
    const zoom = this.scale * (this.exact ? 1 : this.controls.object.zoom);
    const pixels = parallel ? zoom * this.length : zoom;
    return {
      focal: [camera.focal[0] * pixels * sx, camera.focal[1] * pixels * sy],
      centre: [(camera.centre[0] * this.scale + left) * sx, (camera.centre[1] * this.scale + top) * sy],
      height,
      parallel,
      eye,
      axesFromCamera,
      viewFromCamera: multiply(scene.view_rotation, rotation),
      near,
      background: this.background,
    };
  }

  /** Parallel rays may start anywhere before the box: from close by, single precision suffices. */
  closer(eye, near, axesFromCamera) {
    const forward = axesFromCamera.map((row) => -row[2]);
    const half = this.scene.shape.map((voxels) => voxels / 2);
    const slide = Math.max(0, dot(subtract(half, eye), forward) - Math.hypot(...half) - 1);
    return [eye.map((value, i) => value + slide * forward[i]), near - slide];
  }
}
