// Where the cells lie in the atlas textures of this device.

import { CELL_VOXELS } from "../data/scene";
import { TooLarge } from "../errors";

const MAX_CELLS_PER_SIDE = 255; // the indirection texture stores a position in cells with 8 bits an axis

export interface AtlasLayout {
  pages: number; // textures of each kind
  blocks: [number, number, number]; // cells of a texture along x, y and z
  cellsPerPage: number;
}

/**
 * A layout for that many cells, with `pages` textures of blocks = [x, y, z] cells each, which the
 * cells fill page by page, x fastest. No texture has more than `textureLimit` texels on a side.
 *
 * The layout of the files may not fit: WebGL 2 guarantees 256 texels a side. Cells are uploaded one by one, so that any layout
 * will do; this one is nearly a cube, which leaves few cells unused. Throws TooLarge when the cells need more than maxPages.
 */
export function atlasLayout(cells: number, textureLimit: number, maxPages: number): AtlasLayout {
  const side = Math.min(Math.floor(textureLimit / CELL_VOXELS), MAX_CELLS_PER_SIDE);
  const pages = Math.max(1, Math.ceil(cells / side ** 3));
  if (side < 1 || pages > maxPages) {
    throw new TooLarge(
      `The scene's texture is too large for this device: it has ${cells} blocks, and the graphics driver holds ` +
        `${maxPages * side ** 3} (3D textures of ${textureLimit} texels a side). Bake it at a lower resolution, or use another device.`,
    );
  }
  const cellsPerPage = Math.max(1, Math.ceil(cells / pages));
  const x = Math.min(side, Math.ceil(Math.cbrt(cellsPerPage) - 1e-9));
  const y = Math.ceil(Math.sqrt(cellsPerPage / x) - 1e-9);
  return { pages, blocks: [x, y, Math.ceil(cellsPerPage / (x * y))], cellsPerPage };
}

/** The position of a cell in a layout: [page, x, y, z] in cells. */
export function cellPosition({ blocks: [x, y], cellsPerPage }: AtlasLayout, cell: number): [number, number, number, number] {
  const i = cell % cellsPerPage;
  return [Math.floor(cell / cellsPerPage), i % x, Math.floor(i / x) % y, Math.floor(i / (x * y))];
}
