// Decodes PNG exactly. A canvas or an <img> may premultiply by alpha, convert colours, or add noise against fingerprinting; colours
// and features under a low alpha would be lost.
import { EXPORT_AGAIN, ViewerError } from "../errors";

const COLOUR_TYPES: Readonly<Record<number, number>> = { 1: 0, 3: 2, 4: 6 };
const SIGNATURE = [137, 80, 78, 71, 13, 10, 26, 10];

/**
 * The pixels of an 8-bit PNG of exactly this size and number of channels (1, 3 or 4): a Uint8Array, row by row.
 *
 * Throws a ViewerError that names the file where it is damaged or another image.
 */
export async function decodePng(bytes: Uint8Array, name: string, width: number, height: number, channels: number): Promise<Uint8Array> {
  const damaged = (why: string) => new ViewerError(`The file ${name} is damaged: ${why}. ${EXPORT_AGAIN}`);
  if (SIGNATURE.some((value, i) => bytes[i] !== value)) throw damaged("it is not a PNG");
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const parts: Uint8Array[] = [];
  let header: number[] | null = null;
  for (let offset = 8; offset + 12 <= bytes.length; ) {
    const length = view.getUint32(offset);
    const type = String.fromCharCode(...bytes.subarray(offset + 4, offset + 8));
    const body = bytes.subarray(offset + 8, offset + 8 + length);
    if (body.length < length) throw damaged("it is cut short");
    if (type === "IHDR") header = [view.getUint32(offset + 8), view.getUint32(offset + 12), ...bytes.subarray(offset + 16, offset + 21)];
    if (type === "IDAT") parts.push(body);
    offset += 12 + length;
  }
  const expected = [width, height, 8, COLOUR_TYPES[channels], 0, 0, 0];
  if (expected.some((value, i) => header?.[i] !== value)) {
    throw damaged(`it is not the image of ${width} x ${height} pixels and ${channels} channels that belongs here`);
  }
  const raw = await inflate(parts).catch(() => {
    throw damaged("its contents cannot be read");
  });
  const stride = width * channels;
  if (raw.length !== height * (stride + 1)) throw damaged("it is cut short");
  if (!unfilter(raw, height, stride, channels)) throw damaged("its contents cannot be read");
  return raw.subarray(0, height * stride);
}

async function inflate(parts: Uint8Array[]): Promise<Uint8Array> {
  const stream = new Blob(parts as BlobPart[]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/**
 * Undo the PNG filters in place, and remove the byte in front of each row that names its filter: every value is written before the
 * position it is read from. Returns false where a row has an unknown filter.
 */
function unfilter(raw: Uint8Array, height: number, stride: number, channels: number): boolean {
  for (let row = 0; row < height; row++) {
    const from = row * (stride + 1) + 1;
    const to = row * stride;
    const above = row > 0 ? to - stride : -1;
    const filter = raw[from - 1];
    if (filter === 0) {
      raw.copyWithin(to, from, from + stride);
    } else if (filter === 1) {
      for (let i = 0; i < stride; i++) raw[to + i] = raw[from + i] + (i >= channels ? raw[to + i - channels] : 0);
    } else if (filter === 2) {
      for (let i = 0; i < stride; i++) raw[to + i] = raw[from + i] + (above >= 0 ? raw[above + i] : 0);
    } else if (filter === 3) {
      for (let i = 0; i < stride; i++) {
        const left = i >= channels ? raw[to + i - channels] : 0;
        raw[to + i] = raw[from + i] + ((left + (above >= 0 ? raw[above + i] : 0)) >> 1);
      }
    } else if (filter === 4) {
      for (let i = 0; i < stride; i++) {
        const left = i >= channels ? raw[to + i - channels] : 0;
        const up = above >= 0 ? raw[above + i] : 0;
        raw[to + i] = raw[from + i] + paeth(left, up, i >= channels && above >= 0 ? raw[above + i - channels] : 0);
      }
    } else {
      return false;
    }
  }
  return true;
}

function paeth(left: number, up: number, corner: number): number {
  const a = Math.abs(up - corner);
  const b = Math.abs(left - corner);
  const c = Math.abs(left + up - 2 * corner);
  if (a <= b && a <= c) return left;
  return b <= c ? up : corner;
}
