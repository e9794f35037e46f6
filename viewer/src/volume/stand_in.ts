// A scene at a quarter of its resolution in place of cells that have not arrived: its values at the voxels of a cell.
import { CELL_VOXELS, DATA_VOXELS, type SceneDescription } from "../data/scene";
import { SLICE_PLANES, type SliceTexels } from "../data/slices";
import type { SnergScene } from "../data/snerg_scene";

const FACTOR = 4; // voxels along an axis that one coarse voxel covers (core/scene/coarse.py)
const SPAN = 10; // coarse voxels along an axis that the voxels of a cell lie between
const EVEN = 1e-4; // relative: how far the coarse voxel may be from FACTOR voxels

/** Premultiplied values of a coarse voxel to those of a voxel: light passes four of these alike. alpha: of the coarse one, 0 to 255. */
const shareOf = (alpha: number) => (alpha === 0 ? 0 : (255 / alpha) * (1 - (1 - alpha / 255) ** (1 / FACTOR)));
const SHARES = Float32Array.from({ length: 256 }, (_, alpha) => shareOf(alpha));

/** Whether a scene is that at a quarter of another's resolution, from the same corner. */
export function standsIn(coarse: SceneDescription, scene: SceneDescription): boolean {
  const sized = coarse.blocks.every((n, axis) => n === Math.ceil(Math.ceil(scene.shape[axis] / FACTOR) / DATA_VOXELS));
  const even = Math.abs(coarse.voxel_size / (FACTOR * scene.voxel_size) - 1) < EVEN;
  const alike = (coarse.network === null) === (scene.network === null) && coarse.square_roots === scene.square_roots;
  return sized && even && alike;
}

/** Reads the coarse scene, and gives the texels of a cell from it. */
export class StandIn {
  private readonly slices: SliceTexels[] = [];

  private constructor(private readonly scene: SnergScene) {}

  /** Rejects as `SnergScene.readSlices` does. */
  static async read(scene: SnergScene, signal: AbortSignal): Promise<StandIn> {
    const made = new StandIn(scene);
    await scene.readSlices(
      (slice, texels) => {
        made.slices[slice] = texels;
      },
      { signal },
    );
    return made;
  }

  /** The texels of a macroblock's cell, x fastest; null where the coarse scene is empty there. block: its coordinates. */
  texels(block: readonly [number, number, number]): SliceTexels | null {
    const { blocks } = this.scene.description;
    const [x, y, z] = block.map((n) => Math.floor(n / FACTOR));
    const cell = this.scene.cells[(z * blocks[1] + y) * blocks[0] + x];
    if (cell === undefined || cell < 0) return null;
    const offsets = block.map((n) => (n % FACTOR) * DATA_VOXELS) as [number, number, number];
    const axes = offsets.map(stencil);
    const shares = new Float32Array(CELL_VOXELS ** 3);
    const rgba = this.finer("rgba", cell, axes, shares);
    const feature = rgba && this.scene.description.network ? this.finer("feature", cell, axes, shares) : null;
    return rgba && { rgba, feature };
  }

  /** Trilinear values at the voxels of a cell. shares: of each voxel, 0 in an empty one; written where these values hold the alpha. */
  private finer(kind: "rgba" | "feature", cell: number, axes: Stencil[], shares: Float32Array): Uint8Array | null {
    const gathered = this.gather(kind, cell, axes);
    if (!gathered) return null;
    const n = CELL_VOXELS;
    const rows = blend(blend(gathered, axes[2], SPAN * SPAN * 4, 1), axes[1], SPAN * 4, n);
    const texels = new Uint8Array(4 * n ** 3);
    const { low, part } = axes[0];
    const roots = this.scene.description.square_roots;
    const stored = (value: number) => (roots ? Math.sqrt(255 * value) : value) + 0.5;
    for (let i = 0; i < n ** 3; i++) {
      const from = 4 * ((i >> 5) * SPAN + low[i & 31]);
      const upper = part[i & 31];
      const lower = 1 - upper;
      if (kind === "rgba") {
        const alpha = lower * rows[from + 3] + upper * rows[from + 7];
        shares[i] = roots ? shareOf(alpha) : SHARES[(alpha + 0.5) | 0];
      }
      const share = shares[i];
      if (share === 0) continue; // most voxels
      const [a, b, to] = [share * lower, share * upper, 4 * i];
      for (let c = 0; c < 4; c++) texels[to + c] = stored(a * rows[from + c] + b * rows[from + 4 + c]);
    }
    return texels;
  }

  /** The coarse voxels that a cell lies between, [z, y, x, 4]; null where all are 0. */
  private gather(kind: "rgba" | "feature", cell: number, axes: Stencil[]): Float32Array | null {
    const [bx, by] = this.scene.description.atlas_blocks;
    const [width, height] = [bx * CELL_VOXELS, by * CELL_VOXELS];
    const corner = [cell % bx, Math.floor(cell / bx) % by, Math.floor(cell / (bx * by))].map(
      (n, axis) => n * CELL_VOXELS + axes[axis].first,
    );
    const found = new Float32Array(SPAN ** 3 * 4);
    let some = 0;
    for (let z = 0, i = 0; z < SPAN; z++) {
      const plane = corner[2] + z;
      const texels = this.slices[Math.floor(plane / SLICE_PLANES)][kind] as Uint8Array;
      for (let y = 0; y < SPAN; y++) {
        let from = 4 * (((plane % SLICE_PLANES) * height + corner[1] + y) * width + corner[0]);
        for (let x = 0; x < 4 * SPAN; x++) some |= found[i++] = texels[from++];
      }
    }
    if (this.scene.description.square_roots) for (let i = 0; i < found.length; i++) found[i] *= found[i] / 255;
    return some || kind === "feature" ? found : null;
  }
}

interface Stencil {
  first: number; // of the cell's texels, the lowest that is used
  low: Int32Array; // of each voxel: the lower of its two coarse voxels, counted from `first`
  part: Float32Array; // the upper one's weight
}

/** Along an axis, between which coarse texels the voxels of a cell lie. offset: voxels from the coarse cell's first own voxel. */
function stencil(offset: number): Stencil {
  // Texel 0 of a cell is its apron. The centre of voxel i lies at (i + 0.5) / FACTOR - 0.5 coarse voxels.
  const places = Array.from({ length: CELL_VOXELS }, (_, i) => (offset + i - 1 + 0.5) / FACTOR - 0.5 + 1);
  const first = Math.floor(places[0]);
  const low = Int32Array.from(places, (place) => Math.floor(place) - first);
  return { first, low, part: Float32Array.from(places, (place) => place - Math.floor(place)) };
}

/** Interpolate along one axis of [outer, SPAN, inner] values: [outer, CELL_VOXELS, inner]. */
function blend(values: Float32Array, { low, part }: Stencil, inner: number, outer: number): Float32Array {
  const found = new Float32Array(outer * CELL_VOXELS * inner);
  let to = 0;
  for (let o = 0; o < outer; o++) {
    for (let i = 0; i < CELL_VOXELS; i++) {
      const upper = part[i];
      const lower = 1 - upper;
      let from = (o * SPAN + low[i]) * inner;
      for (let k = 0; k < inner; k++, from++) found[to++] = lower * values[from] + upper * values[from + inner];
    }
  }
  return found;
}
