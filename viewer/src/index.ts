// The package: a scene's loader, an object of three.js, a viewer, and an element.
export { readCameras, type SnergCamera } from "./data/cameras";
export { ChosenFiles, EmbeddedFiles, type FileSource, type SceneFiles, ServerFiles } from "./data/files";
export type { SceneDescription } from "./data/scene";
export { type LoadOptions, type LoadProgress, SnergScene } from "./data/snerg_scene";
export { ViewerError } from "./errors";
export { defineElement, SnergViewerElement } from "./viewer/element";
export type { Colour, ShownImage } from "./viewer/progressive_renderer";
export {
  asViewerError,
  createViewer,
  type ProjectedPoint,
  type ScenePoint,
  type Viewer,
  type ViewerEvents,
  type ViewerOptions,
  type ViewerState,
} from "./viewer/viewer";
export { threeCamera } from "./volume/three_camera";
export { SnergVolume, type VolumeOptions } from "./volume/volume";
