// The atlas on the graphics card: cells laid out as this device allows, and tables of what can be skipped.
import {
  Box3,
  ClampToEdgeWrapping,
  Data3DTexture,
  IntType,
  LinearFilter,
  NearestFilter,
  RGBAFormat,
  RedFormat,
  RedIntegerFormat,
  UnsignedByteType,
  Vector3,
} from "three";
import { readFile } from "./files.js";
import { decodeOpaque } from "./picture.js";
import { decodePng } from "./png.js";
import { Problem } from "./problem.js";
import { CELL_VOXELS } from "./scene.js";

const PLANES = 4; // Z planes a picture
const COARSE = 4; // texels along an axis of a coarse voxel, the unit of skipping within a cell
const COARSE_CELL = CELL_VOXELS / COARSE;
const COARSE_BYTES = COARSE_CELL ** 3;
const PARALLEL = 3; // slices on their way at a time
const CODECS = {
  png: {},
  webp: { suffix: "webp", type: "image/webp", bounded: false },
  jpeg: { suffix: "jpg", type: "image/jpeg", bounded: true },
  avif: { suffix: "avif", type: "image/avif", bounded: true },
};

/**
 * How to hold that many cells: `pages` atlases of `blocks` cells along x, y and z, none over `limit` texels on a side.
 *
 * The files have a layout of their own, for which a device may be too small (WebGL 2 promises 256 texels); cells are moved one
 * by one, so any layout is as good. The one here is nearly a cube, which wastes little.
 */
export function layoutOf(cells, limit, mostPages) {
  const side = Math.min(Math.floor(limit / CELL_VOXELS), 255);
  const pages = Math.max(1, Math.ceil(cells / side ** 3));
  if (side < 1 || pages > mostPages) {
    throw new Problem(
      `The scene's texture is too large for this device: it has ${cells} blocks, and the graphics driver holds ` +
        `${mostPages * side ** 3} (3D textures of ${limit} texels a side). Bake it at a lower resolution, or use another device.`,
    );
  }
  const each = Math.max(1, Math.ceil(cells / pages));
  const x = Math.min(side, Math.ceil(Math.cbrt(each) - 1e-9));
  const y = Math.ceil(Math.sqrt(each / x) - 1e-9);
  return { pages, blocks: [x, y, Math.ceil(each / (x * y))], each };
}

/** Where cell i stands: [page, x, y, z] in cells. */
function place({ blocks: [x, y], each }, i) {
  const j = i % each;
  return [Math.floor(i / each), j % x, Math.floor(j / x) % y, Math.floor(j / (x * y))];
}

/** The scene's textures; `report(done, total)` hears of every slice that arrived. */
export class Atlas {
  constructor(renderer, scene) {
    const gl = renderer.getContext();
    this.renderer = renderer;
    this.scene = scene;
    this.kinds = scene.network ? ["rgba", "feature"] : ["rgba"];
    const limit = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const units = gl.getParameter(gl.MAX_TEXTURE_IMAGE_UNITS) - 1; // one is the indirection grid's
    if (Math.max(...scene.blocks) > limit) {
      throw new Problem(`The scene's grid is too large for this device: ${scene.blocks.join(" x ")} blocks, and it holds ${limit} a side.`);
    }
    this.layout = layoutOf(scene.cells, limit, Math.floor(units / (this.kinds.length + 1)));
    this.occupied = new Uint8Array(scene.cells * COARSE_BYTES);
    const size = this.layout.blocks.map((n) => n * CELL_VOXELS);
    this.pages = Object.fromEntries(
      this.kinds.map((kind) => [kind, Array.from({ length: this.layout.pages }, () => this.allocate(...size))]),
    );
    this.bytes = this.layout.pages * size[0] * size[1] * size[2] * 4 * this.kinds.length;
  }

  /** An atlas texture in the card's memory, without a copy of it in ours. */
  allocate(...size) {
    const texture = texture3D(null, size, { format: RGBAFormat, type: UnsignedByteType, filter: LinearFilter });
    texture.source.dataReady = false;
    const gl = this.renderer.getContext();
    while (gl.getError() !== gl.NO_ERROR);
    this.renderer.initTexture(texture);
    if (gl.getError() !== gl.NO_ERROR) {
      const megabytes = Math.ceil((this.layout.pages * size[0] * size[1] * size[2] * 4 * this.kinds.length) / 2 ** 20);
      throw new Problem(`The scene's texture is too large: this device's graphics memory does not hold its ${megabytes} MiB.`);
    }
    return texture;
  }

