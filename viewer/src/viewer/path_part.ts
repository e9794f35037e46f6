// What plays camera paths. As path.js it leaves itself in the page as `snergPath` (see build.mjs).
export { CameraPath, type PathCamera, PathPlayer, type PathState, pathOf } from "./path";
export { PathBar } from "./path_bar";
