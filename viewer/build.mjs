// Bundles the viewer and the part of three.js that it uses into dist/viewer.js, which core/export/bundle.py copies.
import { readFile } from "node:fs/promises";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = new URL(".", import.meta.url);
const three = new URL("../node_modules/three/", here);
const { version } = JSON.parse(await readFile(new URL("package.json", three), "utf8"));
const licence = await readFile(new URL("LICENSE", three), "utf8");

await build({
  entryPoints: [fileURLToPath(new URL("src/main.js", here))],
  outfile: fileURLToPath(new URL("dist/viewer.js", here)),
  bundle: true,
  minify: true,
  format: "iife", // a classic script: browsers load no modules from file://, where the page must show its message
  target: ["chrome100", "firefox113", "safari16.4"],
  loader: { ".glsl": "text" },
  legalComments: "none", // the banner holds the whole licence of three.js
  charset: "utf8",
  banner: {
    js: `/*! The SNeRG viewer, GPL-3.0-or-later. It contains three.js ${version}:\n\n${licence.trim()}\n*/`,
  },
  logLevel: "warning",
});
