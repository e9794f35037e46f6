// Reads the images that hold a slice of the atlas: four Z planes, one below the other (core/export/codecs.py).
import type { FileSource } from "./files";
import { decodeOpaque } from "./image";
import { decodePng } from "./png";
import { CELL_VOXELS, type SceneDescription } from "./scene";

export const SLICE_PLANES = 4; // Z planes a slice

// `bounded`: the codec is lossy, and its values are limited to alpha.
const CODECS = {
  webp: { suffix: "webp", type: "image/webp", bounded: false },
  jpeg: { suffix: "jpg", type: "image/jpeg", bounded: true },
  avif: { suffix: "avif", type: "image/avif", bounded: true },
};

/** Four bytes a texel, x fastest. */
export interface SliceTexels {
  rgba: Uint8Array;
  feature: Uint8Array | null; // null in a diffuse scene
}

/** How many slices a scene has. */
export const sliceCount = (scene: SceneDescription): number => (scene.atlas_blocks[2] * CELL_VOXELS) / SLICE_PLANES;

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
  const png = async (kind: string, channels: number) => {
    const name = `${folder}${kind}_${number}.png`;
    return decodePng(await source.read(name, signal), name, width, height, channels);
  };
  const viewDependent = scene.network !== null;
  if (scene.codec.name === "png") {
    const [rgba, feature] = await Promise.all([png("rgba", 4), viewDependent ? png("feature", 4) : null]);
    return { rgba, feature };
  }
  const { suffix, type, bounded } = CODECS[scene.codec.name];
  const opaque = async (kind: string, rows: number) => {
    const name = `${folder}${kind}_${number}.${suffix}`;
    return decodeOpaque(await source.read(name, signal), name, width, rows, type);
  };
  const [alpha, rgb, feature] = await Promise.all([
    png("alpha", 1),
    opaque("rgb", height),
    viewDependent ? opaque("feature", 2 * height) : null,
  ]);
  return mergeAlpha(alpha, rgb, feature, bounded);
}

/**
 * Texels from images without alpha: `alpha` one byte a pixel; `rgb` and `feature` four, of which the last is unused. The fourth
 * feature is stored in the lower half of the feature image, as grey.
 */
function mergeAlpha(alpha: Uint8Array, rgb: Uint8ClampedArray, feature: Uint8ClampedArray | null, bounded: boolean): SliceTexels {
  const pixels = alpha.length;
  for (let i = 0; i < pixels; i++) {
    rgb[4 * i + 3] = alpha[i];
    if (feature) feature[4 * i + 3] = feature[4 * (pixels + i) + 1];
  }
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
