// The textures of a scene on the graphics card: the atlas, the indirection grid, and distances for empty-space skipping.
import {
  Box3,
  ClampToEdgeWrapping,
  Data3DTexture,
  IntType,
  LinearFilter,
  type MagnificationTextureFilter,
  NearestFilter,
  type PixelFormat,
  RedFormat,
  RedIntegerFormat,
  RGBAFormat,
  type TextureDataType,
  UnsignedByteType,
  Vector3,
  type WebGLRenderer,
} from "three";
import { CELL_VOXELS, type SceneDescription } from "../data/scene";
import { LAYER_SLICES, SLICE_PLANES, type SliceTexels } from "../data/slices";
import { TooLarge } from "../errors";
import { type AtlasLayout, atlasLayout, cellPosition } from "./atlas_layout";
import { chebyshevDistance } from "./distance";

const COARSE_TEXELS = 4; // texels of a coarse voxel along an axis; within a cell, rays skip coarse voxels
const COARSE_PER_CELL = CELL_VOXELS / COARSE_TEXELS; // along an axis
const COARSE_BYTES = COARSE_PER_CELL ** 3; // a cell, at one byte a coarse voxel

type Kind = "rgba" | "feature";
type Triple = [number, number, number];

/** The textures that the shader reads: one a page, and the indirection grid. */
export interface AtlasTextures {
  rgba: Data3DTexture[];
  feature: Data3DTexture[]; // none in a diffuse scene
  distance: Data3DTexture[];
  indirection: Data3DTexture;
}

/** The textures of a scene. The constructor throws TooLarge when this device cannot hold them. */
export class Atlas {
  readonly kinds: Kind[];
  readonly layout: AtlasLayout;
  readonly size: Triple; // texels of a page along x, y and z
  readonly bytes: number; // of graphics memory that the pages take
  strayFeatures = false; // whether a voxel of alpha 0 has features, as none does that was baked here
  private readonly pages: Record<Kind, Data3DTexture[]>;
  private readonly allocated: Data3DTexture[] = []; // the pages
  private made: Data3DTexture[] = []; // by `textures`
  private distances: Data3DTexture[] = [];
  private occupied: Uint8Array; // 1 where a coarse voxel is not empty, cell by cell, x fastest
  private filled: Uint8Array | null = null; // the same for what stands in for cells that have not arrived
  private readonly taken: Uint8Array; // 1 for each slice that was taken

  constructor(
    private readonly renderer: WebGLRenderer,
    private readonly scene: SceneDescription,
  ) {
    const gl = renderer.getContext() as WebGL2RenderingContext;
    this.kinds = scene.network ? ["rgba", "feature"] : ["rgba"];
    const textureLimit = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const units = gl.getParameter(gl.MAX_TEXTURE_IMAGE_UNITS) - 2; // one is for the indirection grid, one for the depth of other objects
    if (Math.max(...scene.blocks) > textureLimit) {
      const blocks = scene.blocks.join(" x ");
      throw new TooLarge(`The scene's grid is too large for this device: ${blocks} blocks, and it holds ${textureLimit} a side.`);
    }
    this.layout = atlasLayout(scene.cells, textureLimit, Math.floor(units / (this.kinds.length + 1)));
    this.size = this.layout.blocks.map((n) => n * CELL_VOXELS) as Triple;
    this.bytes = this.layout.pages * this.size[0] * this.size[1] * this.size[2] * 4 * this.kinds.length;
    this.occupied = new Uint8Array(scene.cells * COARSE_BYTES);
    this.taken = new Uint8Array(scene.atlas_blocks[2] * LAYER_SLICES);
    const allocate = (kind: Kind) =>
      this.kinds.includes(kind) ? Array.from({ length: this.layout.pages }, () => this.allocatePage()) : [];
    try {
      this.pages = { rgba: allocate("rgba"), feature: allocate("feature") };
    } catch (error) {
      this.dispose(); // what there was room for
      throw error;
    }
  }

  /** The graphics memory of all textures, in bytes. */
  get allBytes(): number {
    const [x, y, z] = this.scene.blocks;
    return this.bytes + this.layout.pages * this.layout.blocks.reduce((product, n) => product * n) * COARSE_BYTES + 4 * x * y * z;
  }

  /** Free the graphics memory. */
  dispose(): void {
    for (const texture of [...this.allocated, ...this.made]) texture.dispose();
  }

  /** An atlas texture in graphics memory, without a copy in main memory. */
  private allocatePage(): Data3DTexture {
    const texture = makeTexture(null, this.size, RGBAFormat, UnsignedByteType, LinearFilter);
    this.allocated.push(texture);
    texture.source.dataReady = false;
    const gl = this.renderer.getContext();
    while (gl.getError() !== gl.NO_ERROR); // errors of earlier calls
    this.renderer.initTexture(texture);
    if (gl.getError() !== gl.NO_ERROR) {
      const mebibytes = Math.ceil(this.bytes / 2 ** 20);
      throw new TooLarge(`The scene's texture is too large: this device's graphics memory does not hold its ${mebibytes} MiB.`);
    }
    return texture;
  }

