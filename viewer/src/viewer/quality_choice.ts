// The list of quality presets in the bar. Its first entry lets the device choose, and says what it chose.
import type { Viewer } from "./interface";
import { AUTOMATIC, qualityOf } from "./quality";

const LABELS = { phone: "Phone", balanced: "Balanced", full: "Full" } as const;

export class QualityChoice {
  private chosen = false; // by a person

  /** changed: called when a person chooses. */
  constructor(
    private readonly select: HTMLSelectElement,
    private readonly viewer: Viewer,
    private readonly changed: () => void,
  ) {
    const names = Object.entries(LABELS).map(([name, label]) => new Option(`Quality: ${label.toLowerCase()}`, name));
    select.replaceChildren(new Option("", AUTOMATIC), ...names);
    select.onchange = () => {
      this.chosen = true;
      this.show(select.value);
      this.changed();
    };
  }

  /** What an address says of it; null where nobody chose. */
  get written(): string | null {
    return this.chosen ? this.select.value : null;
  }

  /** Put a preset in force; every other text lets the device choose. */
  show(text: string | null): void {
    this.viewer.quality = qualityOf(text);
    this.select.value = qualityOf(text) ?? AUTOMATIC;
    const suggested = qualityOf(text) ? "" : ` (${LABELS[this.viewer.quality].toLowerCase()})`;
    this.select.options[0].text = `Quality: auto${suggested}`;
  }
}
