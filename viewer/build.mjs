// Builds dist/: snerg-viewer.js, a module that leaves three.js to the page; viewer.js, a script for exported pages
// with the part of three.js that it uses; and path.js, which plays camera paths in those that have one. core/export/bundle.py copies both.
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const three = join(dirname(createRequire(import.meta.url).resolve("three")), "..");
const { version } = JSON.parse(await readFile(join(three, "package.json"), "utf8"));
const licence = await readFile(join(three, "LICENSE"), "utf8");
const common = {
  bundle: true,
  target: ["chrome100", "firefox113", "safari16.4"],
  loader: { ".glsl": "text", ".css": "text", ".html": "text" },
  legalComments: "none", // the banner of viewer.js holds the whole licence of three.js
  charset: "utf8",
  logLevel: "warning",
};

await build({
  ...common,
  entryPoints: [join(here, "src/page/main.ts")],
  outfile: join(here, "dist/viewer.js"),
  minify: true,
  format: "iife", // a classic script: browsers load no modules from file://, where the page must show its message
  banner: { js: `/*! The SNeRG viewer, GPL-3.0-or-later. It contains three.js ${version}:\n\n${licence.trim()}\n*/` },
});
await build({
  ...common,
  entryPoints: [join(here, "src/viewer/path_part.ts")],
  outfile: join(here, "dist/path.js"),
  minify: true,
  format: "iife",
  globalName: "snergPath", // by which viewer.js finds it, see src/viewer/parts.ts
  banner: { js: "/*! Camera paths of the SNeRG viewer, GPL-3.0-or-later. */" },
});
await build({
  ...common,
  entryPoints: [join(here, "src/index.ts")],
  outfile: join(here, "dist/snerg-viewer.js"),
  format: "esm",
  external: ["three", "three/*"],
});
