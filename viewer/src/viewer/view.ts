// The camera of the page: an exported camera, exactly, until the user moves; then one that a rig carries.
import { Camera, Matrix4, Vector3 } from "three";
import type { SnergCamera } from "../data/cameras";
import { matrixOfRows, type NdcFrame, positionOf, type SceneDescription } from "../data/scene";
import { sphereOf } from "../volume/volume";
import { matrixOf, type OrbitLimits, Rig, rotationOf, type Stance, stanceOf } from "./rig";

const MIN_ORBIT_DISTANCE = 0.02; // of the scene's size: where a camera is past the centre, it orbits a point this far before it
const NEAREST = 1e-3; // of the scene's size: the near plane in the depth buffer, of cameras whose own is nearer
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

/** The camera of three.js that renders the view. Its clip planes are the viewed camera's. */
class ViewCamera extends Camera {
  near = 0;
  far = Number.POSITIVE_INFINITY;
}

/** The camera, and the rig that carries it away from where it was exported. All numbers are in double precision. */
export class View {
  readonly rendered = new ViewCamera(); // see `update`
  camera: Viewed;
  atCamera = true; // whether the view is `camera` itself
  shared = false; // whether `camera` was moved by `lookFrom`
  readonly rig: Rig;
  private readonly centre: Vector3;
  private size: [number, number] = [1, 1];
  private lookedZoom = 1; // of `lookFrom`

  /** onChange: called when the image changes. */
  constructor(
    private readonly scene: SceneDescription,
    private readonly onChange: () => void,
    limits: OrbitLimits = {},
  ) {
    const sphere = sphereOf(scene);
    this.rig = new Rig(2 * sphere.radius, limits);
    this.centre = sphere.center;
    this.camera = this.overview();
    this.place();
  }

  /** A camera that sees the whole box from the front, the right and above; of a forward-facing scene, the camera of its frame. */
  overview(): Viewed {
    if (this.scene.ndc) return frameCamera(this.scene.ndc);
    const back = new Vector3(0.45, -0.8, 0.4).normalize();
    const cameraToWorld = new Matrix4().lookAt(back, new Vector3(), new Vector3(0, 0, 1));
    cameraToWorld.setPosition(back.multiplyScalar(1.6 * this.rig.size).add(this.centre));
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
    const orbit = this.atCamera ? 1 : 1 / this.rig.now.extent;
    return this.camera.projection === "orthographic" ? orbit * (this.shared ? this.lookedZoom : 1) : 1;
  }

  private place(): void {
    this.atCamera = true;
    this.rig.stand(stanceOf(this.camera.cameraToWorld, this.orbitDistance(this.camera)));
  }

  /** How far before a camera lies the point that an orbit from it turns around, in units of the scene. */
  orbitDistance({ cameraToWorld }: Viewed): number {
    const backward = new Vector3().setFromMatrixColumn(cameraToWorld, 2);
    return Math.max(positionOf(cameraToWorld).sub(this.centre).dot(backward), MIN_ORBIT_DISTANCE * this.rig.size);
  }

  /** The view as a camera of its own. */
  get current(): Viewed {
    const zoom = this.atCamera ? 1 : 1 / this.rig.now.extent;
    const focal = this.camera.focal.map((f) => f * zoom) as [number, number];
    return { ...this.camera, focal, cameraToWorld: this.pose().clone() };
  }

  /** The rig has moved. */
  moved(): void {
    this.atCamera = false;
    this.changed();
  }

  get orthographic(): boolean {
    return this.camera.projection === "orthographic";
  }

  /** Radians that a pixel of the page covers in the middle of the picture; of an orthographic camera as if it saw 60 degrees. */
  get anglePerPixel(): number {
    return this.orthographic ? Math.PI / 3 / this.size[1] : 1 / (this.camera.focal[1] * this.scale);
  }

  /** Where the view axis meets the page, in CSS pixels from the top left corner. */
  get middle(): [number, number] {
    const { camera, scale, frame } = this;
    return [frame[0] + camera.centre[0] * scale, frame[1] + camera.centre[1] * scale];
  }

  /** From the pivot of a stance to what lies at its distance under a point of the page, in CSS pixels from the top left corner. */
  beside(stance: Stance, [left, top]: readonly [number, number]): Vector3 {
    const { camera, scale } = this;
    const depth = this.orthographic ? stance.extent : stance.distance;
    const [x, y] = [(left - this.middle[0]) / scale, (top - this.middle[1]) / scale];
    return new Vector3((x * depth) / camera.focal[0], (-y * depth) / camera.focal[1], 0).applyQuaternion(rotationOf(stance));
  }

  /** The page's size in CSS pixels. Returns the one before. */
  resize(width: number, height: number): [number, number] {
    const before = this.size;
    this.size = [width, height];
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
    return this.atCamera ? this.camera.cameraToWorld : matrixOf(this.rig.now);
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
    const zoom = this.scale * (this.atCamera ? 1 : 1 / this.rig.now.extent);
    const [x, y] = [(2 * camera.focal[0] * zoom) / width, (2 * camera.focal[1] * zoom) / height];
    const shiftX = (2 * (camera.centre[0] * this.scale + left)) / width - 1;
    const shiftY = 1 - (2 * (camera.centre[1] * this.scale + top)) / height;
    rendered.near = camera.near;
    rendered.far = camera.far ?? Number.POSITIVE_INFINITY;
    const near = Math.max(camera.near, NEAREST * this.rig.size);
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