  /** Fetch, decode and upload every slice, a few at a time; each is let go of once it is on the card. */
  async load(folder, report) {
    const total = (this.scene.atlas_blocks[2] * CELL_VOXELS) / PLANES;
    let [next, done] = [0, 0];
    const work = async () => {
      while (next < total) {
        const slice = next++;
        const pictures = await this.read(folder, String(slice).padStart(3, "0"));
        for (const kind of this.kinds) this.upload(kind, slice, pictures[kind]);
        report(++done, total);
      }
    };
    await Promise.all(Array.from({ length: PARALLEL }, work));
  }

  /** A slice of each texture, four bytes a voxel, from the pictures that the scene's codec made of it (core/export/codecs.py). */
  async read(folder, number) {
    const [width, height] = [this.scene.atlas_blocks[0] * CELL_VOXELS, PLANES * this.scene.atlas_blocks[1] * CELL_VOXELS];
    const file = async (kind, suffix) => {
      const name = `${folder}/${kind}_${number}.${suffix}`;
      return [await readFile(name), name];
    };
    const png = async (kind, channels) => decodePng(...(await file(kind, "png")), width, height, channels);
    const { suffix, type, bounded } = CODECS[this.scene.codec.name];
    if (!suffix) return Object.fromEntries(await Promise.all(this.kinds.map(async (kind) => [kind, await png(kind, 4)])));
    const opaque = async (kind, rows) => decodeOpaque(...(await file(kind, suffix)), width, rows, type);
    const view = this.scene.network !== null;
    const [alpha, rgb, feature] = await Promise.all([png("alpha", 1), opaque("rgb", height), view ? opaque("feature", 2 * height) : null]);
    const pixels = width * height;
    for (let i = 0; i < pixels; i++) rgb[4 * i + 3] = alpha[i];
    if (view) for (let i = 0; i < pixels; i++) feature[4 * i + 3] = feature[4 * (pixels + i) + 1];
    if (bounded) {
      // What is empty stays empty: a lossy codec makes a haze of it.
      for (let i = 0; i < pixels; i++) {
        for (let j = 4 * i; j < 4 * i + 4; j++) {
          if (rgb[j] > alpha[i]) rgb[j] = alpha[i];
          if (view && feature[j] > alpha[i]) feature[j] = alpha[i];
        }
      }
    }
    const bytes = (data) => new Uint8Array(data.buffer, 0, 4 * pixels);
    return { rgba: bytes(rgb), feature: view ? bytes(feature) : null };
  }

  upload(kind, slice, pixels) {
    const [bx, by] = this.scene.atlas_blocks;
    const [width, height] = [bx * CELL_VOXELS, by * CELL_VOXELS];
    const source = texture3D(pixels, [width, height, PLANES], { format: RGBAFormat, type: UnsignedByteType, filter: LinearFilter });
    const words = new Uint32Array(pixels.buffer, 0, pixels.length / 4);
    const layer = Math.floor((slice * PLANES) / CELL_VOXELS);
    const z = (slice * PLANES) % CELL_VOXELS;
    for (let i = layer * bx * by; i < Math.min((layer + 1) * bx * by, this.scene.cells); i++) {
      const x = (i % bx) * CELL_VOXELS;
      const y = (Math.floor(i / bx) % by) * CELL_VOXELS;
      this.mark(words, x + y * width, width, height, i, z / COARSE);
      const [page, px, py, pz] = place(this.layout, i);
      this.renderer.copyTextureToTexture(
        source,
        this.pages[kind][page],
        new Box3(new Vector3(x, y, 0), new Vector3(x + CELL_VOXELS, y + CELL_VOXELS, PLANES)),
        new Vector3(px * CELL_VOXELS, py * CELL_VOXELS, pz * CELL_VOXELS + z),
      );
    }
  }

  /** Note which coarse voxels of a cell hold anything in these four planes. */
  mark(words, start, width, height, cell, coarseZ) {
    for (let z = 0; z < PLANES; z++) {
      for (let y = 0; y < CELL_VOXELS; y++) {
        const row = start + (z * height + y) * width;
        for (let x = 0; x < CELL_VOXELS; x++) {
          if (words[row + x] !== 0) this.touch(cell, x, y, coarseZ * COARSE + z);
        }
      }
    }
  }

