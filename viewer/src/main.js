// The page: loads the scene, shows it or an error message, and runs the bar below it.
import { WebGLRenderer } from "three";
import { Atlas } from "./atlas.js";
import { ViewerError } from "./errors.js";
import { ProgressiveRenderer } from "./progressive_renderer.js";
import { readCameras, readIndirection, readScene } from "./scene.js";
import { View } from "./view.js";

const SCENE_FOLDER = "scene";
const BACKGROUNDS = new Map([["white", 1], ["grey", 128 / 255], ["black", 0]]); // a Map: the address may hold any word
const KEY_TURN = Math.PI / 36; // radians a key press
const MAX_SIZE = 8192; // pixels of a side that the address may ask for
const MAX_PIXEL_RATIO = 2; // device pixels a CSS pixel at most: bounds the number of rays on fine displays
const find = (id) => document.getElementById(id);
const canvas = find("canvas");

/** The options in the address: ?camera=NAME_OR_INDEX&background=black&width=W&height=H&ui=none. Those after # take precedence. */
function addressOptions() {
  const values = new URLSearchParams(location.search);
  new URLSearchParams(location.hash.slice(1)).forEach((value, key) => values.set(key, value));
  return values;
}

/** Show an error in place of the scene. */
function showError(error) {
  const known = error instanceof ViewerError;
  if (!known) console.error(error);
  hook.problem = known ? error.message : `The viewer failed (${error?.message ?? error}). Reload the page, or try another browser.`;
  window.snergProblem(hook.problem);
  fail(false);
}

/**
 * window.snerg, for tests and for pages that embed this one. ready: a promise of whether the scene is on the page. problem: the error
 * message, or null. frames: how many images were shown. settled(): a promise that the page shows the full image.
 */
const hook = { problem: null, frames: 0 };
let fail;
const failed = new Promise((resolve) => (fail = resolve));
window.snerg = hook;
window.addEventListener("error", (event) => event.error && showError(event.error));
window.addEventListener("unhandledrejection", (event) => showError(event.reason));

/** three's renderer for the canvas. Throws a ViewerError when the browser has no WebGL 2. */
function makeRenderer() {
  const options = { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" };
  const context = canvas.getContext("webgl2", options);
  if (!context) {
    throw new ViewerError(
      "This browser offers no WebGL 2, which renders the scene. Switch on graphics acceleration in its settings, or use a newer browser.",
    );
  }
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    showError(new ViewerError("The graphics driver was reset and the scene was lost from its memory. Reload the page."));
  });
  const renderer = new WebGLRenderer({ canvas, context });
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    const log = gl.getShaderInfoLog(fragment) || gl.getProgramInfoLog(program) || "it gives no reason";
    const reason = log.replace(/[\s\0]+/g, " ").trim().slice(0, 300);
    if (!gl.isContextLost()) showError(new ViewerError(`The graphics driver refuses the viewer's shader: ${reason}`));
  };
  return renderer;
}

/** Read the scene and upload its textures: {scene, cameras, textures}. Throws a ViewerError as the readers do. */
async function load(renderer) {
  const progress = (fraction, text) => {
    find("loading-bar").value = fraction;
    find("loading-text").textContent = text;
  };
  progress(0, "Loading the scene…");
  const [scene, cameras] = await Promise.all([readScene(`${SCENE_FOLDER}/scene.json`), readCameras("cameras.json")]);
  const cells = await readIndirection(`${SCENE_FOLDER}/indirection.png`, scene);
  const atlas = new Atlas(renderer, scene);
  await atlas.load(SCENE_FOLDER, (done, total) => progress(done / total, `Loading the scene: ${done} of ${total} slices`));
  const textures = { ...atlas.pages, distance: atlas.distanceTextures(), indirection: atlas.indirectionTexture(cells) };
  return { scene, cameras, textures };
}

/** Show the size and time of an image below it. */
function showImageInfo({ width, height, milliseconds }) {
  hook.frames++;
  find("loading").hidden = true; // a draft replaces the progress bar
  find("readout").textContent = `${width} × ${height} · ${milliseconds < 10 ? milliseconds.toFixed(1) : Math.round(milliseconds)} ms`;
}

