// The bar below the picture: cameras, sharing, pictures, full screen, help, and the keys for them.
import { findCamera } from "../data/cameras";
import type { Backgrounds } from "./backgrounds";
import { Gallery, labelOf } from "./gallery";
import type { Viewer } from "./interface";
import type { QualityChoice } from "./quality_choice";
import { type SharedView, writeView } from "./shared_view";
import { steer } from "./steering";

export const MAX_SIDE = 8192; // pixels of a picture that may be asked for
const FLIGHT = 1; // seconds from one camera to another
const LINK_SHOWN = 2000; // milliseconds that "Copied" stays

export class Bar {
  private gallery: Gallery | null = null;
  private frameShown = false;

  /** choose(index, duration): shows a camera after a flight of so many seconds. */
  constructor(
    private readonly root: ShadowRoot,
    private readonly viewer: Viewer,
    private readonly backgrounds: Backgrounds,
    private readonly quality: QualityChoice,
    private readonly choose: (index: number, duration: number) => void,
  ) {
    this.fillCameras();
    this.on("previous", () => this.step(-1));
    this.on("next", () => this.step(1));
    this.on("reset", () => this.reset());
    this.on("fullscreen", () => void this.toggleFullscreen());
    this.on("menu", () => this.toggleMenu());
    this.on("help", () => this.find<HTMLDialogElement>("helping").showModal());
    this.on("close-help", () => this.find<HTMLDialogElement>("helping").close());
    this.on("share", () => this.openSharing());
    this.on("copy", () => void this.copy(this.find<HTMLInputElement>("link").value));
    this.on("copy-embed", () => void this.copy(this.find<HTMLTextAreaElement>("embed").value));
    this.on("close", () => this.find<HTMLDialogElement>("sharing").close());
    this.on("picture", () => this.openSaving());
    this.on("save", () => void this.save());
    this.on("cancel", () => this.find<HTMLDialogElement>("saving").close());
    this.find("fullscreen").hidden = !document.fullscreenEnabled;
    const close = () => {
      this.find("menu").ariaExpanded = "false";
    };
    this.find("stage").addEventListener("pointerdown", close);
    this.find("more").addEventListener("click", ({ target }) => target instanceof HTMLButtonElement && close());
    viewer.on("mode", close);
    root.host.addEventListener("fullscreenchange", () => this.showFullscreen());
    steer(this.find("stick"), this.find<HTMLSelectElement>("mode"), viewer);
  }

  /** What a link to the present view says. */
  get view(): SharedView {
    const { camera, atCamera, cameraToWorld, zoom, path } = this.viewer.state;
    const background = this.backgrounds.chosen ? this.backgrounds.current : null;
    const quality = this.quality.written;
    if (path?.shown) return { camera: null, background, quality, pose: null, zoom: 1, frame: path.frame };
    return { camera: camera || null, background, quality, pose: atCamera ? null : cameraToWorld, zoom: atCamera ? 1 : zoom, frame: null };
  }

  /** Show what a link says; what it does not say stays. */
  show(view: SharedView): void {
    if (view.background) this.backgrounds.show(view.background);
    if (view.quality) this.quality.show(view.quality);
    const index = findCamera(this.viewer.cameras, view.camera);
    if (index >= 0) this.choose(index, view.pose || view.frame !== null ? 0 : FLIGHT);
    if (view.frame !== null) this.viewer.path?.seek(view.frame);
    else if (view.pose) this.viewer.lookFrom(view.pose, view.zoom);
  }

  /** Take a key; returns whether it means something. */
  press(key: string): boolean {
    const count = this.viewer.cameras.length;
    if (key === "r") this.reset();
    else if (key === "n" || key === "p") this.step(key === "n" ? 1 : -1);
    else if (key === "f") void this.toggleFullscreen();
    else if (key === "h" || key === "?") this.find<HTMLDialogElement>("helping").showModal();
    else if (key === "escape" && this.menuOpen) this.toggleMenu();
    else if (key === "i") this.find("readout").hidden = !this.find("readout").hidden;
    else if (key === "m") this.toggleFrame();
    else if (/^[1-9]$/.test(key) && Number(key) <= count) this.choose(Number(key) - 1, FLIGHT);
    else return false;
    return true;
  }

  /** A camera was chosen. */
  chosen(): void {
    this.gallery?.update();
  }

