// The annotations of a scene: texts at points of it, as labels with lines to them.
export { attach } from "./annotations/labels";
export { type Placed, placeLabels } from "./annotations/layout";
