// Measuring lengths between points of the scene.
export { lengthText } from "./measure/length";
export { attach } from "./measure/tool";
