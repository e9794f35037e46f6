// The textures of a scene on a graphics card, which all its volumes there share: read once, freed with the last volume, and read again where
// the graphics context was lost.
import type { WebGLRenderer } from "three";
import { LAYER_SLICES, type SliceTexels } from "../data/slices";
import type { SnergScene } from "../data/snerg_scene";
import { Atlas, type AtlasTextures } from "./atlas";
import { StandIn, standsIn } from "./stand_in";

const FILL_TIME = 20; // milliseconds of filling after which the page may do something else

export interface GrowthOptions {
  /** The scene at a quarter of its resolution, from the same corner: it stands in for cells that have not arrived. */
  coarse?: SnergScene;
  /** When to begin to show it so, and not only when everything has arrived; at once without it. */
  wanted?: Promise<unknown>;
  /** The layers of the atlas's cells in the order in which they are read. */
  order?: readonly number[];
  /** After how many layers to show it so, wanted or not. */
  enough?: number;
}

/** What shows the textures. */
export interface TexturesUser {
  shown(textures: AtlasTextures, atlas: Atlas): void; // they can be drawn now; again, with other ones, after a lost context
  changed(): void; // more has arrived
  lost(): void; // with the graphics context; they will be shown again
  failed(error: unknown): void; // they could not be read again after a lost context
}

const known = new WeakMap<WebGLRenderer, Map<SnergScene, SharedTextures>>();

export class SharedTextures {
  /** How many layers of cells have arrived. */
  layersArrived = 0;
  private atlas: Atlas | null = null;
  private textures: AtlasTextures | null = null; // once they can be drawn
  private readonly users = new Set<TexturesUser>();
  private reading = new AbortController();
  private ready: Promise<void>;
  private readonly end = new AbortController();

  /** The textures of a scene, for one more user. growth: how they come, where nobody has asked for them yet. */
  static join(renderer: WebGLRenderer, scene: SnergScene, growth: GrowthOptions, user: TexturesUser): SharedTextures {
    const scenes = known.get(renderer) ?? new Map<SnergScene, SharedTextures>();
    known.set(renderer, scenes);
    const found = scenes.get(scene) ?? new SharedTextures(renderer, scene, growth);
    scenes.set(scene, found);
    found.users.add(user);
    if (found.textures && found.atlas) user.shown(found.textures, found.atlas);
    return found;
  }

  private constructor(
    private readonly renderer: WebGLRenderer,
    private readonly scene: SnergScene,
    growth: GrowthOptions,
  ) {
    const canvas = renderer.domElement;
    const { signal } = this.end;
    canvas.addEventListener("webglcontextlost", () => this.lose(), { signal });
    this.ready = this.begin(growth);
  }

  /** The graphics memory that the textures take, in bytes. */
  get bytes(): number {
    return this.atlas?.allBytes ?? 0;
  }

  /** Resolves when everything has arrived, after a lost context again. Rejects with a ViewerError. */
  async whole(): Promise<void> {
    for (;;) {
      const { ready } = this;
      const problem = await ready.then(
        () => null,
        (error: unknown) => ({ error }),
      );
      if (ready !== this.ready) continue; // the context was lost meanwhile
      if (problem) throw problem.error;
      return;
    }
  }

  /** One user fewer; without any, the graphics memory is freed, and what is still being read is given up. */
  leave(user: TexturesUser): void {
    if (!this.users.delete(user) || this.users.size > 0) return;
    this.forget();
    this.reading.abort();
    this.atlas?.dispose();
  }

  /** Who joins from now on begins anew. */
  private forget(): void {
    this.end.abort();
    const scenes = known.get(this.renderer);
    if (scenes?.get(this.scene) === this) scenes.delete(this.scene);
  }

  private begin(growth: GrowthOptions): Promise<void> {
    const reading = new AbortController();
    this.reading = reading;
    const ready = this.read(growth, reading.signal);
    ready.catch(() => !reading.signal.aborted && this.forget()); // so that one may try again
    return ready;
  }

  /** The context is lost, and all textures with it. */
  private lose(): void {
    this.reading.abort();
    this.textures = null;
    for (const user of this.users) user.lost();
    const restored = new Promise((resolve) =>
      this.renderer.domElement.addEventListener("webglcontextrestored", resolve, { once: true, signal: this.end.signal }),
    );
    this.ready = restored.then(() => {
      this.atlas?.dispose();
      return this.begin({});
    });
    this.ready.catch((error: unknown) => {
      for (const user of this.users) user.failed(error);
    });
  }

  private async read({ coarse, wanted, order, enough }: GrowthOptions, signal: AbortSignal): Promise<void> {
    const { scene } = this;
    const { description } = scene;
    const atlas = new Atlas(this.renderer, description);
    this.atlas = atlas;
    this.layersArrived = 0;
    const show = () => {
      const textures = atlas.textures(scene.cells);
      this.textures = textures;
      for (const user of this.users) user.shown(textures, atlas);
    };
    const missing = Array<number>(description.atlas_blocks[2]).fill(LAYER_SLICES); // slices of each layer
    let filled: Promise<void> | undefined;
    const fill = () => {
      if (filled || !coarse || !standsIn(coarse.description, description) || this.layersArrived === missing.length) return;
      filled = this.fill(atlas, coarse, signal).then(show);
      filled.catch(() => {}); // it is awaited below
    };
    if (wanted) wanted.then(fill);
    else fill();
    const take = async (slice: number, texels: SliceTexels) => {
      await filled;
      signal.throwIfAborted();
      atlas.take(slice, texels);
      const layer = Math.floor(slice / LAYER_SLICES);
      if (--missing[layer] > 0) return;
      this.layersArrived++;
      if (filled) {
        for (const user of this.users) user.changed();
      } else if (this.layersArrived === enough) fill();
    };
    await scene.readSlices(take, { signal, order });
    await filled;
    if (!filled) show();
  }

  /** Put the coarse scene in place of the cells that have not arrived. */
  private async fill(atlas: Atlas, coarse: SnergScene, signal: AbortSignal): Promise<void> {
    const standIn = await StandIn.read(coarse, signal);
    const [bx, by] = this.scene.description.blocks;
    let began = performance.now();
    for (const [index, cell] of this.scene.cells.entries()) {
      if (cell < 0 || !atlas.lacks(cell)) continue;
      atlas.fill(cell, standIn.texels([index % bx, Math.floor(index / bx) % by, Math.floor(index / (bx * by))]));
      if (performance.now() - began < FILL_TIME) continue;
      await new Promise((resolve) => setTimeout(resolve));
      signal.throwIfAborted();
      began = performance.now();
    }
  }
}
