// Brings a scene to the graphics card: first its copy at a quarter of the resolution, then cells as they arrive, or the copy alone where the
// quality or the device does not hold the whole. Begins again where the graphics context is lost.
import type { Scene, WebGLRenderer } from "three";
import type { LayerOrder } from "../data/cameras";
import type { SnergScene } from "../data/snerg_scene";
import { TooLarge } from "../errors";
import { type GrowthOptions, SnergVolume } from "../volume/volume";
import { type QualityName, tooMuchFor } from "./quality";

const TOO_LARGE = "this device's graphics memory or driver does not hold the whole";

/** The viewer that a scene grows in. */
export interface GrowthHost {
  readonly renderer: WebGLRenderer;
  readonly world: Scene; // holds the volume that is shown
  readonly signal: AbortSignal; // of the viewer's end
  quality(): QualityName;
  /** Whether pictures are drawn. */
  begun(): boolean;
  /** Something can be drawn for the first time. */
  begin(scene: SnergScene): void;
  /** Another scene is shown: begin the picture anew. */
  change(): void;
  /** The scene is finer: bring the picture up to date. */
  refine(): void;
  /** Whether something lies over the canvas, so that unfinished pictures need not be drawn. */
  covered(): boolean;
  /** Resolves when nothing lies over the canvas any more. */
  uncovered(): Promise<void>;
  /** Resolves when the picture is drawn. */
  settled(): Promise<void>;
  /** `whole` has changed. */
  follow(): void;
  notice(text: string | null): void;
  /** An optional file is missing or damaged. Throws when the viewer is closed. */
  leaveOut(error: unknown): null;
  fail(error: unknown): void;
}

export class GrowingScene {
  /** What is shown; null until there is something. */
  volume: SnergVolume | null = null;
  /** Whether all of the scene is there, or of the coarse one in its place. */
  whole = false;
  /** Whether all is there that the first camera sees. */
  fine = false;
  /** Resolves when what was asked for is on the card. */
  filling: Promise<void> = Promise.resolve(); // one after another
  private scene: SnergScene | null = null;
  private coarse: SnergScene | null = null; // shown first, where the scene has not arrived, and where the whole is too large
  private layers: LayerOrder | null = null;
  private growing: SnergVolume | null = null;
  private grown = false; // since the picture was begun
  private unfit = false; // whether the device turned out not to hold the whole scene
  private refining = false; // whether `refine` waits for a picture
  private losses = 0; // of the graphics context

  constructor(private readonly host: GrowthHost) {}

  /** Bring a scene to the card. Rejects with a ViewerError. */
  load(scene: SnergScene, coarse: SnergScene | null, layers: LayerOrder | null): Promise<void> {
    this.scene = scene;
    this.coarse = coarse;
    this.layers = layers;
    this.filling = this.fill(scene);
    return this.filling;
  }

  /** Another quality is in force: show what it holds. */
  changeQuality(): void {
    this.filling = this.filling.then(() => this.fit());
    this.filling.catch((error: unknown) => this.host.fail(error));
  }

  /** The graphics context is lost. What is on its way to the card is given up; `fill` begins again. */
  lose(): void {
    this.losses++;
    this.growing?.dispose();
    if (!this.volume || this.volume !== this.growing) return;
    this.host.world.remove(this.volume);
    this.volume = null;
  }

  /** There is a graphics context again: bring the scene to the card, where it was there. */
  async restore(): Promise<void> {
    const shown = this.volume?.source ?? this.scene;
    if (this.whole && shown) await this.show(shown);
  }

