// A picture of the view as a PNG.
import { drawCovering } from "./backdrop";

/** The PNG of an image's pixels, red, green, blue and straight alpha from the top left corner. backdrop: is put behind them. */
export function pngOf(
  pixels: Uint8ClampedArray<ArrayBuffer>,
  width: number,
  height: number,
  backdrop: HTMLImageElement | null,
): Promise<Blob> {
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d") as OffscreenCanvasRenderingContext2D;
  context.putImageData(new ImageData(pixels, width, height), 0, 0);
  if (backdrop?.naturalWidth) {
    context.globalCompositeOperation = "destination-over";
    drawCovering(context, backdrop);
  }
  return canvas.convertToBlob({ type: "image/png" });
}
