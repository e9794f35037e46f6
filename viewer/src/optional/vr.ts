// The scene in a headset (WebXR).
export { attach } from "./vr/session";
