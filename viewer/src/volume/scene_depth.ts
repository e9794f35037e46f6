// The depth of what was drawn before a volume: a copy of the depth buffer, which a shader may not read while it is drawn to.

import type { DepthTexturePixelFormat, TextureDataType, WebGLRenderer } from "three";
import {
  DepthFormat,
  DepthStencilFormat,
  DepthTexture,
  FloatType,
  UnsignedInt248Type,
  UnsignedIntType,
  UnsignedShortType,
  WebGLRenderTarget,
} from "three";

// A depth buffer can be copied only into one of its own format, and nobody says which the canvas has.
const FORMATS: readonly [DepthTexturePixelFormat, TextureDataType][] = [
  [DepthFormat, UnsignedIntType],
  [DepthStencilFormat, UnsignedInt248Type],
  [DepthFormat, FloatType],
  [DepthFormat, UnsignedShortType],
];

/** A copy of the depth buffer of whatever a renderer draws to. One serves all volumes of a renderer. */
export class SceneDepth {
  private static readonly known = new WeakMap<WebGLRenderer, SceneDepth>();
  private copies = new Map<string, WebGLRenderTarget | null>(); // by the size; null where no format can be copied

  static of(renderer: WebGLRenderer): SceneDepth {
    const depth = SceneDepth.known.get(renderer) ?? new SceneDepth(renderer);
    SceneDepth.known.set(renderer, depth);
    return depth;
  }

  private constructor(private readonly renderer: WebGLRenderer) {}

  /** The depth drawn so far, as a texture; null where there is no depth buffer, or it cannot be copied. */
  copy(): DepthTexture | null {
    const gl = this.renderer.getContext() as WebGL2RenderingContext;
    const target = this.renderer.getRenderTarget();
    const screen = !target || (target as { isXRRenderTarget?: boolean }).isXRRenderTarget; // a headset's buffers are like the canvas's
    if (screen ? !gl.getContextAttributes()?.depth : !target.depthBuffer) return null;
    const [width, height] = target ? [target.width, target.height] : [gl.drawingBufferWidth, gl.drawingBufferHeight];
    const key = `${target ? (target.texture.id ?? 0) : "canvas"} ${width} ${height}`;
    let copied = this.copies.get(key);
    if (copied && this.blit(gl, copied)) return copied.depthTexture;
    if (copied === null) return null;
    copied?.dispose(); // it was lost with the graphics context
    this.forget();
    for (const [format, type] of FORMATS) {
      const depthTexture = new DepthTexture(width, height, type);
      depthTexture.format = format;
      copied = new WebGLRenderTarget(width, height, { depthTexture, stencilBuffer: format === DepthStencilFormat });
      this.renderer.initRenderTarget(copied);
      while (gl.getError() !== gl.NO_ERROR); // errors of earlier calls
      if (this.blit(gl, copied) && gl.getError() === gl.NO_ERROR) {
        this.copies.set(key, copied);
        return depthTexture;
      }
      copied.dispose();
    }
    this.copies.set(key, null);
    console.warn("SNeRG: the depth buffer cannot be copied here, so that volumes are drawn over everything else.");
    return null;
  }

  /** Keep few copies: a target that was resized or thrown away leaves one behind. */
  private forget(): void {
    if (this.copies.size < 4) return;
    for (const copied of this.copies.values()) copied?.dispose();
    this.copies.clear();
  }

  private blit(gl: WebGL2RenderingContext, copied: WebGLRenderTarget): boolean {
    const properties = this.renderer.properties.get(copied) as { __webglFramebuffer?: WebGLFramebuffer };
    if (!properties.__webglFramebuffer) return false;
    const [read, draw, scissor] = [gl.READ_FRAMEBUFFER_BINDING, gl.DRAW_FRAMEBUFFER_BINDING, gl.SCISSOR_TEST].map((name) =>
      gl.getParameter(name),
    );
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, draw);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, properties.__webglFramebuffer);
    if (scissor) gl.disable(gl.SCISSOR_TEST);
    const { width, height } = copied;
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.DEPTH_BUFFER_BIT, gl.NEAREST);
    if (scissor) gl.enable(gl.SCISSOR_TEST);
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, read);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, draw);
    return true;
  }
}
