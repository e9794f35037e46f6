// Opens a bundle: its cameras, its scene, and what else it holds. Texels are read later.
import { type LayerOrder, type PartName, readCameras, type SnergCamera, type WorldUnits } from "../data/cameras";
import { type FileSource, readJson } from "../data/files";
import { type LoadProgress, SnergScene } from "../data/snerg_scene";
import { EXPORT_AGAIN, ViewerError } from "../errors";
import { loadOptional } from "../load_optional";
import type { CameraPath, PathCamera, PathPlayer } from "../optional/path";

/** What a bundle holds, once it is opened. */
export interface OpenBundle {
  cameras: readonly SnergCamera[];
  parts: readonly PartName[];
  units: WorldUnits;
  layers: LayerOrder | null;
  scene: SnergScene;
  coarse: SnergScene | null; // the scene at a quarter of its resolution, where the bundle has it
  makePlayer: MakePlayer | null; // where the bundle has a camera path
}

/** Makes what plays a camera path. show: shows a camera. changed: called when the state changes. */
export type MakePlayer = (show: (camera: PathCamera) => void, changed: () => void) => PathPlayer;

interface OpenOptions {
  onProgress: (progress: LoadProgress) => void; // of the scene's texels, which are read later
  leaveOut: (error: unknown) => null; // an optional file is missing or damaged
  signal: AbortSignal;
}

/** Open the bundle whose files a source has. Rejects with a ViewerError where a file that it needs is missing or damaged. */
export async function openBundle(source: FileSource, { onProgress, leaveOut, signal }: OpenOptions): Promise<OpenBundle> {
  const [{ cameras, coarse, path, layers, parts, units }, scene] = await Promise.all([
    readCameras(source, "cameras.json", signal),
    SnergScene.load(source, { folder: "scene/", onProgress, signal }),
  ]);
  const makePlayer = path ? await readPath(source, signal).catch(leaveOut) : null;
  const small = coarse ? await SnergScene.load(source, { folder: "coarse/", signal, keep: true }).catch(leaveOut) : null;
  return { cameras, parts, units, layers, scene, coarse: small, makePlayer };
}

/** What plays the camera path of a bundle. Rejects with a ViewerError where it, or the code that plays it, is missing or damaged. */
async function readPath(source: FileSource, signal: AbortSignal): Promise<MakePlayer> {
  const [{ pathOf, PathPlayer }, value] = await Promise.all([loadOptional("path"), readJson(source, "path.json", signal)]);
  const path: CameraPath | null = pathOf(value);
  if (!path) throw new ViewerError(`The file path.json is damaged: it is not a camera path. ${EXPORT_AGAIN}`);
  return (show, changed) => new PathPlayer(path, show, changed);
}
