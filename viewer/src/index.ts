// The package: a scene's loader, an object of three.js, a viewer, and an element.
export { type PartName, readCameras, type SnergCamera, type WorldUnits } from "./data/cameras";
export { ChosenFiles, EmbeddedFiles, type FileSource, type SceneFiles, ServerFiles } from "./data/files";
export type { SceneDescription } from "./data/scene";
export { type LoadOptions, type LoadProgress, SnergScene } from "./data/snerg_scene";
export { asViewerError, ViewerError } from "./errors";
export type { BenchmarkOptions, BenchmarkResult } from "./optional/benchmark";
export { CameraPath, type PathCamera, PathPlayer, type PathState, pathOf } from "./optional/path";
export { defineElement, SnergViewerElement } from "./viewer/element";
export type {
  Bundle,
  Lent,
  ProjectedPoint,
  ScenePoint,
  Viewer,
  ViewerEvents,
  ViewerOptions,
  ViewerState,
} from "./viewer/interface";
export type { Colour, ShownImage } from "./viewer/progressive_renderer";
export type { QualityName } from "./viewer/quality";
export { createViewer } from "./viewer/viewer";
export { threeCamera } from "./volume/three_camera";
export { type GrowthOptions, SnergVolume, type VolumeOptions } from "./volume/volume";
