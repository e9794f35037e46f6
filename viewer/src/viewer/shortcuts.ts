// Shortcuts of a single letter, digit or sign. Who speaks to the computer, or often hits keys by accident, can keep them to the picture:
// WCAG 2.1.4, Character Key Shortcuts, by "Active only on focus". All else keeps its keys.

const STORED = "snerg-shortcuts"; // in the browser, for every page of the same origin
const ON_PICTURE = "picture";

export class Shortcuts {
  /** box: ticked where they work everywhere on the page. */
  constructor(private readonly box: HTMLInputElement) {
    box.checked = stored() !== ON_PICTURE;
    box.onchange = () => store(box.checked ? "" : ON_PICTURE);
  }

  /** Whether a key that was pressed outside of the picture means something. */
  allows({ key, code }: KeyboardEvent): boolean {
    const character = key?.length === 1 || /^(Key|Digit)/.test(code ?? ""); // keys of flights are read by their place
    return this.box.checked || !character;
  }
}

/** A frame that is sandboxed, and some settings, forbid to store: then a choice holds until the page is left. */
function stored(): string | null {
  try {
    return localStorage.getItem(STORED);
  } catch {
    return null;
  }
}

function store(value: string): void {
  try {
    localStorage.setItem(STORED, value);
  } catch {
    // see above
  }
}
