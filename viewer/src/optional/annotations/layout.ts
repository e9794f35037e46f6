// Where labels lie: near their points, inside of the stage, and not over one another.

/** A label and the point that it belongs to; lengths in CSS pixels. */
export interface Label {
  x: number; // of the point
  y: number;
  width: number; // of the label
  height: number;
  place: number; // where it lay before, see `candidates`; -1 for nowhere
}

/** Where a label lies. */
export interface Placed {
  left: number;
  top: number;
  place: number;
  crowded: boolean; // whether it finds no room: it lies over another label
}

const REACHES = [28, 64, 110]; // pixels from the point to the label
const DIRECTIONS = 16;
const GAP = 6; // pixels between labels, and from the stage's edge
const STAY = 40; // pixels by which another place must be better than the one before
const OVERLAP = 10; // cost of a square pixel that lies over another label

type Rectangle = readonly [left: number, top: number, right: number, bottom: number];

/** Place labels in a stage of that size, one after the other: each as near to its point as the others allow. */
export function placeLabels(labels: readonly Label[], width: number, height: number): Placed[] {
  const taken: Rectangle[] = labels.map(({ x, y }) => [x - GAP, y - GAP, x + GAP, y + GAP]); // the points themselves
  return labels.map((label) => {
    let best: (Placed & { cost: number }) | null = null;
    for (const [place, left, top] of candidates(label, width, height)) {
      const box: Rectangle = [left - GAP, top - GAP, left + label.width + GAP, top + label.height + GAP];
      const over = taken.reduce((sum, other) => sum + shared(box, other), 0);
      const away = Math.hypot(left + label.width / 2 - label.x, top + label.height / 2 - label.y);
      const cost = away + OVERLAP * over + (place === label.place ? 0 : STAY);
      if (!best || cost < best.cost) best = { left, top, place, crowded: over > 0, cost };
    }
    const { left, top, place, crowded } = best as Placed;
    if (!crowded) taken.push([left, top, left + label.width, top + label.height]);
    return { left, top, place, crowded };
  });
}

/** Places of a label: [number, left, top], those that point away from the stage's middle first. */
function* candidates({ x, y, width, height }: Label, stageWidth: number, stageHeight: number): Generator<[number, number, number]> {
  const outward = Math.round((Math.atan2(y - stageHeight / 2, x - stageWidth / 2) / (2 * Math.PI)) * DIRECTIONS);
  for (const [ring, reach] of REACHES.entries()) {
    for (let i = 0; i < DIRECTIONS; i++) {
      const turn = i % 2 ? (i + 1) / 2 : -i / 2;
      const direction = (outward + turn + 2 * DIRECTIONS) % DIRECTIONS;
      const angle = (direction / DIRECTIONS) * 2 * Math.PI;
      const left = x + Math.cos(angle) * (reach + width / 2) - width / 2;
      const top = y + Math.sin(angle) * (reach + height / 2) - height / 2;
      yield [ring * DIRECTIONS + direction, within(left, stageWidth - width), within(top, stageHeight - height)];
    }
  }
}

const within = (value: number, most: number): number => Math.max(GAP, Math.min(value, most - GAP));

/** The area that two rectangles share. */
function shared(a: Rectangle, b: Rectangle): number {
  const [width, height] = [Math.min(a[2], b[2]) - Math.max(a[0], b[0]), Math.min(a[3], b[3]) - Math.max(a[1], b[1])];
  return width > 0 && height > 0 ? width * height : 0;
}
