// How sticks and hands move the scene around a person: the left stick walks, the right one turns, B and Y leave; a trigger or a pinch takes
// hold of the scene, with both hands one also turns it.
import {
  type ArrayCamera,
  BufferGeometry,
  type Camera,
  Group,
  Line,
  LineBasicMaterial,
  Matrix4,
  type Object3D,
  Vector3,
  type XRTargetRaySpace,
} from "three";

const SPEED = 1.5; // metres a second at the stick's end
const TURN = Math.PI / 6; // radians a push of the right stick: turning smoothly makes people ill
const PUSHED = 0.6; // of the stick's way
const LEFT_ALONE = 0.2; // of the stick's way: what is less is a hand that rests
const LONGEST = 0.1; // seconds that a frame counts at most
const LEAVE_BUTTON = 5; // B and Y, of the mapping "xr-standard"
const RAY = 0.15; // metres: how long the line at a hand is

/** What moves: `group` holds the scene. */
export class Movement {
  readonly group = new Group();
  private readonly hands: { space: XRTargetRaySpace; line: Line; undo: () => void }[] = [];
  private held: Vector3[] = []; // where the hands that hold the scene are, as of the last frame
  private holding = new Set<XRTargetRaySpace>();
  private pushed = false;
  private before = 0;

  constructor(
    placed: Matrix4,
    private readonly session: XRSession,
  ) {
    this.group.matrixAutoUpdate = false;
    this.group.matrix.copy(placed);
  }

  addHand(space: XRTargetRaySpace, world: Object3D): void {
    const geometry = new BufferGeometry().setFromPoints([new Vector3(), new Vector3(0, 0, -RAY)]);
    const line = new Line(geometry, new LineBasicMaterial({ color: 0x4f8fdd, transparent: true, depthTest: false }));
    line.renderOrder = 1; // after the scene
    space.add(line);
    world.add(space);
    const hold = () => {
      this.holding.add(space);
      this.held = [];
    };
    const release = () => {
      this.holding.delete(space);
      this.held = [];
    };
    space.addEventListener("selectstart", hold);
    space.addEventListener("selectend", release);
    const undo = () => {
      space.removeEventListener("selectstart", hold);
      space.removeEventListener("selectend", release);
    };
    this.hands.push({ space, line, undo });
  }

  dispose(): void {
    for (const { space, line, undo } of this.hands) {
      undo();
      space.remove(line);
      space.removeFromParent();
      line.geometry.dispose();
      (line.material as LineBasicMaterial).dispose();
    }
  }

  /** A frame. time: milliseconds. head: the cameras of the eyes. */
  step(time: number, head: ArrayCamera): void {
    const seconds = Math.min((time - this.before) / 1000, LONGEST);
    this.before = time;
    let push = 0;
    for (const { handedness, gamepad } of this.session.inputSources) {
      if (gamepad?.mapping !== "xr-standard") continue;
      if (gamepad.buttons[LEAVE_BUTTON]?.pressed) void this.session.end();
      const [x, y] = [gamepad.axes[2] ?? 0, gamepad.axes[3] ?? 0];
      if (handedness === "right") push = x;
      else this.walk(x, y, seconds, head);
    }
    if (Math.abs(push) > PUSHED && !this.pushed) this.turn(Math.sign(push) * TURN, middleOf(head));
    this.pushed = Math.abs(push) > PUSHED;
    this.drag();
    this.group.matrixWorldNeedsUpdate = true;
  }

  /** Move the scene against the way in which a person walks, who looks along `head`. */
  private walk(right: number, back: number, seconds: number, head: Camera): void {
    if (Math.hypot(right, back) < LEFT_ALONE) return;
    const [x, z] = [0, 2].map((column) => new Vector3().setFromMatrixColumn(head.matrixWorld, column).setY(0).normalize());
    this.move(
      x
        .multiplyScalar(right)
        .addScaledVector(z, back)
        .multiplyScalar(-SPEED * seconds),
    );
  }

  private move({ x, y, z }: Vector3): void {
    this.group.matrix.premultiply(new Matrix4().makeTranslation(x, y, z));
  }

  /** Turn a person to the right where they stand: the scene turns to the left around them. */
  private turn(angle: number, { x, y, z }: Vector3): void {
    this.group.matrix
      .premultiply(new Matrix4().makeTranslation(-x, -y, -z))
      .premultiply(new Matrix4().makeRotationY(angle))
      .premultiply(new Matrix4().makeTranslation(x, y, z));
  }

  /** Let the scene follow the hands that hold it. */
  private drag(): void {
    const now = [...this.holding].map((space) => space.position.clone());
    const { held } = this;
    this.held = now;
    if (!now.length || held.length !== now.length) return;
    const centre = mean(now);
    this.move(centre.clone().sub(mean(held)));
    if (now.length < 2) return;
    const heading = ([a, b]: Vector3[]) => Math.atan2(b.x - a.x, b.z - a.z);
    this.turn(heading(now) - heading(held), centre);
  }
}

const mean = (points: readonly Vector3[]): Vector3 =>
  points.reduce((sum, point) => sum.add(point), new Vector3()).divideScalar(points.length);

/** The point between the eyes; three.js puts the camera that stands for both behind them. */
const middleOf = ({ cameras }: ArrayCamera): Vector3 => mean(cameras.map((eye) => new Vector3().setFromMatrixPosition(eye.matrixWorld)));
