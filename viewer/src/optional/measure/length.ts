// Lengths as people read them, in the units of Blender's scene.
import type { WorldUnits } from "../../data/cameras";

type Unit = readonly [name: string, metres: number];

const METRIC: readonly Unit[] = [
  ["km", 1000],
  ["m", 1],
  ["cm", 0.01],
  ["mm", 0.001],
  ["µm", 1e-6],
];
const IMPERIAL: readonly Unit[] = [
  ["mi", 1609.344],
  ["ft", 0.3048],
  ["in", 0.0254],
];

/**
 * A length and how exact it is, such as "1.234 m ± 0.012 m" or, without a system, "1.234 ± 0.012 units".
 *
 * length and error: in units of the scene. The unit is the largest of which the length has at least one; the digits end with the second
 * one of the error.
 */
export function lengthText(length: number, error: number, { metres, system }: WorldUnits): string {
  if (system === "none") return `${rounded(length, error)} ± ${rounded(error, error)} units`;
  const units = system === "metric" ? METRIC : IMPERIAL;
  const [name, size] = units.find(([, size]) => length * metres >= size) ?? units[units.length - 1];
  const [value, about] = [(length * metres) / size, (error * metres) / size];
  return `${rounded(value, about)} ${name} ± ${rounded(about, about)} ${name}`;
}

/** A number with as many digits as an error of it allows. */
function rounded(value: number, error: number): string {
  const digits = error > 0 ? Math.max(0, Math.min(9, 1 - Math.floor(Math.log10(error)))) : 3;
  return value.toFixed(digits);
}