/** Give the canvas the size that the address asks for, in device pixels, or else the room on the page, now and when it changes. */
function followSize(view, renderer, address) {
  const stage = find("stage");
  const [width, height] = ["width", "height"].map((key) => Math.min(Number.parseInt(address.get(key), 10) || 0, MAX_SIZE));
  const fixed = width > 0 && height > 0;
  document.body.classList.toggle("fixed-size", fixed);
  if (fixed) Object.assign(stage.style, { width: `${width}px`, height: `${height}px` });
  const resize = () => {
    const [w, h] = fixed ? [width, height] : [stage.clientWidth, stage.clientHeight];
    if (w < 1 || h < 1) return;
    const ratio = fixed ? 1 : Math.min(window.devicePixelRatio || 1, MAX_PIXEL_RATIO);
    view.resize(w, h);
    renderer.resize(Math.round(w * ratio), Math.round(h * ratio));
    showFrame(view);
  };
  new ResizeObserver(resize).observe(stage);
  resize();
}

/** Darken what lies outside the camera's image, as Blender does, until the user moves. */
function showFrame(view) {
  const [left, top, width, height] = view.frame;
  find("frame").hidden = !view.atCamera || !view.camera.name || (left < 1 && top < 1);
  Object.assign(find("frame").style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
}

/** The index of a camera by its name, or by its index as text; -1 if there is none. */
function findCamera(cameras, text) {
  if (text === null) return -1;
  const named = cameras.findIndex((camera) => camera.name === text);
  if (named >= 0) return named;
  return /^\d+$/.test(text) && Number(text) < cameras.length ? Number(text) : -1;
}

/** A camera in the list; the page renders without lens distortion, and says so where the camera has one. */
const labelOf = (camera) => (camera.distortion ? `${camera.name} (lens not shown)` : camera.name);

/** The bar's cameras, backgrounds and keys. jump(index): shows a camera. */
function connectBar(view, renderer, cameras, jump) {
  const select = find("camera");
  select.replaceChildren(...cameras.map((camera, i) => new Option(labelOf(camera), String(i))));
  find("cameras").hidden = cameras.length === 0;
  select.onchange = () => jump(Number(select.value));
  const step = (by) => cameras.length && jump((Math.max(Number(select.value), 0) + by + cameras.length) % cameras.length);
  find("previous").onclick = () => step(-1);
  find("next").onclick = () => step(1);
  const reset = () => (cameras.length ? jump(Math.max(Number(select.value), 0)) : view.jump(view.overview()));
  find("reset").onclick = reset;
  for (const input of document.querySelectorAll("[name=background]")) {
    input.onchange = () => {
      view.background = Array(3).fill(BACKGROUNDS.get(input.value));
      renderer.change();
    };
  }
  const turns = new Map(Object.entries({ ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }));
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
    const key = (event.key ?? "").toLowerCase(); // null when the browser fills in a form
    const turn = turns.get(event.key);
    if (turn) view.turn(turn[0] * KEY_TURN, turn[1] * KEY_TURN);
    else if (key === "r") reset();
    else if (key === "n" || key === "p") step(key === "n" ? 1 : -1);
    else if (/^[1-9]$/.test(key) && Number(key) <= cameras.length) jump(Number(key) - 1);
    else return;
    event.preventDefault();
  });
}

/** Choose a background by its name; white for an unknown name. */
function setBackground(view, name) {
  const key = BACKGROUNDS.has(name) ? name : "white";
  view.background = Array(3).fill(BACKGROUNDS.get(key));
  document.querySelector(`[name=background][value=${key}]`).checked = true;
}

async function start() {
  const webgl = makeRenderer();
  const { scene, cameras, textures } = await load(webgl);
  const renderer = new ProgressiveRenderer(webgl, scene, textures, showImageInfo);
  const view = new View(scene, canvas, () => {
    renderer.change();
    showFrame(view);
  });
  const jump = (index) => {
    find("camera").value = String(index);
    view.jump(cameras[index]);
    history.replaceState(null, "", `#${new URLSearchParams({ camera: cameras[index].name })}`);
  };
  const showAddressedCamera = () => {
    const index = findCamera(cameras, addressOptions().get("camera"));
    if (index < 0 && cameras.length === 0) return;
    find("camera").value = String(Math.max(index, 0));
    view.jump(cameras[Math.max(index, 0)]);
  };
  const address = addressOptions();
  connectBar(view, renderer, cameras, jump);
  find("bar").hidden = address.get("ui") === "none";
  setBackground(view, address.get("background"));
  showAddressedCamera();
  window.addEventListener("hashchange", showAddressedCamera);
  followSize(view, renderer, address);
  renderer.setView((width, height) => view.uniforms(width, height));
  hook.settled = () => renderer.settled();
  await renderer.settled();
  return hook.problem === null;
}

hook.ready = Promise.race([start(), failed]).catch((error) => {
  showError(error);
  return false;
});