  /**
   * Show the scene: first the coarse one, then one that grows, unless it is too large. Begins again where the graphics context is lost
   * meanwhile; where that happens a second time, the scene is taken to be too large.
   */
  private async fill(scene: SnergScene, lostBefore = 0): Promise<void> {
    const { losses, host } = this;
    const { order, seen } = this.layers ?? {};
    try {
      if (this.coarse && (lostBefore || this.volume?.source !== this.coarse)) await this.showCoarse(this.coarse, losses);
      if (!this.tooLarge) await this.show(scene, { coarse: this.coarse ?? undefined, wanted: host.uncovered(), order, enough: seen });
    } catch (error) {
      if (host.signal.aborted) throw error;
      const lost = losses === this.losses ? 0 : 1;
      if (!lost && !(this.coarse && error instanceof TooLarge && !this.unfit)) throw error;
      this.unfit ||= !lost || lostBefore > 0;
      if (lost) await this.contextRestored();
      return this.fill(scene, lostBefore + lost);
    }
    this.whole = this.fine = true;
    this.notify(this.tooLarge);
    host.refine();
  }

  /** Show the coarse scene; without it one waits longer for the picture. losses: of the graphics context, when it began. */
  private async showCoarse(coarse: SnergScene, losses: number): Promise<void> {
    try {
      await this.show(coarse);
    } catch (error) {
      if (losses !== this.losses) throw error;
      this.coarse = this.host.leaveOut(error);
    }
  }

  /** Why the coarse scene is shown in place of the whole one, or null. A scene without a coarse one is shown whole. */
  private get tooLarge(): string | null {
    if (!this.scene || !this.coarse) return null;
    return this.unfit ? TOO_LARGE : tooMuchFor(this.host.quality(), this.scene.description);
  }

  private notify(reason: string | null): void {
    this.host.notice(reason && `The scene is shown at a quarter of its resolution: ${reason}.`);
  }

  /** After a change of the quality: show the whole scene where it now fits, else the coarse one. */
  private async fit(): Promise<void> {
    const { scene, coarse, volume } = this;
    const wanted = this.tooLarge ? coarse : scene;
    if (!scene || !coarse || !volume) return;
    if (volume.source === wanted) return this.notify(this.tooLarge);
    this.whole = this.fine = false;
    this.host.follow();
    await this.fill(scene);
    this.host.follow();
  }

  /** Show a scene in place of the one before, as soon as there is something of it on the card. */
  private async show(scene: SnergScene, growth: GrowthOptions = {}): Promise<void> {
    const { signal, renderer } = this.host;
    const volume = new SnergVolume(scene, { srgbTargets: true });
    const dispose = () => volume.dispose();
    signal.addEventListener("abort", dispose, { once: true }); // also while it is being read
    volume.addEventListener("change" as never, () => this.grow(volume));
    this.growing = volume;
    try {
      await volume.load(renderer, growth);
    } catch (error) {
      signal.removeEventListener("abort", dispose);
      volume.dispose();
      throw error;
    } finally {
      if (this.growing === volume) this.growing = null;
    }
  }

  /** A volume looks different: bring it into the world, or the picture up to date. */
  private grow(volume: SnergVolume): void {
    const { host } = this;
    if (this.volume !== volume) {
      host.world.remove(...(this.volume ? [this.volume] : []));
      this.volume?.dispose();
      this.volume = volume;
      host.world.add(volume);
      if (!host.begun()) host.begin(volume.source);
      else if (!this.coarse || this.whole) host.change();
    }
    const seen = this.layers?.seen ?? Number.POSITIVE_INFINITY;
    if (this.fine || volume.source !== this.scene || volume.layersArrived < seen) return void this.refine();
    this.fine = true; // all that the first camera sees is there
    host.refine();
  }

  /** Bring the picture up to date, unless one is being drawn: then after it. */
  private async refine(): Promise<void> {
    const { host } = this;
    this.grown = true;
    if (this.refining) return;
    this.refining = true;
    while (this.grown && !this.whole && !host.signal.aborted) {
      await host.settled();
      this.grown = false;
      if (!host.covered()) host.refine();
    }
    this.refining = false;
  }

  /** Resolves when there is a graphics context again. */
  private contextRestored(): Promise<void> {
    const { renderer } = this.host;
    if (!renderer.getContext().isContextLost()) return Promise.resolve();
    return new Promise((resolve) => renderer.domElement.addEventListener("webglcontextrestored", () => resolve(), { once: true }));
  }
}
