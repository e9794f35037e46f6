// Opaque pictures (WebP, JPEG, AVIF) by the browser's own decoders. Nothing here has alpha, so a canvas has nothing to premultiply.
import { EXPORT_AGAIN, Problem } from "./problem.js";

/** The pixels of a picture that must have exactly this size, row by row, red, green, blue and 255. */
export async function decodeOpaque(bytes, name, width, height, type) {
  const bitmap = await createImageBitmap(new Blob([bytes], { type }), { colorSpaceConversion: "none", premultiplyAlpha: "none" }).catch(() => {
    throw new Problem(`The file ${name} cannot be shown: it is damaged, or this browser knows no ${type}. ${EXPORT_AGAIN}`);
  });
  if (bitmap.width !== width || bitmap.height !== height) {
    throw new Problem(`The file ${name} is damaged: it is not the picture of ${width} x ${height} pixels that belongs here. ${EXPORT_AGAIN}`);
  }
  const context = contextOf(width, height);
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return context.getImageData(0, 0, width, height).data;
}

function contextOf(width, height) {
  const context = new OffscreenCanvas(width, height).getContext("2d", { alpha: false, willReadFrequently: true });
  context.fillStyle = "#205080";
  context.fillRect(0, 0, 1, 1);
  const [red, green, blue] = context.getImageData(0, 0, 1, 1).data;
  if (Math.max(Math.abs(red - 32), Math.abs(green - 80), Math.abs(blue - 128)) > 2) {
    throw new Problem(
      "This browser's protection against fingerprinting hides the scene's pictures. Allow this page to read canvases, or export it with the codec png.",
    );
  }
  return context;
}
