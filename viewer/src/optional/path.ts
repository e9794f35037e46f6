// Camera paths: read, played, and a row above the bar that plays them.
export { PathBar } from "./path/bar";
export { CameraPath, type PathCamera, PathPlayer, type PathState, pathOf } from "./path/path";
