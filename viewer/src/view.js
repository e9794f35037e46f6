// The camera of the page: an exported camera, exactly, until the user moves; then one that orbits the scene.
import { Matrix4, OrthographicCamera, PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { matrixOfRows, positionOf, rotationOf } from "./scene.js";

const MIN_TILT = 1e-4; // radians: a camera that looks straight down is tilted by this much, so that the orbit keeps its heading
const MIN_ORBIT_DISTANCE = 0.02; // of the orbit's scale: where a camera is past the centre, it orbits a point this far before it

const FARTHEST = 1e9; // voxels, or units of the scene: the far plane of cameras without one
const UNNAMED = { name: "", projection: "perspective", near: 0 }; // of the cameras that the viewer adds itself

/** The camera whose image spans -1 to 1 in a forward-facing scene's normalised device coordinates. */
function frameCamera({ camera_to_world, focal }) {
  const [width, height] = [(1000 * focal[1]) / focal[0], 1000];
  const centre = [width / 2, height / 2];
  const pixels = [focal[0] * centre[0], focal[1] * centre[1]];
  return { ...UNNAMED, width, height, focal: pixels, centre, cameraToWorld: matrixOfRows(camera_to_world) };
}

/**
 * The camera, and the controls that move it.
 *
 * All numbers are in double precision. The controls work in units of `orbitScale` around `centre`, so that they behave the same
 * for scenes of any size at any distance from the world's origin.
 */
export class View {
  /** scene: of `readScene`. element: receives the mouse. onChange: called when the image changes. */
  constructor(scene, element, onChange) {
    this.scene = scene;
    this.onChange = () => {};
    // Ray space, in which the shader is given rays (see march.glsl).
    const pose = scene.ndc ? matrixOfRows(scene.ndc.camera_to_world) : scene.gridToWorld;
    this.raySpaceFromWorld = rotationOf(pose).transpose(); // a rotation
    this.raySpaceOrigin = positionOf(pose);
    this.raySpaceUnit = scene.ndc ? scene.ndc.near : scene.voxel_size;
    // The orbit's centre, from that origin: the box's centre, or of a forward-facing scene the depth at the middle of its NDC.
    const toCentre = scene.ndc ? new Vector3(0, 0, -2 * scene.ndc.near) : new Vector3(...scene.shape).multiplyScalar(scene.voxel_size / 2);
    this.orbitScale = 2 * toCentre.length();
    this.centre = toCentre.applyMatrix4(pose);
    this.size = [1, 1];
    this.background = [1, 1, 1];
    this.orbitCameras = { perspective: new PerspectiveCamera(), orthographic: new OrthographicCamera() };
    for (const camera of Object.values(this.orbitCameras)) camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.orbitCameras.perspective, element);
    Object.assign(this.controls, { rotateSpeed: 0.8, minDistance: 1e-3, maxDistance: 100, minZoom: 1e-2, maxZoom: 1e3 });
    this.controls.addEventListener("change", () => {
      if (this.jumping) return;
      this.atCamera = false;
      this.onChange();
    });
    this.jump(this.overview());
    this.onChange = onChange;
  }

  /** A camera that sees the whole box from the front, the right and above; of a forward-facing scene, the camera of its frame. */
  overview() {
    if (this.scene.ndc) return frameCamera(this.scene.ndc);
    const back = new Vector3(0.45, -0.8, 0.4).normalize();
    const cameraToWorld = new Matrix4().lookAt(back, new Vector3(), new Vector3(0, 0, 1));
    cameraToWorld.setPosition(back.multiplyScalar(1.6 * this.orbitScale).add(this.centre));
    return { ...UNNAMED, width: 1000, height: 1000, focal: [1500, 1500], centre: [500, 500], cameraToWorld };
  }

  /** Show the image of a camera; the orbit starts there, around the point before the camera that is nearest to the centre. */
  jump(camera) {
    this.camera = camera;
    this.atCamera = true;
    const [up, backward] = [1, 2].map((column) => new Vector3().setFromMatrixColumn(camera.cameraToWorld, column));
    const forward = backward.negate();
    const position = positionOf(camera.cameraToWorld).sub(this.centre).divideScalar(this.orbitScale);
    const distance = Math.max(-position.dot(forward), MIN_ORBIT_DISTANCE);
    const target = position.clone().addScaledVector(forward, distance);
    if (Math.hypot(forward.x, forward.y) < MIN_TILT) target.addScaledVector(up.setZ(0), -MIN_TILT * Math.sign(forward.z) * distance);
    this.jumping = true;
    this.controls.object = this.orbitCameras[camera.projection];
    this.controls.object.position.copy(position);
    this.controls.object.zoom = 1;
    this.controls.target.copy(target);
    this.fitOrbitCameras();
    this.controls.update();
    this.jumping = false;
    this.onChange();
  }

  /** Turn the orbit, by radians. */
  turn(right, up) {
    this.controls.rotateLeft(-right);
    this.controls.rotateUp(up);
    this.controls.update();
  }

  /** The page's size in CSS pixels. */
  resize(width, height) {
    this.size = [width, height];
    this.fitOrbitCameras();
  }

  /** CSS pixels a pixel of the camera: its whole image fits into the page, which also shows what lies around it. */
  get scale() {
    return Math.min(this.size[0] / this.camera.width, this.size[1] / this.camera.height);
  }

  /** Where the camera's image lies on the page: [left, top, width, height] in CSS pixels. */
  get frame() {
    const [width, height] = [this.camera.width * this.scale, this.camera.height * this.scale];
    return [(this.size[0] - width) / 2, (this.size[1] - height) / 2, width, height];
  }

  /** Give the controls' cameras the field of view of the page: the controls derive from it how far a drag moves. */
  fitOrbitCameras() {
    const [width, height] = this.size;
    const focal = this.camera.focal[1] * this.scale;
    const { perspective, orthographic } = this.orbitCameras;
    perspective.fov = (2 * Math.atan(height / (2 * focal)) * 180) / Math.PI;
    perspective.aspect = width / height;
    orthographic.right = width / (2 * focal * this.orbitScale);
    orthographic.top = height / (2 * focal * this.orbitScale);
    [orthographic.left, orthographic.bottom] = [-orthographic.right, -orthographic.top];
  }

  /** Camera-to-world, a rigid transform as a Matrix4. */
  pose() {
    if (this.atCamera) return this.camera.cameraToWorld;
    const camera = this.controls.object;
    camera.updateMatrixWorld();
    return camera.matrixWorld.clone().setPosition(camera.position.clone().multiplyScalar(this.orbitScale).add(this.centre));
  }

  /** The uniforms of march.glsl that follow the camera, for an image of that size in pixels, which has the page's aspect ratio. */
  uniforms(width, height) {
    const { scene, camera } = this;
    const orthographic = camera.projection === "orthographic";
    const pose = this.pose();
    const rotation = rotationOf(pose);
    const raySpaceFromCamera = this.raySpaceFromWorld.clone().multiply(rotation);
    // Subtract first: far from the world's origin, the difference of two rotated positions would lose precision.
    const cameraPosition = positionOf(pose).sub(this.raySpaceOrigin).applyMatrix4(this.raySpaceFromWorld).divideScalar(this.raySpaceUnit);
    const moved = orthographic && !scene.ndc ? this.moveToBox(cameraPosition, raySpaceFromCamera) : 0;
    const [nearDistance, near, far] = [scene.near, camera.near, camera.far ?? FARTHEST].map((length) => length / this.raySpaceUnit - moved);
    const [sx, sy] = [width / this.size[0], height / this.size[1]];
    const [left, top] = this.frame;
    const zoom = this.scale * (this.atCamera ? 1 : this.controls.object.zoom);
    const pixels = orthographic ? zoom * this.raySpaceUnit : zoom;
    return {
      focal: [camera.focal[0] * pixels * sx, camera.focal[1] * pixels * sy],
      principalPoint: [(camera.centre[0] * this.scale + left) * sx, (camera.centre[1] * this.scale + top) * sy],
      imageHeight: height,
      orthographic,
      cameraPosition,
      raySpaceFromCamera,
      networkFromCamera: scene.networkFromWorld.clone().multiply(rotation),
      nearDistance,
      clipPlanes: [near, Math.min(far, FARTHEST)],
      background: this.background,
    };
  }

  /**
   * Move the position of an orthographic camera, in voxels, forward to just before the box, where single precision resolves its
   * rays. Returns by how many voxels.
   */
  moveToBox(position, raySpaceFromCamera) {
    const forward = new Vector3().setFromMatrixColumn(raySpaceFromCamera, 2).negate();
    const halfBox = new Vector3(...this.scene.shape).multiplyScalar(0.5);
    const distance = Math.max(0, halfBox.clone().sub(position).dot(forward) - halfBox.length() - 1);
    position.addScaledVector(forward, distance);
    return distance;
  }
}
