// The benchmark as a dialog: its progress, its result as text, and the result as a file.
import { asViewerError } from "../../errors";
import type { Viewer } from "../../viewer/interface";
import type { BenchmarkResult } from "./measure";
import { type BenchmarkKind, KINDS } from "./path";

const NAMES: Record<BenchmarkKind, string> = {
  synthetic: "an orbit round a synthetic scene",
  "forward-facing": "a circle before a forward-facing scene",
  "360": "an orbit round a photographed scene",
};

/** Measure, in a dialog below `root`, whose style it takes. kind: of KINDS; anything else is chosen from the scene. frames: see `measure`. */
export async function openBenchmark(root: ShadowRoot, viewer: Viewer, kind: string, frames?: number): Promise<BenchmarkResult | null> {
  const dialog = document.createElement("dialog");
  dialog.id = "benchmark";
  dialog.setAttribute("aria-labelledby", "benchmark-title");
  const heading = element("h1", "Benchmark");
  heading.id = "benchmark-title";
  const text = element("p", "Loading the scene…");
  text.setAttribute("role", "status");
  const bar = document.createElement("progress");
  Object.assign(bar, { id: "benchmark-bar", max: 1, value: 0, ariaLabel: "Frames" });
  const actions = document.createElement("div");
  actions.className = "actions";
  const close = button("Cancel", () => dialog.close());
  actions.append(close);
  dialog.append(heading, text, bar, actions);
  root.append(dialog);
  const abort = new AbortController();
  dialog.addEventListener("close", () => {
    abort.abort();
    dialog.remove();
  });
  dialog.showModal();
  try {
    const onProgress = (done: number, total: number) => {
      bar.value = done / total;
      text.textContent = `Frame ${done} of ${total}`;
    };
    const chosen = kind in KINDS ? (kind as BenchmarkKind) : undefined;
    const result = await viewer.benchmark({ kind: chosen, frames, onProgress, signal: abort.signal });
    text.replaceWith(table(result));
    bar.remove();
    close.textContent = "Close";
    actions.prepend(button("Save JSON", () => save(result)));
    return result;
  } catch (error) {
    if (abort.signal.aborted) return null;
    text.textContent = asViewerError(error).message;
    bar.remove();
    close.textContent = "Close";
    return null;
  }
}

/** The result as rows of a name and a value. */
function table(result: BenchmarkResult): HTMLElement {
  const rows = {
    "Frames a second": result.fps.toFixed(result.fps < 10 ? 2 : 1),
    "Time of a frame": `${result.ms.toFixed(result.ms < 10 ? 2 : 1)} ms`,
    "Graphics memory": `${result.memory_megabytes.toFixed(0)} MB`,
    Files: `${result.megabytes.toFixed(1)} MB, ${result.codec}`,
    Path: `${result.frames} frames on ${NAMES[result.kind]}`,
    Picture: `${result.width} × ${result.height} pixels, ${result.field_of_view}°`,
    Scene: `${result.voxels.join(" × ")} voxels, ${result.cells} blocks, ${result.view_dependent ? "view-dependent" : "diffuse"}`,
    Graphics: result.graphics,
  };
  const list = element("dl", "");
  for (const [name, value] of Object.entries(rows)) list.append(element("dt", name), element("dd", value));
  return list;
}

function save(result: BenchmarkResult): void {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([`${JSON.stringify(result, null, 1)}\n`], { type: "application/json" }));
  link.download = "benchmark.json";
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 2000);
}

function element(name: string, text: string): HTMLElement {
  const made = document.createElement(name);
  made.textContent = text;
  return made;
}

function button(text: string, act: () => void): HTMLButtonElement {
  const made = document.createElement("button");
  Object.assign(made, { type: "button", textContent: text, onclick: act });
  return made;
}
