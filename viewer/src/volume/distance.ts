// The distance transforms behind empty-space skipping.

/**
 * For each entry of a grid, the Chebyshev distance (maximum norm) to the nearest nonzero entry: 0 at such an entry, at most 255.
 *
 * occupied: values with x fastest, of a grid of [nx, ny, nz]. Returns a Uint8Array of that length. Two sweeps, forward and
 * backward, each over the 13 neighbours that the sweep has passed.
 */
export function chebyshevDistance(occupied: ArrayLike<number>, [nx, ny, nz]: readonly [number, number, number]): Uint8Array {
  const distance = Uint8Array.from(occupied, (value) => (value ? 0 : 255));
  const passed: [number, number, number][] = [];
  for (let i = 0; i < 13; i++) passed.push([(i % 3) - 1, (Math.floor(i / 3) % 3) - 1, Math.floor(i / 9) - 1]);
  for (const sign of [1, -1]) {
    for (let i = 0; i < distance.length; i++) {
      const index = sign > 0 ? i : distance.length - 1 - i;
      const [x, y, z] = [index % nx, Math.floor(index / nx) % ny, Math.floor(index / (nx * ny))];
      let least = distance[index];
      if (least === 0) continue;
      for (const [dx, dy, dz] of passed) {
        const [u, v, w] = [x + sign * dx, y + sign * dy, z + sign * dz];
        if (u < 0 || v < 0 || w < 0 || u >= nx || v >= ny || w >= nz) continue;
        least = Math.min(least, distance[(w * ny + v) * nx + u] + 1);
      }
      distance[index] = least;
    }
  }
  return distance;
}

const ROW = 32; // texels of a cell along an axis: the bits of a word
const PLANE = ROW + 1; // words: an empty one follows the rows of a plane, and an empty plane lies below and above
const ALL = (ROW + 2) * PLANE;
const inside = (i: number) => i >= PLANE && i < ALL - PLANE && i % PLANE < ROW;
const INSIDE = Uint32Array.from({ length: ALL }, (_, i) => (inside(i) ? 0xffffffff : 0));

/**
 * For each stencil of a cell, named by its lowest texel, the Chebyshev distance to the nearest stencil that holds something: 0 at such a
 * stencil, 255 everywhere in an empty cell. A stencil is the 2 x 2 x 2 texels that a sample between them is interpolated from.
 *
 * texels: a bit for each texel that is not empty, x in a word, y fastest then: 32 x 32 words. Returns 32^3 bytes, x fastest.
 */
export function stencilDistances(texels: Uint32Array): Uint8Array {
  const distance = new Uint8Array(ROW ** 3).fill(255);
  const rows = new Uint32Array(ALL);
  for (let z = 0; z < ROW; z++) rows.set(texels.subarray(z * ROW, (z + 1) * ROW), (z + 1) * PLANE);
  const reached = new Uint32Array(ALL);
  const next = new Uint32Array(ALL);
  for (let i = PLANE; i < ALL - PLANE; i++) {
    const row = rows[i] | rows[i + 1] | rows[i + PLANE] | rows[i + PLANE + 1];
    next[i] = (row | (row >>> 1)) & INSIDE[i];
  }
  for (let steps = 0; reach(reached, next, distance, steps); steps++) dilate(reached, next, rows);
  return distance;
}

/** Add bits of `next` to those that were reached, and write the distance of the new ones. Returns whether there are any. */
function reach(reached: Uint32Array, next: Uint32Array, distance: Uint8Array, steps: number): boolean {
  let any = false;
  for (let i = PLANE; i < ALL - PLANE; i++) {
    let added = next[i] & ~reached[i];
    if (added === 0) continue;
    any = true;
    reached[i] = next[i];
    const first = ROW * (i - PLANE - Math.floor((i - PLANE) / PLANE));
    for (; added !== 0; added &= added - 1) distance[first + 31 - Math.clz32(added & -added)] = steps;
  }
  return any;
}

/** `from`, and what lies beside it along one or several axes. unused: scratch. */
function dilate(from: Uint32Array, to: Uint32Array, unused: Uint32Array): void {
  for (let i = 0; i < ALL; i++) to[i] = from[i] | (from[i] << 1) | (from[i] >>> 1);
  for (let i = 1; i < ALL - 1; i++) unused[i] = to[i - 1] | to[i] | to[i + 1];
  for (let i = PLANE; i < ALL - PLANE; i++) to[i] = (unused[i - PLANE] | unused[i] | unused[i + PLANE]) & INSIDE[i];
}
