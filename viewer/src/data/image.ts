// Decodes images without alpha (WebP, JPEG XL, JPEG, AVIF) by the browser's own decoders. Images with alpha are PNG (png.ts): a canvas
// would premultiply them.
import { EXPORT_AGAIN, ViewerError } from "../errors";

/**
 * The pixels of an image of exactly this size: a Uint8ClampedArray of red, green, blue and 255 a pixel, row by row. type: its MIME
 * type. Throws a ViewerError where it is damaged or of another size, or where this browser cannot decode it or alters canvases.
 */
export async function decodeOpaque(
  bytes: Uint8Array,
  name: string,
  width: number,
  height: number,
  type: string,
): Promise<Uint8ClampedArray> {
  const options: ImageBitmapOptions = { colorSpaceConversion: "none", premultiplyAlpha: "none" };
  const bitmap = await createImageBitmap(new Blob([bytes as BlobPart], { type }), options).catch(() => {
    throw new ViewerError(`The file ${name} cannot be shown: it is damaged, or this browser knows no ${type}. ${EXPORT_AGAIN}`);
  });
  if (bitmap.width !== width || bitmap.height !== height) {
    const expected = `the image of ${width} x ${height} pixels that belongs here`;
    throw new ViewerError(`The file ${name} is damaged: it is not ${expected}. ${EXPORT_AGAIN}`);
  }
  const context = contextOf(width, height);
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return context.getImageData(0, 0, width, height).data;
}

// Images of one pixel of the colour PROBE_COLOUR, in formats that some browsers do not decode: base64.
const PROBES: Readonly<Record<string, string>> = { jxl: "/woAEBAJCAABADQASxiLFcJBwuEBnAADAQ==" };
const PROBE_COLOUR = [32, 80, 128];

/** Whether this browser decodes a codec, exactly: asked of its decoder, since no list of formats is to be had. */
export async function decodes(name: string): Promise<boolean> {
  if (!(name in PROBES)) return true;
  try {
    const bytes = Uint8Array.from(atob(PROBES[name]), (character) => character.charCodeAt(0));
    const pixel = await decodeOpaque(bytes, name, 1, 1, `image/${name}`);
    return PROBE_COLOUR.every((value, i) => pixel[i] === value);
  } catch {
    return false;
  }
}

/** A canvas of that size; its colours are tested, since browsers that resist fingerprinting return noise. */
function contextOf(width: number, height: number): OffscreenCanvasRenderingContext2D {
  const context = new OffscreenCanvas(width, height).getContext("2d", { alpha: false, willReadFrequently: true });
  if (!context) throw new ViewerError("This browser offers no canvas, which decodes the scene's images. Use a newer browser.");
  context.fillStyle = "#205080";
  context.fillRect(0, 0, 1, 1);
  const [red, green, blue] = context.getImageData(0, 0, 1, 1).data;
  if (Math.max(Math.abs(red - 32), Math.abs(green - 80), Math.abs(blue - 128)) > 2) {
    throw new ViewerError(
      "This browser's protection against fingerprinting alters the scene's images. Allow this page to read canvases, " +
        "or export it with the codec png.",
    );
  }
  return context;
}
