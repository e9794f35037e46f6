// The cameras as small pictures: a button in the bar that shows the present one, and a dialog to choose from.
import type { Viewer } from "./interface";

const COUNTED = /^(r|v|img|image|frame|view|cam|camera|dsc|dji|pxl)?[ _.-]*\d+$/i; // names that a program gave

/** What a person is told of a camera: its name, or its number where a program named it, such as r_0 or IMG_0012. */
export const labelOf = (name: string, index: number): string => (COUNTED.test(name) ? `View ${index + 1}` : name);

export class Gallery {
  private readonly pictures = new Map<number, Promise<string | null>>(); // the addresses of thumbnails
  private readonly open = document.createElement("button");
  private readonly dialog = document.createElement("dialog");
  private readonly grid = document.createElement("div");
  private shown = -1;

  /** select: the list of cameras that it takes the place of. choose: shows a camera. */
  constructor(
    private readonly select: HTMLSelectElement,
    private readonly viewer: Viewer,
    private readonly choose: (index: number) => void,
  ) {
    this.open.id = "gallery-open";
    this.open.type = "button";
    this.open.title = "Choose a camera (1 to 9)";
    this.open.setAttribute("aria-haspopup", "dialog");
    this.open.onclick = () => this.show();
    this.dialog.id = "gallery";
    this.dialog.setAttribute("aria-label", "Cameras");
    this.grid.className = "gallery-grid";
    const close = document.createElement("button");
    close.type = "button";
    close.textContent = "Close";
    close.onclick = () => this.dialog.close();
    const actions = document.createElement("div");
    actions.className = "actions";
    actions.append(close);
    this.dialog.append(this.grid, actions);
    this.dialog.onclick = (event) => event.target === this.dialog && this.dialog.close(); // beside it
    select.after(this.open);
    select.hidden = true;
    (select.getRootNode() as ShadowRoot).getElementById("layout")?.append(this.dialog);
    this.update();
  }

  /** Show the chosen camera in the bar. */
  update(): void {
    const index = Math.max(Number(this.select.value), 0);
    if (index === this.shown) return;
    this.shown = index;
    this.fill(this.open, index);
    this.open.setAttribute("aria-label", `Camera: ${this.label(index)}, ${index + 1} of ${this.viewer.cameras.length}`);
    [...this.grid.children].forEach((button, i) => {
      mark(button, i === index);
    });
  }

  private show(): void {
    if (!this.grid.children.length) {
      this.viewer.cameras.forEach((_, index) => {
        const button = document.createElement("button");
        button.type = "button";
        mark(button, index === this.shown);
        button.onclick = () => {
          this.dialog.close();
          this.choose(index);
        };
        this.fill(button, index);
        this.grid.append(button);
      });
    }
    this.dialog.showModal();
    (this.grid.children[this.shown] as HTMLElement | undefined)?.focus();
  }

  /** Put a camera's picture and label into a button. */
  private fill(button: HTMLElement, index: number): void {
    const { width, height } = this.viewer.cameras[index];
    const picture = document.createElement("img");
    picture.alt = "";
    Object.assign(picture, { width, height }); // its shape, before it is there
    const label = document.createElement("span");
    label.textContent = this.label(index);
    button.replaceChildren(picture, label);
    void this.pictureOf(index).then((address) => {
      if (address) picture.src = address;
      else picture.hidden = true;
    });
  }

  private label(index: number): string {
    return labelOf(this.viewer.cameras[index].name, index);
  }

  private pictureOf(index: number): Promise<string | null> {
    const known = this.pictures.get(index) ?? this.viewer.thumbnail(index).then((blob) => blob && URL.createObjectURL(blob));
    this.pictures.set(index, known);
    return known;
  }
}

/** Tell, or no longer, that a button's camera is the present one. */
function mark(button: Element, current: boolean): void {
  if (current) button.setAttribute("aria-current", "true");
  else button.removeAttribute("aria-current");
}
