// Where a scene's files come from: a server, the page itself (a single-file page), or files that a person chose.
import { EXPORT_AGAIN, ViewerError } from "../errors";

/** Reads a file by its path relative to the scene. Rejects with a ViewerError that names the file, or with the signal's reason. */
export interface FileSource {
  read(name: string, signal?: AbortSignal): Promise<Uint8Array>;
}

/** Files by their path relative to the scene, as from a folder that was dropped on a page. */
export type SceneFiles = ReadonlyMap<string, Blob | Uint8Array>;

const ATTEMPTS = 4; // to fetch a file
const FIRST_PAUSE = 300; // milliseconds before the second attempt; doubled before each one after it

/** The files below an address, which may be relative to the page; a fetch that fails is repeated, each time after a longer pause. */
export class ServerFiles implements FileSource {
  private readonly base: string;

  constructor(url: string | URL) {
    const address = new URL(url, document.baseURI);
    if (!address.pathname.endsWith("/")) address.pathname += "/";
    this.base = address.href;
  }

  async read(name: string, signal?: AbortSignal): Promise<Uint8Array> {
    const address = new URL(name, this.base);
    if (address.protocol === "file:") {
      throw new ViewerError(
        "This page was opened from the disk, and browsers do not let such a page read other files. " +
          "Serve its folder (for instance: python3 -m http.server, in the folder, then open http://localhost:8000), " +
          "or export it as a single file.",
      );
    }
    for (let attempt = 1, pause = FIRST_PAUSE; ; attempt++, pause *= 2) {
      const { bytes, problem, final } = await fetchOnce(address, name, signal);
      if (bytes) return bytes;
      if (final || attempt === ATTEMPTS) throw problem;
      await wait(pause, signal);
    }
  }
}

interface Fetched {
  bytes?: Uint8Array;
  problem?: ViewerError;
  final?: boolean; // whether another attempt would end in the same way
}

async function fetchOnce(address: URL, name: string, signal?: AbortSignal): Promise<Fetched> {
  let response: Response;
  try {
    response = await fetch(address, { signal });
  } catch {
    signal?.throwIfAborted();
    return { problem: new ViewerError(`The file ${name} did not arrive: the server cannot be reached. Reload the page.`) };
  }
  if (!response.ok) {
    const what = response.status === 404 ? "is missing from the server" : `did not arrive (the server answered ${response.status})`;
    const final = response.status < 500 && response.status !== 408 && response.status !== 429;
    return { problem: new ViewerError(`The file ${name} ${what}. Upload the whole folder of the page.`), final };
  }
  try {
    return { bytes: new Uint8Array(await response.arrayBuffer()) };
  } catch {
    signal?.throwIfAborted();
    return { problem: new ViewerError(`The file ${name} arrived incomplete. Reload the page.`) };
  }
}

function wait(milliseconds: number, signal?: AbortSignal): Promise<void> {
  return new Promise((resolve, reject) => {
    const abort = () => {
      clearTimeout(timer);
      reject(signal?.reason);
    };
    const timer = setTimeout(() => {
      signal?.removeEventListener("abort", abort);
      resolve();
    }, milliseconds);
    signal?.addEventListener("abort", abort, { once: true });
  });
}

/** Files that are at hand already. */
export class ChosenFiles implements FileSource {
  constructor(private readonly files: SceneFiles) {}

  async read(name: string): Promise<Uint8Array> {
    const file = this.files.get(name);
    if (file === undefined) throw new ViewerError(`The file ${name} is not among the chosen files. Choose the whole folder of the scene.`);
    return file instanceof Uint8Array ? file : new Uint8Array(await file.arrayBuffer());
  }
}

const taken = new Map<string, Blob>(); // files that were read from the page, by their paths: browsers put large ones on the disk

/**
 * Files inside the page, as base64 in script elements with `data-file="<folder>/<name>"`. Reading one removes its text from the page, to
 * free memory; it can be read again.
 */
export class EmbeddedFiles implements FileSource {
  constructor(private readonly folder: string) {}

  /** Whether the page holds files. */
  static areThere(): boolean {
    return document.querySelector("script[data-file]") !== null;
  }

  async read(name: string): Promise<Uint8Array> {
    const path = this.folder + name;
    const known = taken.get(path);
    if (known) return new Uint8Array(await known.arrayBuffer());
    const element = document.querySelector(`script[data-file="${CSS.escape(path)}"]`);
    if (!element) throw new ViewerError(`The file ${path} is missing from this page. ${EXPORT_AGAIN}`);
    const text = element.textContent ?? "";
    element.remove();
    const bytes = fromBase64(text, path);
    taken.set(path, new Blob([bytes]));
    return bytes;
  }
}

/** The source of a folder's files: below an address, at hand, or a source already. */
export function sourceOf(from: string | URL | SceneFiles | FileSource): FileSource {
  if (typeof from === "string" || from instanceof URL) return new ServerFiles(from);
  return "read" in from ? from : new ChosenFiles(from);
}

/** The value of a JSON file. Rejects with a ViewerError as the source does, or where the file is not JSON. */
export async function readJson(source: FileSource, name: string, signal?: AbortSignal): Promise<unknown> {
  const bytes = await source.read(name, signal);
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(bytes));
  } catch {
    throw new ViewerError(`The file ${name} is damaged: it is not JSON. ${EXPORT_AGAIN}`);
  }
}

/** Throws a ViewerError that names the file. */
function fromBase64(text: string, path: string): Uint8Array<ArrayBuffer> {
  const native = (Uint8Array as unknown as { fromBase64?: (text: string) => Uint8Array<ArrayBuffer> }).fromBase64;
  try {
    if (native) return native(text);
    const binary = atob(text);
    const bytes = new Uint8Array(binary.length);
    for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
    return bytes;
  } catch {
    throw new ViewerError(`The file ${path} in this page is damaged. ${EXPORT_AGAIN}`);
  }
}
