// A session in a headset: the scene is drawn for each eye; sticks and hands move it around the person.
import { type Box3, Color, PerspectiveCamera, Scene, SRGBColorSpace, type XRTargetRaySpace } from "three";
import { matrixOfRows } from "../../data/scene";
import type { Lent } from "../../viewer/interface";
import type { ShownImage } from "../../viewer/progressive_renderer";
import { sphereOf } from "../../volume/volume";
import { addStyle, barButton, makeElement, type PartHost, undoAtEnd } from "../parts/host";
import { Movement } from "./movement";
import { placement } from "./placement";
import style from "./style.css";

const FRAME = 10; // milliseconds that rendering both eyes may take
const NATIVE_PIXELS = 7e6; // of both eyes together, of usual headsets
const NEAR = 0.05; // metres
const FAR = 1000;

/** Add a button that enters the headset, where there is one. */
export async function attach(host: PartHost): Promise<void> {
  const { viewer } = host;
  if (!(await navigator.xr?.isSessionSupported("immersive-vr").catch(() => false))) return;
  let last: ShownImage | null = null;
  undoAtEnd(
    host,
    viewer.on("image", (image) => {
      if (image.full) last = image;
    }),
  );
  await viewer.ready;
  if (host.signal.aborted) return;
  addStyle(host, style);
  const said = makeElement("p", "vr-said");
  said.setAttribute("role", "status");
  said.hidden = true;
  host.stage.append(said);
  let session: XRSession | null = null;
  const enter = async () => {
    if (session) return session.end();
    said.hidden = true;
    try {
      session = await (navigator.xr as XRSystem).requestSession("immersive-vr", {
        requiredFeatures: ["local-floor"],
        optionalFeatures: ["hand-tracking"],
      });
      session.addEventListener("end", () => {
        session = null;
        button.textContent = ENTER;
      });
      button.textContent = LEAVE;
      await present(host, session, last);
    } catch (error) {
      await session?.end().catch(() => undefined);
      said.textContent = `The headset did not open (${error instanceof Error ? error.message : error}). Check that it is connected and awake.`;
      said.hidden = false;
    }
  };
  const button = barButton(host, ENTER, "Enter the scene with a headset: sticks move and turn, B or Y leaves", () => void enter());
  undoAtEnd(
    host,
    () => void session?.end(),
    () => button.remove(),
    () => said.remove(),
  );
}

const ENTER = "Enter VR";
const LEAVE = "Leave VR";

/** Draw into the headset until the session ends. */
async function present(host: PartHost, session: XRSession, last: ShownImage | null): Promise<void> {
  const { viewer } = host;
  const eye = matrixOfRows(viewer.state.cameraToWorld);
  const lent = viewer.lend();
  if (!lent) throw new Error("the scene is not there yet");
  const { renderer, volume } = lent;
  const [red, green, blue] = viewer.background;
  const world = new Scene();
  world.background = new Color().setRGB(red, green, blue, SRGBColorSpace);
  const { center, radius } = sphereOf(volume.source.description);
  const box = volume.source.description.ndc ? null : (volume.geometry.boundingBox as Box3);
  const metres = viewer.bundle?.units.metres ?? 1;
  const movement = new Movement(placement({ centre: center, radius, box, eye, metres }), session);
  world.add(movement.group);
  movement.group.add(volume);
  for (const controller of controllers(lent)) movement.addHand(controller, world);
  const before = renderer.autoClear;
  renderer.autoClear = true;
  renderer.xr.enabled = true;
  renderer.xr.setReferenceSpaceType("local-floor");
  renderer.xr.setFramebufferScaleFactor(scaleOf(last));
  const camera = new PerspectiveCamera(70, 1, NEAR, FAR);
  session.addEventListener("end", () => {
    renderer.setAnimationLoop(null);
    renderer.xr.enabled = false;
    renderer.autoClear = before;
    movement.dispose();
    volume.removeFromParent();
    lent.release();
  });
  await renderer.xr.setSession(session);
  renderer.xr.setFoveation(1);
  renderer.setAnimationLoop((time) => {
    movement.step(time, renderer.xr.getCamera());
    renderer.render(world, camera);
  });
}

const controllers = ({ renderer }: Lent): XRTargetRaySpace[] => [0, 1].map((index) => renderer.xr.getController(index));

/** How many pixels along an axis for each of the headset's own, from the time that the page's last image took. */
function scaleOf(last: ShownImage | null): number {
  if (!last) return 0.5;
  const milliseconds = (last.milliseconds / (last.width * last.height)) * NATIVE_PIXELS;
  return Math.max(0.25, Math.min(Math.sqrt(FRAME / milliseconds), 1));
}