  /** A texel weighs on samples up to one texel away from its centre: at a coarse voxel's border on the neighbour too. */
  touch(cell, x, y, z) {
    const low = (i) => Math.max(0, (i - 1) >> 2);
    const high = (i) => Math.min(COARSE_CELL - 1, (i + 1) >> 2);
    for (let cz = low(z); cz <= high(z); cz++) {
      for (let cy = low(y); cy <= high(y); cy++) {
        const row = cell * COARSE_BYTES + (cz * COARSE_CELL + cy) * COARSE_CELL;
        for (let cx = low(x); cx <= high(x); cx++) this.occupied[row + cx] = 1;
      }
    }
  }

  /** A page's distances: for each coarse voxel 0 if it holds something, else how far the nearest in its cell that does. */
  skipTextures() {
    const [x, y, z] = this.layout.blocks.map((n) => n * COARSE_CELL);
    const pages = Array.from({ length: this.layout.pages }, () => new Uint8Array(x * y * z));
    const size = [COARSE_CELL, COARSE_CELL, COARSE_CELL];
    for (let i = 0; i < this.scene.cells; i++) {
      const distances = chebyshev(this.occupied.subarray(i * COARSE_BYTES, (i + 1) * COARSE_BYTES), size);
      const [page, px, py, pz] = place(this.layout, i);
      for (let row = 0; row < COARSE_CELL ** 2; row++) {
        const cy = py * COARSE_CELL + (row % COARSE_CELL);
        const cz = pz * COARSE_CELL + Math.floor(row / COARSE_CELL);
        pages[page].set(distances.subarray(row * COARSE_CELL, (row + 1) * COARSE_CELL), (cz * y + cy) * x + px * COARSE_CELL);
      }
    }
    this.occupied = null;
    return pages.map((data) => texture3D(data, [x, y, z], { format: RedFormat, type: UnsignedByteType, filter: NearestFilter }));
  }

  /**
   * The indirection grid: a cell's place as page << 24 | z << 16 | y << 8 | x, or minus the distance in blocks to the nearest
   * block that has a cell.
   */
  indirectionTexture(cells) {
    const distances = chebyshev(
      Uint8Array.from(cells, (cell) => (cell >= 0 ? 1 : 0)),
      this.scene.blocks,
    );
    const data = Int32Array.from(cells, (cell, i) => {
      if (cell < 0) return -distances[i];
      const [page, x, y, z] = place(this.layout, cell);
      return (page << 24) | (z << 16) | (y << 8) | x;
    });
    const texture = texture3D(data, this.scene.blocks, { format: RedIntegerFormat, type: IntType, filter: NearestFilter });
    texture.internalFormat = "R32I";
    return texture;
  }
}

function texture3D(data, [width, height, depth], { format, type, filter }) {
  const texture = new Data3DTexture(data, width, height, depth);
  Object.assign(texture, { format, type, minFilter: filter, magFilter: filter, unpackAlignment: 1, needsUpdate: true });
  texture.wrapS = texture.wrapT = texture.wrapR = ClampToEdgeWrapping;
  return texture;
}

/** Distance in the maximum norm to the nearest nonzero entry, 0 there, at most 255; x fastest. Two sweeps over 13 neighbours. */
export function chebyshev(occupied, [nx, ny, nz]) {
  const distance = Uint8Array.from(occupied, (value) => (value ? 0 : 255));
  const behind = [];
  for (let i = 0; i < 13; i++) behind.push([(i % 3) - 1, (Math.floor(i / 3) % 3) - 1, Math.floor(i / 9) - 1]);
  for (const sign of [1, -1]) {
    for (let j = 0; j < distance.length; j++) {
      const at = sign > 0 ? j : distance.length - 1 - j;
      const [x, y, z] = [at % nx, Math.floor(at / nx) % ny, Math.floor(at / (nx * ny))];
      let best = distance[at];
      if (best === 0) continue;
      for (const [ox, oy, oz] of behind) {
        const [u, v, w] = [x + sign * ox, y + sign * oy, z + sign * oz];
        if (u < 0 || v < 0 || w < 0 || u >= nx || v >= ny || w >= nz) continue;
        best = Math.min(best, distance[(w * ny + v) * nx + u] + 1);
      }
      distance[at] = best;
    }
  }
  return distance;
}