  /** Upload the texels of a slice. */
  take(slice: number, texels: SliceTexels): void {
    this.strayFeatures ||= hasStrayFeatures(texels);
    for (const kind of this.kinds) this.upload(kind, slice, texels[kind] as Uint8Array);
    this.taken[slice] = 1;
  }

  /** Whether slices of a cell are missing. */
  lacks(cell: number): boolean {
    return this.slicesOf(cell).some((taken) => !taken);
  }

  /** Put texels of x fastest in place of a cell's slices that were not taken yet; null: they are empty. */
  fill(cell: number, texels: SliceTexels | null): void {
    this.filled ??= new Uint8Array(this.occupied.length);
    if (!texels) return; // graphics memory begins as zeros
    const size: Triple = [CELL_VOXELS, CELL_VOXELS, CELL_VOXELS];
    const [page, x, y, z] = cellPosition(this.layout, cell);
    const slices = this.slicesOf(cell);
    const [first, last] = [slices.indexOf(0), slices.lastIndexOf(0)];
    for (const kind of this.kinds) {
      const source = makeTexture(texels[kind] as Uint8Array, size, RGBAFormat, UnsignedByteType, LinearFilter);
      for (let slice = first; slice <= last; slice++) {
        if (slices[slice]) continue;
        const begin = slice * SLICE_PLANES;
        while (slice < last && !slices[slice + 1]) slice++;
        const box = new Box3(new Vector3(0, 0, begin), new Vector3(CELL_VOXELS, CELL_VOXELS, (slice + 1) * SLICE_PLANES));
        const place = new Vector3(x, y, z).multiplyScalar(CELL_VOXELS).setZ(z * CELL_VOXELS + begin);
        this.renderer.copyTextureToTexture(source, this.pages[kind][page], box, place);
      }
    }
    const words = new Uint32Array(texels.rgba.buffer, texels.rgba.byteOffset, texels.rgba.length / 4);
    this.markOccupied(this.filled, words, 0, size, cell, 0);
  }

  /** 1 for each slice of a cell that was taken. */
  private slicesOf(cell: number): Uint8Array {
    const layer = Math.floor(cell / (this.scene.atlas_blocks[0] * this.scene.atlas_blocks[1]));
    return this.taken.subarray(layer * LAYER_SLICES, (layer + 1) * LAYER_SLICES);
  }

  /** All textures, when every slice was taken, or every cell filled. cells: of `readIndirection`. */
  textures(cells: Int32Array<ArrayBuffer>): AtlasTextures {
    this.distances = this.distanceTextures();
    const indirection = this.indirectionTexture(cells);
    this.made = [...this.distances, indirection];
    return { ...this.pages, distance: this.distances, indirection };
  }

  /** A layer of filled cells has arrived: bring their distances to the textures. Call it after `textures`. */
  arrived(layer: number): void {
    const [bx, by] = this.scene.atlas_blocks;
    const size: Triple = [COARSE_PER_CELL, COARSE_PER_CELL, COARSE_PER_CELL];
    for (let cell = layer * bx * by; cell < Math.min((layer + 1) * bx * by, this.scene.cells); cell++) {
      const source = makeTexture(this.distancesOf(cell, this.occupied), size, RedFormat, UnsignedByteType, NearestFilter);
      const [page, x, y, z] = cellPosition(this.layout, cell);
      this.renderer.copyTextureToTexture(source, this.distances[page], null, new Vector3(x, y, z).multiplyScalar(COARSE_PER_CELL));
    }
  }

  /** Copy the part of each cell that a slice holds from the layout of the files to the one of the textures. */
  private upload(kind: Kind, slice: number, texels: Uint8Array): void {
    const [bx, by] = this.scene.atlas_blocks;
    const [width, height] = [bx * CELL_VOXELS, by * CELL_VOXELS];
    const source = makeTexture(texels, [width, height, SLICE_PLANES], RGBAFormat, UnsignedByteType, LinearFilter);
    const words = new Uint32Array(texels.buffer, texels.byteOffset, texels.length / 4);
    const layer = Math.floor((slice * SLICE_PLANES) / CELL_VOXELS);
    const z = (slice * SLICE_PLANES) % CELL_VOXELS;
    for (let cell = layer * bx * by; cell < Math.min((layer + 1) * bx * by, this.scene.cells); cell++) {
      const x = (cell % bx) * CELL_VOXELS;
      const y = (Math.floor(cell / bx) % by) * CELL_VOXELS;
      this.markOccupied(this.occupied, words, x + y * width, [width, height, SLICE_PLANES], cell, z);
      const [page, px, py, pz] = cellPosition(this.layout, cell);
      this.renderer.copyTextureToTexture(
        source,
        this.pages[kind][page],
        new Box3(new Vector3(x, y, 0), new Vector3(x + CELL_VOXELS, y + CELL_VOXELS, SLICE_PLANES)),
        new Vector3(px * CELL_VOXELS, py * CELL_VOXELS, pz * CELL_VOXELS + z),
      );
    }
  }

