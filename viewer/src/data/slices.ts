// Reads the images that hold a slice of the atlas: four Z planes, one below the other (core/export/codecs.py).
import type { FileSource } from "./files";
import { decodeOpaque } from "./image";
import { decodePng } from "./png";
import { CELL_VOXELS, type SceneDescription } from "./scene";

export const SLICE_PLANES = 4; // Z planes a slice

// `bounded`: the codec is lossy, and its values are limited to alpha. `grey`: alpha is stored with this codec, too, in place of PNG.
const CODECS = {
  jxl: { suffix: "jxl", type: "image/jxl", bounded: false, grey: true },
  webp: { suffix: "webp", type: "image/webp", bounded: false, grey: false },
  jpeg: { suffix: "jpg", type: "image/jpeg", bounded: true, grey: false },
  avif: { suffix: "avif", type: "image/avif", bounded: true, grey: false },
};

/** Four bytes a texel, x fastest. */
export interface SliceTexels {
  rgba: Uint8Array;
  feature: Uint8Array | null; // null in a diffuse scene
}

/** Slices that hold a layer of cells. */
export const LAYER_SLICES = CELL_VOXELS / SLICE_PLANES;

/** All slices, layer by layer: first those of the layers in `order`. */
export function sliceOrder(scene: SceneDescription, order: readonly number[] = []): number[] {
  const layers = new Set([...order, ...Array(scene.atlas_blocks[2]).keys()].filter((layer) => layer < scene.atlas_blocks[2]));
  return [...layers].flatMap((layer) => Array.from({ length: LAYER_SLICES }, (_, i) => layer * LAYER_SLICES + i));
}

/** The texels of a slice. Rejects with a ViewerError that names a file which is missing or damaged, or with the signal's reason. */
export async function readSlice(
  scene: SceneDescription,
  source: FileSource,
  folder: string,
  slice: number,
  signal?: AbortSignal,
): Promise<SliceTexels> {
  const number = String(slice).padStart(3, "0");
  const width = scene.atlas_blocks[0] * CELL_VOXELS;
  const height = SLICE_PLANES * scene.atlas_blocks[1] * CELL_VOXELS;
  const png = async (kind: string, channels: number, columns = width, rows = height) => {
    const name = `${folder}${kind}_${number}.png`;
    return decodePng(await source.read(name, signal), name, columns, rows, channels);
  };
  const viewDependent = scene.network !== null;
  const half = scene.codec.half_features === true;
  const [featureWidth, featureHeight] = half ? [width / 2, height / 4] : [width, height];
  if (scene.codec.name === "png") {
    const features = viewDependent ? png("feature", 4, featureWidth, featureHeight) : null;
    const [rgba, feature] = await Promise.all([png("rgba", 4), features]);
    return { rgba, feature: feature && half ? restoreFeatures(feature, rgba, width) : feature };
  }
  const { suffix, type, bounded, grey } = CODECS[scene.codec.name];
  const opaque = async (kind: string, columns: number, rows: number) => {
    const name = `${folder}${kind}_${number}.${suffix}`;
    return decodeOpaque(await source.read(name, signal), name, columns, rows, type);
  };
  const [alpha, rgb, feature] = await Promise.all([
    grey ? opaque("alpha", width, height).then(firstChannel) : png("alpha", 1),
    opaque("rgb", width, height),
    viewDependent ? opaque("feature", featureWidth, 2 * featureHeight) : null,
  ]);
  if (!half || !feature) return mergeAlpha(alpha, rgb, feature, bounded);
  const { rgba } = mergeAlpha(alpha, rgb, null, bounded);
  return { rgba, feature: restoreFeatures(mergeGrey(feature), rgba, width) };
}

/**
 * Features of a slice from those at half its resolution: a straight value for each 2 x 2 x 2 texels, times each texel's alpha. Both
 * have four bytes a texel (core/export/half_features.py).
 */
function restoreFeatures(straight: Uint8Array | Uint8ClampedArray, rgba: Uint8Array, width: number): Uint8Array {
  const whole = new Uint8Array(rgba.length);
  const planeHeight = rgba.length / 4 / width / SLICE_PLANES;
  for (let row = 0; row < SLICE_PLANES * planeHeight; row++) {
    const plane = Math.floor(row / planeHeight) >> 1;
    const from = (plane * (planeHeight / 2) + ((row % planeHeight) >> 1)) * (width / 2);
    for (let x = 0; x < width; x++) {
      const [to, source] = [4 * (row * width + x), 4 * (from + (x >> 1))];
      const alpha = rgba[to + 3];
      if (alpha > 0) for (let i = 0; i < 4; i++) whole[to + i] = (straight[source + i] * alpha + 127) / 255;
    }
  }
  return whole;
}

/** The upper half of an image, with the grey of its lower half as fourth channel. */
function mergeGrey(pixels: Uint8ClampedArray): Uint8ClampedArray {
  const half = pixels.length / 2;
  for (let i = 0; i < half; i += 4) pixels[i + 3] = pixels[half + i + 1];
  return pixels.subarray(0, half);
}

/** One byte a pixel of an image of four. */
function firstChannel(pixels: Uint8ClampedArray): Uint8Array {
  return Uint8Array.from({ length: pixels.length / 4 }, (_, i) => pixels[4 * i]);
}

/**
 * Texels from images without alpha: `alpha` one byte a pixel; `rgb` and `feature` four, of which the last is unused. The fourth
 * feature is stored in the lower half of the feature image, as grey.
 */
function mergeAlpha(alpha: Uint8Array, rgb: Uint8ClampedArray, feature: Uint8ClampedArray | null, bounded: boolean): SliceTexels {
  const pixels = alpha.length;
  for (let i = 0; i < pixels; i++) rgb[4 * i + 3] = alpha[i];
  if (feature) mergeGrey(feature);
  if (bounded) {
    // Values are premultiplied by alpha, hence at most alpha. A lossy codec exceeds it, which would show as haze in empty space.
    for (let i = 0; i < pixels; i++) {
      for (let j = 4 * i; j < 4 * i + 4; j++) {
        if (rgb[j] > alpha[i]) rgb[j] = alpha[i];
        if (feature && feature[j] > alpha[i]) feature[j] = alpha[i];
      }
    }
  }
  const bytes = (data: Uint8ClampedArray) => new Uint8Array(data.buffer, data.byteOffset, 4 * pixels);
  return { rgba: bytes(rgb), feature: feature ? bytes(feature) : null };
}
