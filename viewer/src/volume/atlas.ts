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
import { chebyshevDistance, stencilDistances } from "./distance";

const CELL_ROWS = CELL_VOXELS ** 2; // of texels along x

type Kind = "rgba" | "feature";
type Triple = [number, number, number];
const CELL: Triple = [CELL_VOXELS, CELL_VOXELS, CELL_VOXELS];

/** The textures that the shader reads: one a page, and the indirection grid. */
export interface AtlasTextures {
  rgba: Data3DTexture[];
  feature: Data3DTexture[]; // none in a diffuse scene
  distance: Data3DTexture[]; // see `stencilDistances`
  indirection: Data3DTexture;
}

/** The textures of a scene. The constructor throws TooLarge when this device cannot hold them. */
export class Atlas {
  readonly kinds: Kind[];
  readonly layout: AtlasLayout;
  readonly size: Triple; // texels of a page along x, y and z
  readonly bytes: number; // of graphics memory that the pages take
  private readonly pages: Record<Kind | "distance", Data3DTexture[]>;
  private readonly made: Data3DTexture[] = []; // all of them, and the indirection grid
  private readonly occupied: Uint32Array; // a bit for each texel that is not empty, cell by cell, x fastest, in a word
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
    this.bytes = this.layout.pages * this.size[0] * this.size[1] * this.size[2] * (4 * this.kinds.length + 1);
    this.occupied = new Uint32Array(scene.cells * CELL_ROWS);
    this.taken = new Uint8Array(scene.atlas_blocks[2] * LAYER_SLICES);
    const allocate = (make: () => Data3DTexture) => Array.from({ length: this.layout.pages }, () => this.allocatePage(make()));
    const values = () => makeTexture(null, this.size, RGBAFormat, UnsignedByteType, LinearFilter);
    const distances = () => distanceTexture(null, this.size);
    try {
      this.pages = { rgba: allocate(values), feature: scene.network ? allocate(values) : [], distance: allocate(distances) };
    } catch (error) {
      this.dispose(); // what there was room for
      throw error;
    }
  }

  /** The graphics memory of all textures, in bytes. */
  get allBytes(): number {
    const [x, y, z] = this.scene.blocks;
    return this.bytes + 4 * x * y * z;
  }

  /** Free the graphics memory. */
  dispose(): void {
    for (const texture of this.made) texture.dispose();
  }

  /** An atlas texture in graphics memory, without a copy in main memory. */
  private allocatePage(texture: Data3DTexture): Data3DTexture {
    this.made.push(texture);
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

  /** Upload the texels of a slice; with the last slice of a layer the distances of its cells, too. */
  take(slice: number, texels: SliceTexels): void {
    for (const kind of this.kinds) this.upload(kind, slice, texels[kind] as Uint8Array);
    this.taken[slice] = 1;
    const cells = this.cellsOf(Math.floor(slice / LAYER_SLICES));
    if (cells.length && !this.lacks(cells[0])) for (const cell of cells) this.uploadDistances(cell, this.rowsOf(cell));
  }

  /** Whether slices of a cell are missing. */
  lacks(cell: number): boolean {
    return this.slicesOf(cell).some((taken) => !taken);
  }

  /** Put texels of x fastest in place of a cell's slices that were not taken yet; null: they are empty. */
  fill(cell: number, texels: SliceTexels | null): void {
    const rows = this.rowsOf(cell).slice();
    if (texels) {
      this.uploadMissing(cell, texels);
      markOccupied(rows, words(texels.rgba), 0, CELL, 0);
    }
    this.uploadDistances(cell, rows);
  }

  private uploadMissing(cell: number, texels: SliceTexels): void {
    const [page, x, y, z] = cellPosition(this.layout, cell);
    const slices = this.slicesOf(cell);
    const [first, last] = [slices.indexOf(0), slices.lastIndexOf(0)];
    for (const kind of this.kinds) {
      const source = makeTexture(texels[kind] as Uint8Array, CELL, RGBAFormat, UnsignedByteType, LinearFilter);
      for (let slice = first; slice <= last; slice++) {
        if (slices[slice]) continue;
        const begin = slice * SLICE_PLANES;
        while (slice < last && !slices[slice + 1]) slice++;
        const box = new Box3(new Vector3(0, 0, begin), new Vector3(CELL_VOXELS, CELL_VOXELS, (slice + 1) * SLICE_PLANES));
        const place = new Vector3(x, y, z).multiplyScalar(CELL_VOXELS).setZ(z * CELL_VOXELS + begin);
        this.renderer.copyTextureToTexture(source, this.pages[kind][page], box, place);
      }
    }
  }

  /** 1 for each slice of a cell that was taken. */
  private slicesOf(cell: number): Uint8Array {
    const layer = Math.floor(cell / (this.scene.atlas_blocks[0] * this.scene.atlas_blocks[1]));
    return this.taken.subarray(layer * LAYER_SLICES, (layer + 1) * LAYER_SLICES);
  }

  /** The cells of a layer, which lie one above the other in the files' layout. */
  private cellsOf(layer: number): number[] {
    const [bx, by] = this.scene.atlas_blocks;
    const first = layer * bx * by;
    return Array.from({ length: Math.max(Math.min(bx * by, this.scene.cells - first), 0) }, (_, i) => first + i);
  }

  /** The words of `occupied` of a cell. */
  private rowsOf(cell: number): Uint32Array {
    return this.occupied.subarray(cell * CELL_ROWS, (cell + 1) * CELL_ROWS);
  }

  private uploadDistances(cell: number, rows: Uint32Array): void {
    const [page, x, y, z] = cellPosition(this.layout, cell);
    const place = new Vector3(x, y, z).multiplyScalar(CELL_VOXELS);
    this.renderer.copyTextureToTexture(distanceTexture(stencilDistances(rows), CELL), this.pages.distance[page], null, place);
  }

  /** All textures, when every slice was taken, or every cell filled. cells: of `readIndirection`. */
  textures(cells: Int32Array<ArrayBuffer>): AtlasTextures {
    const indirection = this.indirectionTexture(cells);
    this.made.push(indirection);
    return { ...this.pages, indirection };
  }

  /** Copy the part of each cell that a slice holds from the layout of the files to the one of the textures. */
  private upload(kind: Kind, slice: number, texels: Uint8Array): void {
    const [bx, by] = this.scene.atlas_blocks;
    const [width, height] = [bx * CELL_VOXELS, by * CELL_VOXELS];
    const source = makeTexture(texels, [width, height, SLICE_PLANES], RGBAFormat, UnsignedByteType, LinearFilter);
    const z = (slice * SLICE_PLANES) % CELL_VOXELS;
    for (const cell of this.cellsOf(Math.floor(slice / LAYER_SLICES))) {
      const x = (cell % bx) * CELL_VOXELS;
      const y = (Math.floor(cell / bx) % by) * CELL_VOXELS;
      markOccupied(this.rowsOf(cell), words(texels), x + y * width, [width, height, SLICE_PLANES], z);
      const [page, px, py, pz] = cellPosition(this.layout, cell);
      this.renderer.copyTextureToTexture(
        source,
        this.pages[kind][page],
        new Box3(new Vector3(x, y, 0), new Vector3(x + CELL_VOXELS, y + CELL_VOXELS, SLICE_PLANES)),
        new Vector3(px * CELL_VOXELS, py * CELL_VOXELS, pz * CELL_VOXELS + z),
      );
    }
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

/** One a texel. */
const words = (texels: Uint8Array) => new Uint32Array(texels.buffer, texels.byteOffset, texels.length / 4);

/** Set the bits of a cell's texels that are not 0 in an image. start: the cell's first texel in it; plane: where its first plane lies. */
function markOccupied(rows: Uint32Array, image: Uint32Array, start: number, [width, height, planes]: Triple, plane: number): void {
  for (let z = 0; z < planes; z++) {
    for (let y = 0; y < CELL_VOXELS; y++) {
      const from = start + (z * height + y) * width;
      let row = 0;
      for (let x = 0; x < CELL_VOXELS; x++) if (image[from + x] !== 0) row |= 1 << x;
      rows[(plane + z) * CELL_VOXELS + y] |= row;
    }
  }
}

function distanceTexture(data: Uint8Array | null, size: Triple): Data3DTexture {
  const texture = makeTexture(data, size, RedIntegerFormat, UnsignedByteType, NearestFilter);
  texture.internalFormat = "R8UI";
  return texture;
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