  /** Mark the coarse voxels of a cell that the nonzero texels of an image reach. words: one a texel; start: the cell's first. */
  private markOccupied(marks: Uint8Array, words: Uint32Array, start: number, image: Triple, cell: number, firstPlane: number): void {
    const [width, height, planes] = image;
    for (let z = 0; z < planes; z++) {
      for (let y = 0; y < CELL_VOXELS; y++) {
        const row = start + (z * height + y) * width;
        for (let x = 0; x < CELL_VOXELS; x++) {
          if (words[row + x] !== 0) markCoarseVoxels(marks, cell, x, y, firstPlane + z);
        }
      }
    }
  }

  /** A texture a page with, for each coarse voxel, the distance in coarse voxels to the nearest of its cell that is not empty. */
  private distanceTextures(): Data3DTexture[] {
    const [x, y, z] = this.layout.blocks.map((n) => n * COARSE_PER_CELL);
    const pages = Array.from({ length: this.layout.pages }, () => new Uint8Array(x * y * z));
    const marks = this.filled ? this.filled.map((filled, i) => filled | this.occupied[i]) : this.occupied;
    for (let cell = 0; cell < this.scene.cells; cell++) {
      const distances = this.distancesOf(cell, marks);
      const [page, px, py, pz] = cellPosition(this.layout, cell);
      for (let row = 0; row < COARSE_PER_CELL ** 2; row++) {
        const cy = py * COARSE_PER_CELL + (row % COARSE_PER_CELL);
        const cz = pz * COARSE_PER_CELL + Math.floor(row / COARSE_PER_CELL);
        pages[page].set(distances.subarray(row * COARSE_PER_CELL, (row + 1) * COARSE_PER_CELL), (cz * y + cy) * x + px * COARSE_PER_CELL);
      }
    }
    return pages.map((data) => makeTexture(data, [x, y, z], RedFormat, UnsignedByteType, NearestFilter));
  }

  private distancesOf(cell: number, marks: Uint8Array): Uint8Array {
    const shape: Triple = [COARSE_PER_CELL, COARSE_PER_CELL, COARSE_PER_CELL];
    return chebyshevDistance(marks.subarray(cell * COARSE_BYTES, (cell + 1) * COARSE_BYTES), shape);
  }

  /**
   * The indirection grid, a 32-bit integer a macroblock: its cell's position in the textures as page << 24 | z << 16 | y << 8 | x
   * in cells, or, of an empty macroblock, minus the distance in macroblocks to the nearest that is not.
   *
   * cells: of `readIndirection`.
   */
  private indirectionTexture(cells: Int32Array<ArrayBuffer>): Data3DTexture {
    const occupied = Uint8Array.from(cells, (cell) => (cell >= 0 ? 1 : 0));
    const distances = chebyshevDistance(occupied, this.scene.blocks);
    const data = Int32Array.from(cells, (cell, i) => {
      if (cell < 0) return -distances[i];
      const [page, x, y, z] = cellPosition(this.layout, cell);
      return (page << 24) | (z << 16) | (y << 8) | x;
    });
    const texture = makeTexture(data, this.scene.blocks, RedIntegerFormat, IntType, NearestFilter);
    texture.internalFormat = "R32I";
    return texture;
  }
}

/** Mark the coarse voxels in which a texel has a trilinear weight: its own, and at a border its neighbours. */
function markCoarseVoxels(marks: Uint8Array, cell: number, x: number, y: number, z: number): void {
  const low = (i: number) => Math.max(0, (i - 1) >> 2);
  const high = (i: number) => Math.min(COARSE_PER_CELL - 1, (i + 1) >> 2);
  for (let cz = low(z); cz <= high(z); cz++) {
    for (let cy = low(y); cy <= high(y); cy++) {
      const row = cell * COARSE_BYTES + (cz * COARSE_PER_CELL + cy) * COARSE_PER_CELL;
      for (let cx = low(x); cx <= high(x); cx++) marks[row + cx] = 1;
    }
  }
}

/** Whether a texel of alpha 0 has features. */
function hasStrayFeatures({ rgba, feature }: SliceTexels): boolean {
  if (!feature) return false;
  const words = new Uint32Array(feature.buffer, feature.byteOffset, feature.length / 4);
  for (let i = 0; i < words.length; i++) if (words[i] !== 0 && rgba[4 * i + 3] === 0) return true;
  return false;
}

function makeTexture(
  data: Uint8Array | Int32Array | null,
  [width, height, depth]: Triple,
  format: PixelFormat,
  type: TextureDataType,
  filter: MagnificationTextureFilter,
): Data3DTexture {
  const texture = new Data3DTexture(data as Uint8Array<ArrayBuffer> | null, width, height, depth);
  Object.assign(texture, { format, type, minFilter: filter, magFilter: filter, unpackAlignment: 1, needsUpdate: true });
  texture.wrapS = texture.wrapT = texture.wrapR = ClampToEdgeWrapping;
  return texture;
}
