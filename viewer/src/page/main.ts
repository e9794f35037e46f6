// The exported page: one <snerg-viewer>, and the address that says what it shows.
import { asViewerError } from "../errors";
import { TRANSPARENT } from "../viewer/backdrop";
import { defineElement, type SnergViewerElement } from "../viewer/element";
import { readView, writeView } from "../viewer/shared_view";

const WRITE_DELAY = 250; // milliseconds without a change after which the address follows the view

/** The options in the address: ?camera=NAME_OR_INDEX&background=black&quality=full&width=W&height=H&ui=none. Those after # take precedence. */
function addressOptions(): URLSearchParams {
  const values = new URLSearchParams(location.search);
  new URLSearchParams(location.hash.slice(1)).forEach((value, key) => {
    values.set(key, value);
  });
  return values;
}

const element = document.querySelector("snerg-viewer") as SnergViewerElement;
const address = addressOptions();
/** Where the background is transparent, the page is too: what is behind its frame shows through. */
const showThrough = () => document.documentElement.classList.toggle("clear", element.background === TRANSPARENT);

for (const key of ["camera", "background", "quality", "width", "height", "ui"]) {
  const value = address.get(key);
  if (value !== null) element.setAttribute(key, value);
}
document.body.classList.toggle("fixed-size", address.has("width") && address.has("height"));

/**
 * For tests, and for pages that embed this one. ready: a promise of whether the scene is on the page. problem: the error message, or
 * null. frames: how many images were shown. settled(): a promise that the page shows the full image.
 */
const hook = {
  frames: 0,
  get ready() {
    return element.ready;
  },
  get problem() {
    return element.problem;
  },
  settled: () => element.viewer?.settled(),
};
Object.assign(window, { snerg: hook });
window.addEventListener("error", (event) => event.error && element.fail(asViewerError(event.error)));
window.addEventListener("unhandledrejection", (event) => element.fail(asViewerError(event.reason)));

defineElement();
element.viewer?.on("image", () => hook.frames++);
showThrough();

/** Write the view into the address once it stands still; everything else that the address says stays. */
let writing = 0;
element.addEventListener("view", () => {
  showThrough();
  clearTimeout(writing);
  writing = window.setTimeout(() => {
    if (!element.bar) return;
    const parameters = writeView(new URLSearchParams(location.hash.slice(1)), element.bar.view);
    history.replaceState(history.state, "", `#${parameters}`);
  }, WRITE_DELAY);
});
const showAddressed = () => {
  element.bar?.show(readView(addressOptions()));
  showThrough();
};
element.addEventListener("picture", () => ["view", "frame"].some((key) => addressOptions().has(key)) && showAddressed());
window.addEventListener("hashchange", showAddressed);

/** #benchmark, or #benchmark=synthetic, =forward-facing or =360, measures the scene once it is there; &frames=N: fewer than 150. */
const measureAddressed = () => {
  const address = addressOptions();
  const kind = address.get("benchmark");
  if (kind === null || element.problem !== null) return;
  const keep = (result: unknown) => Object.assign(hook, { benchmark: result });
  element.benchmark(kind, Number(address.get("frames")) || undefined).then(keep, (error) => element.report(asViewerError(error)));
};
measureAddressed();
window.addEventListener("hashchange", ({ oldURL }) => !new URL(oldURL).hash.includes("benchmark") && measureAddressed());
window.addEventListener("keydown", (event) => event.target === document.body && element.press(event));
