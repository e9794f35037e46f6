// Moves a view without hands: flights between cameras, and the camera path.
import { Matrix4, Quaternion, Vector3 } from "three";
import type { SnergCamera } from "../data/cameras";
import type { PathCamera, PathPlayer, PathState } from "../optional/path";
import { between, eased, wantsLessMotion } from "./flight";
import type { MakePlayer } from "./open_bundle";
import type { View } from "./view";

export class Motion {
  /** What plays the camera path; null without one. */
  readonly path: PathPlayer | null = null;
  private flight = 0; // counts flights, so that a new one ends the one before
  private flying: Promise<void> | null = null;

  /** onPath: called when somebody plays, stops or moves along the camera path. */
  constructor(
    private readonly view: View,
    makePlayer: MakePlayer | null,
    onPath: (state: PathState) => void,
  ) {
    if (!makePlayer) return;
    this.path = makePlayer(
      (camera) => this.showPath(camera),
      () => {
        if (this.path) onPath(this.path.state);
      },
    );
  }

  /** Show a camera. duration: seconds of a flight there; at once for people who asked for less motion. */
  async goTo(target: View["camera"], duration: number): Promise<void> {
    this.stop();
    const flight = this.flight;
    if (duration > 0 && !wantsLessMotion() && target.projection === this.view.camera.projection) {
      this.flying = this.fly(target, duration, flight);
      await this.flying;
    }
    if (flight === this.flight) this.view.jump(target);
  }

  /** End a flight, and leave the path. */
  stop(): void {
    this.endFlight();
    this.path?.leave();
  }

  /** End a flight where it is. */
  endFlight(): void {
    this.flight++;
  }

  /** Resolves when no flight is under way. */
  async landed(): Promise<void> {
    await this.flying;
  }

  /** Move the view to a camera, until another flight begins. */
  private async fly(target: View["camera"], duration: number, flight: number): Promise<void> {
    const { view } = this;
    const from = view.current;
    const distances = [view.rig.now.distance, view.orbitDistance(target)] as const;
    const began = performance.now();
    for (let part = 0; part < 1 && flight === this.flight; ) {
      part = Math.min(((await nextFrame()) - began) / (1000 * duration), 1);
      if (flight === this.flight && part < 1) view.jump(between(from, target, eased(part), distances), true);
    }
  }

  private showPath(camera: PathCamera): void {
    this.endFlight();
    this.view.jump(cameraOf(camera), true);
  }
}

const nextFrame = (): Promise<number> => new Promise((resolve) => requestAnimationFrame(() => resolve(performance.now())));

/** A path's camera as the viewer's others are. */
function cameraOf({ position, rotation, ...rest }: PathCamera): SnergCamera {
  const [x, y, z] = position;
  const turn = new Quaternion(...(rotation as [number, number, number, number]));
  return { ...rest, cameraToWorld: new Matrix4().compose(new Vector3(x, y, z), turn.normalize(), new Vector3(1, 1, 1)) };
}