  /** Darken what lies outside the camera's image, as Blender does, where it was asked for, until the user moves. */
  showFrame(): void {
    const { frame, atCamera, camera } = this.viewer.state;
    const [left, top, width, height] = frame;
    this.find("frame").hidden = !this.frameShown || !atCamera || !camera || (left < 1 && top < 1);
    Object.assign(this.find("frame").style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
  }

  private get menuOpen(): boolean {
    return this.find("menu").ariaExpanded === "true";
  }

  /** Where the bar is narrow, a menu holds most of it. */
  private toggleMenu(): void {
    const open = !this.menuOpen;
    this.find("menu").ariaExpanded = String(open);
    this.find("more").style.maxHeight = `${this.find("stage").clientHeight}px`;
    if (!open) this.find("menu").focus();
  }

  private async toggleFullscreen(): Promise<void> {
    if (!document.fullscreenEnabled) return;
    if (document.fullscreenElement) await document.exitFullscreen();
    else await this.root.host.requestFullscreen();
  }

  private showFullscreen(): void {
    this.find("fullscreen").textContent = document.fullscreenElement ? "Leave full screen" : "Full screen";
  }

  private find<T extends HTMLElement>(id: string): T {
    return this.root.getElementById(id) as T;
  }

  private on(id: string, act: () => void): void {
    this.find(id).onclick = act;
  }

  private fillCameras(): void {
    const { cameras } = this.viewer;
    const select = this.find<HTMLSelectElement>("camera");
    // The page renders without lens distortion, and says so where the camera has one.
    const label = (name: string, distorted: boolean) => (distorted ? `${name} (lens not shown)` : name);
    select.replaceChildren(...cameras.map((camera, i) => new Option(label(labelOf(camera.name, i), !!camera.distortion), String(i))));
    const shown = cameras.findIndex((camera) => camera.name === this.viewer.state.camera);
    select.value = String(Math.max(shown, 0));
    if (cameras.some((camera) => camera.thumbnail)) this.gallery = new Gallery(select, this.viewer, (index) => this.choose(index, FLIGHT));
    select.onchange = () => this.choose(Number(select.value), FLIGHT);
    this.find("cameras").hidden = cameras.length === 0;
  }

  private step(by: number): void {
    const count = this.viewer.cameras.length;
    if (count) this.choose((Math.max(Number(this.find<HTMLSelectElement>("camera").value), 0) + by + count) % count, FLIGHT);
  }

  private reset(): void {
    if (this.viewer.cameras.length) this.step(0);
    else void this.viewer.goTo(undefined, { duration: FLIGHT });
  }

  private toggleFrame(): void {
    this.frameShown = !this.frameShown;
    this.showFrame();
  }

  private openSharing(): void {
    const address = new URL(location.href);
    address.hash = writeView(new URLSearchParams(address.hash.slice(1)), this.view).toString();
    this.find<HTMLInputElement>("link").value = address.href;
    const source = address.href.replaceAll("&", "&amp;").replaceAll('"', "&quot;");
    this.find<HTMLTextAreaElement>("embed").value = `<iframe src="${source}" width="800" height="600" allowfullscreen></iframe>`;
    this.find("copied").textContent = "";
    this.find<HTMLDialogElement>("sharing").showModal();
    this.find<HTMLInputElement>("link").select();
  }

  private async copy(text: string): Promise<void> {
    const copied = this.find("copied");
    try {
      await navigator.clipboard.writeText(text);
      copied.textContent = "Copied.";
    } catch {
      copied.textContent = "This browser lets no page copy here: select the text and copy it.";
    }
    setTimeout(() => {
      copied.textContent = "";
    }, LINK_SHOWN);
  }

  private openSaving(): void {
    const { width, height } = this.viewer.canvas;
    this.find<HTMLInputElement>("picture-width").value = String(width);
    this.find<HTMLInputElement>("picture-height").value = String(height);
    this.find<HTMLDialogElement>("saving").showModal();
  }

  private async save(): Promise<void> {
    const side = (id: string) => Math.min(Math.max(Math.round(Number(this.find<HTMLInputElement>(id).value)) || 1, 1), MAX_SIDE);
    const [width, height] = [side("picture-width"), side("picture-height")];
    const alpha = this.find<HTMLInputElement>("picture-alpha").checked;
    const picture = await this.viewer.capture({ width, height, alpha });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(picture);
    link.download = `${this.viewer.state.camera || "view"}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), LINK_SHOWN);
    this.find<HTMLDialogElement>("saving").close();
  }
}
