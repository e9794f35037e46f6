// A scene that is being read: its description at once, its texels slice by slice.
import { type FileSource, type SceneFiles, sourceOf } from "./files";
import { readIndirection, readScene, type SceneDescription } from "./scene";
import { readSlice, type SliceTexels, sliceOrder } from "./slices";

const CONCURRENT_SLICES = 3; // slices that are fetched and decoded at the same time: what bounds the memory

export interface LoadOptions {
  onProgress?: (progress: LoadProgress) => void;
  signal?: AbortSignal; // aborts what is still being read
  folder?: string; // of the scene in the source, with a slash at the end
  keep?: boolean; // keep the texels in memory, so that they can be read again
}

export interface LoadProgress {
  slices: number; // that have arrived
  totalSlices: number;
  bytes: number; // of all files that have arrived
}

export interface ReadOptions {
  signal?: AbortSignal; // in place of the scene's
  order?: readonly number[]; // of the atlas's layers of cells; those that it leaves out come last
}

/** A baked scene: what describes it, and the source of its texels. `SnergVolume` shows it; several volumes may show the same scene. */
export class SnergScene {
  private bytes = 0;
  private readonly kept = new Map<number, SliceTexels>();

  /** Of all files of texels that have arrived. */
  get bytesRead(): number {
    return this.bytes;
  }

  private constructor(
    readonly description: SceneDescription,
    readonly cells: Int32Array<ArrayBuffer>, // the cell of each macroblock, -1 where it is empty
    private readonly source: FileSource,
    private readonly options: LoadOptions,
  ) {}

  /**
   * Open a scene: read its description and its indirection grid. Its texels are read when a volume shows it.
   *
   * from: the address of a scene's folder (which holds scene.json), the folder's files by their names, or a source of files. Rejects
   * with a ViewerError that names what is missing or damaged, or with the signal's reason.
   */
  static async load(from: string | URL | SceneFiles | FileSource, options: LoadOptions = {}): Promise<SnergScene> {
    const source = sourceOf(from);
    const folder = options.folder ?? "";
    const description = await readScene(source, `${folder}scene.json`, options.signal);
    const cells = await readIndirection(source, `${folder}indirection.png`, description, options.signal);
    return new SnergScene(description, cells, source, options);
  }

  /** Read every slice and hand it over. Rejects as `load` does; nothing more is read after the first error. */
  async readSlices(take: (slice: number, texels: SliceTexels) => void | Promise<void>, options: ReadOptions = {}): Promise<void> {
    const { signal = this.options.signal, order } = options;
    const slices = sliceOrder(this.description, order);
    const source: FileSource = { read: (name, signal) => this.counted(name, signal) };
    let [next, done, failed] = [0, 0, false];
    const work = async () => {
      while (next < slices.length && !failed) {
        const slice = slices[next++];
        const known = this.kept.get(slice);
        const texels = known ?? (await readSlice(this.description, source, this.options.folder ?? "", slice, signal));
        if (this.options.keep) this.kept.set(slice, texels);
        if (failed) return;
        await take(slice, texels);
        this.options.onProgress?.({ slices: ++done, totalSlices: slices.length, bytes: this.bytes });
      }
    };
    const stop = (error: unknown) => {
      failed = true;
      throw error;
    };
    this.bytes = 0;
    await Promise.all(Array.from({ length: CONCURRENT_SLICES }, () => work().catch(stop)));
  }

  private async counted(name: string, signal?: AbortSignal): Promise<Uint8Array> {
    const bytes = await this.source.read(name, signal);
    this.bytes += bytes.length;
    return bytes;
  }
}
