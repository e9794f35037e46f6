// Smooth edges: the average of images that are moved by fractions of a pixel.
import { type Camera, HalfFloatType, NearestFilter, WebGLRenderTarget } from "three";

const TIME = 1000; // milliseconds that the images of an average may take
const FEWEST = 4; // images: fewer make edges double, not smooth

/**
 * Where image k of `count`, a power of two, lies from the pixels' centres, in pixels to the right and up: the Hammersley set, one point in
 * each column and each row of count x count places. Its mean is 0, so that the average does not shift the picture.
 */
export function jitterOf(k: number, count: number): [number, number] {
  let mirrored = 0;
  for (let bit = 1, rest = k; bit < count; bit *= 2, rest >>= 1) mirrored = 2 * mirrored + (rest & 1);
  return [(k + 0.5) / count - 0.5, (mirrored + 0.5) / count - 0.5];
}

/** How many images to average, a power of two, when one takes that many milliseconds; 1 for no average. */
export function affordableSamples(most: number, milliseconds: number): number {
  const count = 2 ** Math.floor(Math.log2(Math.min(most, TIME / Math.max(milliseconds, 1))));
  return count >= FEWEST ? count : 1;
}

/** Call `draw` while the camera's image of width x height pixels shows what lies `jitter` pixels to the right of and above each pixel. */
export function withJitter(camera: Camera, [x, y]: [number, number], width: number, height: number, draw: () => void): void {
  const { elements } = camera.projectionMatrix;
  const before = [...elements];
  const [right, up] = [(2 * x) / width, (2 * y) / height];
  if (elements[15] === 1) {
    elements[12] -= right;
    elements[13] -= up;
  } else {
    elements[8] += right;
    elements[9] += up;
  }
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  draw();
  camera.projectionMatrix.fromArray(before);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
}

/** The images of an average, of which one is rendered at a time, band by band. */
export class Accumulation {
  readonly sample = target(); // the image that is being rendered
  readonly sum = target(); // of the images before it, each times 1 / count
  count = 0; // images of the average; 0 where none was begun
  taken = 0; // of them that are in the sum
  rows = 0; // of the next one that are rendered
  private readonly floats: boolean;

  constructor(gl: WebGL2RenderingContext) {
    this.floats = gl.getExtension("EXT_color_buffer_float") !== null; // 8 bits would round each image's share
    this.sum.texture.type = HalfFloatType;
  }

  /** Begin an average of at most that many images. milliseconds: that one takes. */
  begin(most: number, milliseconds: number, width: number, height: number): void {
    this.count = this.floats ? affordableSamples(most, milliseconds) : 1;
    this.taken = this.rows = 0;
    if (this.count === 1) return;
    this.sample.setSize(width, height);
    this.sum.setSize(width, height);
  }

  reset(): void {
    this.count = this.taken = this.rows = 0;
  }

  /** Whether nothing is left to do for a view of which at most that many images are averaged. */
  done(most: number): boolean {
    return most === 1 || this.count === 1 || (this.count > 0 && this.taken === this.count);
  }

  dispose(): void {
    this.sample.dispose();
    this.sum.dispose();
  }
}

const target = (): WebGLRenderTarget =>
  new WebGLRenderTarget(1, 1, { depthBuffer: false, generateMipmaps: false, minFilter: NearestFilter, magFilter: NearestFilter });
