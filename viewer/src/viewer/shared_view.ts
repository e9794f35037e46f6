// A view as parameters of an address: the camera, and where somebody has moved from there.
import { Matrix4, Quaternion, Vector3 } from "three";
import { matrixOfRows } from "../data/scene";
import { colourOf } from "./backdrop";
import { AUTOMATIC, qualityOf } from "./quality";

const DIGITS = 10; // of each number: a thousandth of a pixel, also far from the world's origin

export interface SharedView {
  camera: string | null; // the name of the camera that the view began from
  background: string | null; // as `colourOf` knows it
  quality: string | null; // a preset, or AUTOMATIC
  pose: number[][] | null; // camera-to-world, four rows; null for the camera's own
  zoom: number; // of an orthographic camera
  frame: number | null; // of the camera path, where the view is its
}

/** Put a view into the parameters of an address. All others stay as they are. */
export function writeView(parameters: URLSearchParams, view: SharedView): URLSearchParams {
  if (view.camera !== null) parameters.set("camera", view.camera);
  if (view.background !== null) parameters.set("background", view.background);
  if (view.quality !== null) parameters.set("quality", view.quality);
  if (view.pose === null) parameters.delete("view");
  else parameters.set("view", numbersOf(view.pose).map(short).join(","));
  if (view.frame === null) parameters.delete("frame");
  else parameters.set("frame", short(view.frame));
  if (view.zoom === 1) parameters.delete("zoom");
  else parameters.set("zoom", short(view.zoom));
  return parameters;
}

/** The view in the parameters of an address; what is missing or damaged is null there. */
export function readView(parameters: URLSearchParams): SharedView {
  const background = parameters.get("background");
  const quality = parameters.get("quality");
  const frame = Number.parseFloat(parameters.get("frame") ?? "");
  const zoom = Number(parameters.get("zoom") ?? 1);
  return {
    camera: parameters.get("camera"),
    background: background !== null && colourOf(background) ? background : null,
    quality: quality === AUTOMATIC || qualityOf(quality) ? quality : null,
    pose: poseOf((parameters.get("view") ?? "").split(",").map(Number)),
    zoom: zoom > 0 && Number.isFinite(zoom) ? zoom : 1,
    frame: Number.isFinite(frame) ? frame : null,
  };
}

const short = (value: number): string => String(Number(value.toPrecision(DIGITS)));

/** A rigid pose as its position and its rotation, a quaternion. */
function numbersOf(rows: number[][]): number[] {
  const [position, rotation] = [new Vector3(), new Quaternion()];
  matrixOfRows(rows).decompose(position, rotation, new Vector3());
  return [...position, ...rotation];
}

function poseOf(values: number[]): number[][] | null {
  if (values.length !== 7 || !values.every(Number.isFinite)) return null;
  const [x, y, z, ...turn] = values;
  const rotation = new Quaternion(...turn);
  if (!(rotation.length() > 0)) return null;
  return rowsOf(new Matrix4().compose(new Vector3(x, y, z), rotation.normalize(), new Vector3(1, 1, 1)));
}

/** The four rows of a matrix. */
export const rowsOf = (matrix: Matrix4): number[][] =>
  [0, 1, 2, 3].map((row) => [0, 1, 2, 3].map((column) => matrix.elements[4 * column + row]));
