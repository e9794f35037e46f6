// The renderer of three.js on a viewer's canvas.
import { WebGLRenderer } from "three";
import { ViewerError } from "../errors";

const NO_WEBGL =
  "This browser offers no WebGL 2, which renders the scene. Switch on graphics acceleration in its settings, or use a newer browser.";

/** Throws a ViewerError when the browser has no WebGL 2. fail: called when the driver refuses a shader. */
export function makeRenderer(canvas: HTMLCanvasElement, fail: (error: ViewerError) => void): WebGLRenderer {
  const options = { alpha: true, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" } as const;
  const context = canvas.getContext("webgl2", options);
  if (!context) throw new ViewerError(NO_WEBGL);
  const renderer = new WebGLRenderer({ canvas, context: context as never });
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, _vertex, fragment) => {
    const log = gl.getShaderInfoLog(fragment) || gl.getProgramInfoLog(program) || "it gives no reason";
    const reason = log
      .replace(/[\s\0]+/g, " ")
      .trim()
      .slice(0, 300);
    if (!gl.isContextLost()) fail(new ViewerError(`The graphics driver refuses the viewer's shader: ${reason}`));
  };
  return renderer;
}
