// The distance transform behind empty-space skipping.

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
