// The camera of the page: an exported camera, exactly, until the user moves; then one that orbits the scene.
import { Camera, Matrix4, OrthographicCamera, PerspectiveCamera, Vector3 } from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import type { SnergCamera } from "../data/cameras";
import { matrixOfRows, type NdcFrame, positionOf, type SceneDescription } from "../data/scene";
import { sphereOf } from "../volume/volume";

const MIN_TILT = 1e-4; // radians: a camera that looks straight down is tilted by this much, so that the orbit keeps its heading
const MIN_ORBIT_DISTANCE = 0.02; // of the orbit's scale: where a camera is past the centre, it orbits a point this far before it
const NEAREST = 1e-3; // of the orbit's scale: the near plane in the depth buffer, of cameras whose own is nearer
const DEPTHS = 1e6; // farthest over nearest in the depth buffer

type Viewed = Omit<SnergCamera, "name"> & { name: string };
const UNNAMED = { name: "", projection: "perspective", near: 0 } as const; // of the cameras that the viewer adds itself

/** The camera whose image spans -1 to 1 in a forward-facing scene's normalised device coordinates. */
function frameCamera({ camera_to_world, focal }: NdcFrame): Viewed {
  const [width, height] = [(1000 * focal[1]) / focal[0], 1000];
  const centre: [number, number] = [width / 2, height / 2];
  const pixels: [number, number] = [focal[0] * centre[0], focal[1] * centre[1]];
  return { ...UNNAMED, width, height, focal: pixels, centre, cameraToWorld: matrixOfRows(camera_to_world) };
}

/** Where the orbit may go. */
export interface OrbitLimits {
  distance?: [number, number]; // nearest and farthest, in units of the scene, from the point that is looked at
  elevation?: [number, number]; // lowest and highest, in degrees above the horizon
}

/** The camera of three.js that renders the view. Its clip planes are the viewed camera's. */
class ViewCamera extends Camera {
  near = 0;
  far = Number.POSITIVE_INFINITY;
}

/**
 * The camera, and the controls that move it.
 *
 * All numbers are in double precision. The controls work in units of `orbitScale` around `centre`, so that they behave the same
 * for scenes of any size at any distance from the world's origin.
 */
export class View {
  readonly rendered = new ViewCamera(); // see `update`
  camera: Viewed;
  atCamera = true; // whether the view is `camera` itself
  shared = false; // whether `camera` was moved by `lookFrom`
  readonly controls: OrbitControls;
  readonly orbitScale: number;
  private readonly centre: Vector3;
  private readonly orbitCameras = { perspective: new PerspectiveCamera(), orthographic: new OrthographicCamera() };
  private size: [number, number] = [1, 1];
  private jumping = false;
  private lookedZoom = 1; // of `lookFrom`

