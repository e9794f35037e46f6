// The page: load the scene, or say plainly why not; then pictures, cameras and the bar below.
import { WebGLRenderer } from "three";
import { Atlas } from "./atlas.js";
import { Painter } from "./painter.js";
import { Problem } from "./problem.js";
import { readCameras, readIndirection, readScene } from "./scene.js";
import { View } from "./view.js";

const SCENE = "scene";
const BACKGROUNDS = new Map([["white", 1], ["grey", 128 / 255], ["black", 0]]); // a Map: any word may stand in the address
const KEY_TURN = Math.PI / 36;
const find = (id) => document.getElementById(id);
const canvas = find("canvas");

/** From the address: ?camera=NAME_OR_INDEX&background=black&width=W&height=H&ui=none; what follows # wins. */
function addressed() {
  const values = new URLSearchParams(location.search);
  new URLSearchParams(location.hash.slice(1)).forEach((value, key) => values.set(key, value));
  return values;
}

function say(problem) {
  const known = problem instanceof Problem;
  if (!known) console.error(problem);
  hook.problem = known ? problem.message : `The viewer failed (${problem?.message ?? problem}). Reload the page, or try another browser.`;
  window.snergProblem(hook.problem);
  fail(false);
}

/** For tests and for pages that embed this one: `ready` resolves to whether the scene is on the page. */
const hook = { problem: null, frames: 0 };
let fail;
const failed = new Promise((resolve) => (fail = resolve));
window.snerg = hook;
window.addEventListener("error", (event) => event.error && say(event.error));
window.addEventListener("unhandledrejection", (event) => say(event.reason));

function makeRenderer() {
  const options = { alpha: false, antialias: false, depth: false, stencil: false, powerPreference: "high-performance" };
  const context = canvas.getContext("webgl2", options);
  if (!context) {
    throw new Problem(
      "This browser offers no WebGL 2, which draws the scene. Switch on graphics acceleration in its settings, or use a newer browser.",
    );
  }
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();
    say(new Problem("The graphics driver was reset and the scene left its memory. Reload the page."));
  });
  const renderer = new WebGLRenderer({ canvas, context });
  renderer.autoClear = false;
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    const log = gl.getShaderInfoLog(fragment) || gl.getProgramInfoLog(program) || "it gives no reason";
    if (!gl.isContextLost()) say(new Problem(`The graphics driver refuses the viewer's shader: ${log.replace(/[\s\0]+/g, " ").trim().slice(0, 300)}`));
  };
  return renderer;
}

async function load(renderer) {
  const progress = (fraction, text) => {
    find("loading-bar").value = fraction;
    find("loading-text").textContent = text;
  };
  progress(0, "Loading the scene…");
  const [scene, cameras] = await Promise.all([readScene(`${SCENE}/scene.json`), readCameras("cameras.json")]);
  const cells = await readIndirection(`${SCENE}/indirection.png`, scene);
  const atlas = new Atlas(renderer, scene);
  await atlas.load(SCENE, (done, total) => progress(done / total, `Loading the scene: ${done} of ${total} slices`));
  const textures = { ...atlas.pages, skip: atlas.skipTextures(), indirection: atlas.indirectionTexture(cells) };
  return { scene, cameras, textures, bytes: atlas.bytes };
}

function readout({ width, height, milliseconds }) {
  hook.frames++;
  find("loading").hidden = true; // a coarse picture is better than a bar
  find("readout").textContent = `${width} × ${height} · ${milliseconds < 10 ? milliseconds.toFixed(1) : Math.round(milliseconds)} ms`;
}

/** Size of the page's picture: what the address asks for, at one pixel a pixel, or the room there is. */
function follow(view, painter, address) {
  const stage = find("stage");
  const [width, height] = ["width", "height"].map((key) => Math.min(Number.parseInt(address.get(key), 10) || 0, 8192));
  const exact = width > 0 && height > 0;
  document.body.classList.toggle("exact", exact);
  if (exact) Object.assign(stage.style, { width: `${width}px`, height: `${height}px` });
  const resize = () => {
    const [w, h] = exact ? [width, height] : [stage.clientWidth, stage.clientHeight];
    if (w < 1 || h < 1) return;
    const ratio = exact ? 1 : Math.min(window.devicePixelRatio || 1, 2);
    view.resize(w, h);
    painter.resize(Math.round(w * ratio), Math.round(h * ratio));
    frame(view);
  };
  new ResizeObserver(resize).observe(stage);
  resize();
}

/** Show what of the page the camera's own picture is, as Blender does, while nobody has moved. */
function frame(view) {
  const [left, top, width, height] = view.frame;
  find("frame").hidden = !view.exact || !view.camera.name || (left < 1 && top < 1);
  Object.assign(find("frame").style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
}

function chosen(cameras, text) {
  if (text === null) return -1;
  const named = cameras.findIndex((camera) => camera.name === text);
  if (named >= 0) return named;
  return /^\d+$/.test(text) && Number(text) < cameras.length ? Number(text) : -1;
}

/** The page draws straight lines straight: it says so where a camera's lens does not. */
const labelOf = (camera) => (camera.distortion ? `${camera.name} (lens not shown)` : camera.name);

function bar(view, painter, cameras, jump) {
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
      painter.change();
    };
  }
  const turns = new Map(Object.entries({ ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }));
  window.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT"].includes(event.target.tagName)) return;
    const key = (event.key ?? "").toLowerCase(); // a form that is filled in has none
    const turn = turns.get(event.key);
    if (turn) view.turn(turn[0] * KEY_TURN, turn[1] * KEY_TURN);
    else if (key === "r") reset();
    else if (key === "n" || key === "p") step(key === "n" ? 1 : -1);
    else if (/^[1-9]$/.test(key) && Number(key) <= cameras.length) jump(Number(key) - 1);
    else return;
    event.preventDefault();
  });
}

/** One of the swatches by its name; white for any other. */
function setBackground(view, name) {
  const key = BACKGROUNDS.has(name) ? name : "white";
  view.background = Array(3).fill(BACKGROUNDS.get(key));
  document.querySelector(`[name=background][value=${key}]`).checked = true;
}

async function start() {
  const renderer = makeRenderer();
  const { scene, cameras, textures } = await load(renderer);
  const painter = new Painter(renderer, scene, textures, readout);
  const view = new View(scene, canvas, () => {
    painter.change();
    frame(view);
  });
  const jump = (index) => {
    find("camera").value = String(index);
    view.jump(cameras[index]);
    history.replaceState(null, "", `#${new URLSearchParams({ camera: cameras[index].name })}`);
  };
  const go = () => {
    const index = chosen(cameras, addressed().get("camera"));
    if (index < 0 && cameras.length === 0) return;
    find("camera").value = String(Math.max(index, 0));
    view.jump(cameras[Math.max(index, 0)]);
  };
  const address = addressed();
  bar(view, painter, cameras, jump);
  find("bar").hidden = address.get("ui") === "none";
  setBackground(view, address.get("background"));
  go();
  window.addEventListener("hashchange", go);
  follow(view, painter, address);
  painter.paint((width, height) => view.uniforms(width, height));
  hook.settled = () => painter.settled();
  await painter.settled();
  return hook.problem === null;
}

hook.ready = Promise.race([start(), failed]).catch((problem) => {
  say(problem);
  return false;
});
