// Quality presets: how many pixels, how much graphics memory and how much smoothing a device gets.
import { CELL_VOXELS, type SceneDescription } from "../data/scene";

export const QUALITIES = ["phone", "balanced", "full"] as const;
export type QualityName = (typeof QUALITIES)[number];
export const AUTOMATIC = "auto"; // the preset that suits the device

export interface Preset {
  pixelRatio: number; // device pixels a CSS pixel, at most
  pixels: number; // of the image, at most
  graphicsBytes: number; // of a scene's texels, at most; above it the scene at a quarter of its resolution is shown
  samples: number; // images that are averaged when nothing moves, at most
}

const MEBIBYTE = 2 ** 20;

export const PRESETS: Readonly<Record<QualityName, Preset>> = {
  phone: { pixelRatio: 1.5, pixels: 1e6, graphicsBytes: 128 * MEBIBYTE, samples: 4 },
  balanced: { pixelRatio: 2, pixels: 2.5e6, graphicsBytes: 512 * MEBIBYTE, samples: 8 },
  full: { pixelRatio: 2, pixels: Number.POSITIVE_INFINITY, graphicsBytes: Number.POSITIVE_INFINITY, samples: 16 },
};

/** What a browser tells about its device. */
export interface Device {
  memory: number | null; // gigabytes of main memory, 8 also for more; null where the browser does not tell
  touch: boolean; // whether fingers are what it is used with
  shortSide: number; // of its screen, in CSS pixels
  textureLimit: number; // texels along a side of a 3D texture
}

export function readDevice(gl: WebGL2RenderingContext): Device {
  return {
    memory: (navigator as Navigator & { deviceMemory?: number }).deviceMemory ?? null,
    touch: matchMedia("(pointer: coarse)").matches,
    shortSide: Math.min(screen.width, screen.height),
    textureLimit: gl.getParameter(gl.MAX_3D_TEXTURE_SIZE),
  };
}

const PHONE = { memory: 2, shortSide: 600, textureLimit: 512 };
const BALANCED = { memory: 4, textureLimit: 1024 };

/** The preset for a device. */
export function presetFor({ memory, touch, shortSide, textureLimit }: Device): QualityName {
  const gigabytes = memory ?? Number.POSITIVE_INFINITY;
  if ((touch && shortSide < PHONE.shortSide) || gigabytes <= PHONE.memory || textureLimit < PHONE.textureLimit) return "phone";
  return touch || gigabytes <= BALANCED.memory || textureLimit < BALANCED.textureLimit ? "balanced" : "full";
}

/** The preset of that name; null for AUTOMATIC, no name and a name that is none. */
export const qualityOf = (name: string | null): QualityName | null => QUALITIES.find((quality) => quality === name) ?? null;

/** The device pixels a CSS pixel, of an image of that size in CSS pixels. */
export function pixelRatioOf(preset: Preset, width: number, height: number, devicePixelRatio: number): number {
  return Math.min(devicePixelRatio || 1, preset.pixelRatio, Math.sqrt(preset.pixels / (width * height)));
}

/** Why a preset does not allow a scene, or null. */
export function tooMuchFor(name: QualityName, scene: SceneDescription): string | null {
  const bytes = scene.cells * CELL_VOXELS ** 3 * 4 * (scene.network ? 2 : 1);
  if (bytes <= PRESETS[name].graphicsBytes) return null;
  const [needed, allowed] = [bytes, PRESETS[name].graphicsBytes].map((size) => Math.ceil(size / MEBIBYTE));
  return `the whole takes ${needed} MB of graphics memory, and the quality “${name}” allows ${allowed} MB`;
}