  /** element: receives the mouse. onChange: called when the image changes. */
  constructor(
    private readonly scene: SceneDescription,
    element: HTMLElement,
    private readonly onChange: () => void,
    limits: OrbitLimits = {},
  ) {
    const sphere = sphereOf(scene);
    this.orbitScale = 2 * sphere.radius;
    this.centre = sphere.center;
    for (const camera of Object.values(this.orbitCameras)) camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.orbitCameras.perspective, element);
    Object.assign(this.controls, {
      rotateSpeed: 0.8,
      zoomToCursor: true,
      minDistance: 1e-3,
      maxDistance: 100,
      minZoom: 1e-2,
      maxZoom: 1e3,
    });
    if (limits.distance) [this.controls.minDistance, this.controls.maxDistance] = limits.distance.map((length) => length / this.orbitScale);
    if (limits.elevation) {
      const [low, high] = limits.elevation.map((degrees) => ((90 - degrees) * Math.PI) / 180);
      [this.controls.minPolarAngle, this.controls.maxPolarAngle] = [high, low];
    }
    this.controls.addEventListener("change", () => {
      if (this.jumping) return;
      this.atCamera = false;
      this.changed();
    });
    this.camera = this.overview();
    this.place();
  }

  /** A camera that sees the whole box from the front, the right and above; of a forward-facing scene, the camera of its frame. */
  overview(): Viewed {
    if (this.scene.ndc) return frameCamera(this.scene.ndc);
    const back = new Vector3(0.45, -0.8, 0.4).normalize();
    const cameraToWorld = new Matrix4().lookAt(back, new Vector3(), new Vector3(0, 0, 1));
    cameraToWorld.setPosition(back.multiplyScalar(1.6 * this.orbitScale).add(this.centre));
    return { ...UNNAMED, width: 1000, height: 1000, focal: [1500, 1500], centre: [500, 500], cameraToWorld };
  }

  /**
   * Show the image of a camera; the orbit starts there, around the point before the camera that is nearest to the centre.
   *
   * shared: whether it is a view of its own, and not that of the exported camera of its name.
   */
  jump(camera: Viewed, shared = false): void {
    this.camera = camera;
    this.shared = shared;
    this.lookedZoom = 1;
    this.place();
    this.changed();
  }

  /** Look from another pose with the lens of the camera. zoom: of an orthographic camera. */
  lookFrom(cameraToWorld: Matrix4, zoom: number): void {
    const focal = this.camera.projection === "orthographic" ? this.camera.focal.map((f) => f * zoom) : this.camera.focal;
    this.jump({ ...this.camera, focal: focal as [number, number], cameraToWorld }, true);
    this.lookedZoom = zoom;
    this.onChange();
  }

  /** The zoom from the exported camera, of an orthographic one. */
  get zoom(): number {
    const orbit = this.atCamera ? 1 : (this.controls.object as OrthographicCamera).zoom;
    return this.camera.projection === "orthographic" ? orbit * (this.shared ? this.lookedZoom : 1) : 1;
  }

  private place(): void {
    const { camera } = this;
    this.atCamera = true;
    const [up, backward] = [1, 2].map((column) => new Vector3().setFromMatrixColumn(camera.cameraToWorld, column));
    const forward = backward.negate();
    const position = positionOf(camera.cameraToWorld).sub(this.centre).divideScalar(this.orbitScale);
    const distance = this.orbitDistance(camera) / this.orbitScale;
    const target = position.clone().addScaledVector(forward, distance);
    if (Math.hypot(forward.x, forward.y) < MIN_TILT) target.addScaledVector(up.setZ(0), -MIN_TILT * Math.sign(forward.z) * distance);
    this.jumping = true;
    this.controls.object = this.orbitCameras[camera.projection];
    this.controls.object.position.copy(position);
    (this.controls.object as PerspectiveCamera | OrthographicCamera).zoom = 1;
    this.controls.target.copy(target);
    this.fitOrbitCameras();
    this.controls.update();
    this.jumping = false;
  }

  /** How far before a camera lies the point that an orbit from it turns around, in units of the scene. */
  orbitDistance({ cameraToWorld }: Viewed): number {
    const backward = new Vector3().setFromMatrixColumn(cameraToWorld, 2);
    return Math.max(positionOf(cameraToWorld).sub(this.centre).dot(backward), MIN_ORBIT_DISTANCE * this.orbitScale);
  }

  /** The view as a camera of its own. */
  get current(): Viewed {
    const zoom = this.atCamera ? 1 : (this.controls.object as PerspectiveCamera).zoom;
    const focal = this.camera.focal.map((f) => f * zoom) as [number, number];
    return { ...this.camera, focal, cameraToWorld: this.pose().clone() };
  }

  /** Turn the orbit, by radians. */
  turn(right: number, up: number): void {
    const controls = this.controls as OrbitControls & { rotateLeft(angle: number): void; rotateUp(angle: number): void };
    controls.rotateLeft(-right);
    controls.rotateUp(up);
    controls.update();
  }

  /** Come nearer by a factor above 1, or go farther by one below; an orthographic camera zooms. */
  approach(factor: number): void {
    const controls = this.controls as OrbitControls & { dollyIn(scale: number): void };
    controls.dollyIn(factor);
  }

  /** The page's size in CSS pixels. Returns the one before. */
  resize(width: number, height: number): [number, number] {
    const before = this.size;
    this.size = [width, height];
    this.fitOrbitCameras();
    this.changed();
    return before;
  }

  /** CSS pixels a pixel of the camera: its whole image fits into the page, which also shows what lies around it. */
  get scale(): number {
    return Math.min(this.size[0] / this.camera.width, this.size[1] / this.camera.height);
  }

  /** Where the camera's image lies on the page: [left, top, width, height] in CSS pixels. */
  get frame(): [number, number, number, number] {
    const [width, height] = [this.camera.width * this.scale, this.camera.height * this.scale];
    return [(this.size[0] - width) / 2, (this.size[1] - height) / 2, width, height];
  }

  /** Camera-to-world, a rigid transform. */
  pose(): Matrix4 {
    if (this.atCamera) return this.camera.cameraToWorld;
    const camera = this.controls.object;
    camera.updateMatrixWorld();
    return camera.matrixWorld.clone().setPosition(camera.position.clone().multiplyScalar(this.orbitScale).add(this.centre));
  }

  /** Give the controls' cameras the field of view of the page: the controls derive from it how far a drag moves. */
  private fitOrbitCameras(): void {
    const [width, height] = this.size;
    const focal = this.camera.focal[1] * this.scale;
    const { perspective, orthographic } = this.orbitCameras;
    perspective.fov = (2 * Math.atan(height / (2 * focal)) * 180) / Math.PI;
    perspective.aspect = width / height;
    orthographic.right = width / (2 * focal * this.orbitScale);
    orthographic.top = height / (2 * focal * this.orbitScale);
    [orthographic.left, orthographic.bottom] = [-orthographic.right, -orthographic.top];
  }

  private changed(): void {
    this.update();
    this.onChange();
  }

  /** Bring `rendered` to the view. */
  private update(): void {
    const { camera, rendered } = this;
    const [width, height] = this.size;
    const [left, top] = this.frame;
    const zoom = this.scale * (this.atCamera ? 1 : (this.controls.object as PerspectiveCamera).zoom);
    const [x, y] = [(2 * camera.focal[0] * zoom) / width, (2 * camera.focal[1] * zoom) / height];
    const shiftX = (2 * (camera.centre[0] * this.scale + left)) / width - 1;
    const shiftY = 1 - (2 * (camera.centre[1] * this.scale + top)) / height;
    rendered.near = camera.near;
    rendered.far = camera.far ?? Number.POSITIVE_INFINITY;
    const near = Math.max(camera.near, NEAREST * this.orbitScale);
    const far = Math.min(rendered.far, DEPTHS * near);
    const depth = far - near;
    if (camera.projection === "orthographic") {
      rendered.projectionMatrix.set(x, 0, 0, shiftX, 0, y, 0, shiftY, 0, 0, -2 / depth, -(far + near) / depth, 0, 0, 0, 1);
    } else {
      rendered.projectionMatrix.set(
        x,
        0,
        -shiftX,
        0,
        0,
        y,
        -shiftY,
        0,
        0,
        0,
        -(far + near) / depth,
        (-2 * far * near) / depth,
        0,
        0,
        -1,
        0,
      );
    }
    rendered.projectionMatrixInverse.copy(rendered.projectionMatrix).invert();
    rendered.matrixAutoUpdate = false;
    rendered.matrix.copy(this.pose());
    rendered.matrixWorldNeedsUpdate = true;
  }
}
