// The scene in a headset (WebXR).
export { placement } from "./vr/placement";
export { attach } from "./vr/session";
