// The choice of what is behind the scene: swatches, any colour, and the page's own picture.
import { colourOf, hexOf, IMAGE, TRANSPARENT } from "./backdrop";
import type { Viewer } from "./interface";

const WITHOUT = "white"; // where nothing that is a background is asked for

export class Backgrounds {
  chosen = false; // by a person
  private value = WITHOUT;
  private readonly radios: HTMLInputElement[];
  private readonly colour: HTMLInputElement;

  /** parts: of the template. changed: called when a person chooses. picture: the page's own, if it has one. */
  constructor(
    private readonly stage: HTMLElement,
    root: ParentNode,
    private readonly viewer: Viewer,
    private readonly picture: HTMLImageElement | null,
    private readonly changed: () => void,
  ) {
    this.radios = [...root.querySelectorAll<HTMLInputElement>("[name=background]")];
    this.colour = root.querySelector("#colour") as HTMLInputElement;
    const own = this.radios.find((radio) => radio.value === IMAGE);
    if (own?.parentElement) own.parentElement.hidden = !picture;
    for (const radio of this.radios) radio.onchange = () => this.choose(radio.value);
    this.colour.oninput = () => this.choose(this.colour.value);
  }

  get current(): string {
    return this.value;
  }

  /** Show a background, see `colourOf`; a text that is none shows the page's picture, or white. */
  show(background: string): void {
    const known = colourOf(background) && (background !== IMAGE || this.picture);
    this.value = known ? background : this.picture ? IMAGE : WITHOUT;
    const colour = colourOf(this.value) ?? [1, 1, 1, 1];
    for (const radio of this.radios) radio.checked = radio.value === this.value;
    if (colour[3]) this.colour.value = hexOf(colour);
    const named = this.radios.some((radio) => radio.checked);
    this.colour.parentElement?.classList.toggle("chosen", !named);
    this.stage.classList.toggle("clear", this.value === TRANSPARENT);
    if (this.picture) this.picture.hidden = this.value !== IMAGE;
    this.viewer.backdrop = this.value === IMAGE ? this.picture : null;
    this.viewer.background = colour;
  }

  private choose(background: string): void {
    this.chosen = true;
    this.show(background);
    this.changed();
  }
}
