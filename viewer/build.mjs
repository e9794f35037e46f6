// Builds dist/: snerg-viewer.js, a module that leaves three.js to the page; and for exported pages, which core/export/bundle.py writes,
// viewer.js, a script with the part of three.js that it uses, and optional/NAME.js, the code that only some pages need.
import { readdir, readFile, rm } from "node:fs/promises";
import { createRequire } from "node:module";
import { dirname, join, relative, sep } from "node:path";
import { fileURLToPath } from "node:url";
import { build } from "esbuild";

const here = dirname(fileURLToPath(import.meta.url));
const source = join(here, "src");
const dist = join(here, "dist");
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

/** Leaves everything that optional code imports from outside of its folder to viewer.js, by paths in src/ without their suffixes. */
const shareViewer = {
  name: "share-viewer",
  setup(build) {
    build.onResolve({ filter: /.*/ }, async ({ path, kind, importer, resolveDir }) => {
      if (kind === "entry-point" || !importer.startsWith(join(source, "optional"))) return undefined;
      if (!path.startsWith(".")) return { path, external: true };
      const inside = relative(source, join(resolveDir, path)).split(sep).join("/");
      return inside.startsWith("optional/") ? undefined : { path: `./${inside}`, external: true };
    });
  },
};

/** What optional scripts import, by the modules' paths: the names of each. */
async function sharedNames(entryPoints) {
  const names = new Map();
  const settings = { ...common, plugins: [shareViewer], format: "esm", outdir: dist, write: false };
  for (const { text } of (await build({ ...settings, entryPoints })).outputFiles) {
    for (const [, list, path] of text.matchAll(/^import \{([^}]*)\} from "([^"]+)";$/gm)) {
      const imported = list.split(",").map((item) => item.trim().split(" as ")[0]);
      names.set(path, new Set([...(names.get(path) ?? []), ...imported]));
    }
  }
  return names;
}

/** The module "snerg-shared" of viewer.js: what optional scripts import, and no more. */
const shareWith = (names) => ({
  name: "share-with",
  setup(build) {
    build.onResolve({ filter: /^snerg-shared$/ }, ({ path }) => ({ path, namespace: "shared" }));
    build.onResolve({ filter: /\/load_optional$/ }, () => ({ path: join(source, "load_optional_script.ts") }));
    build.onLoad({ filter: /.*/, namespace: "shared" }, () => {
      const modules = [...names].map(([path, found], i) => ({
        path: JSON.stringify(path),
        items: [...found].map((name) => [name, `${name}_${i}`]),
      }));
      const imports = modules.map(({ path, items }) => `import { ${items.map((pair) => pair.join(" as "))} } from ${path};`);
      const values = modules.map(({ path, items }) => `${path}: { __esModule: true, ${items.map((pair) => pair.join(": "))} }`);
      return { contents: `${imports.join("\n")}\nexport const SHARED = { ${values.join(", ")} };`, resolveDir: source };
    });
  },
});

const optional = (await readdir(join(source, "optional"))).filter((name) => name !== "modules.ts" && name.endsWith(".ts"));
const entryPoints = optional.map((name) => join(source, "optional", name));
await rm(dist, { recursive: true, force: true });
await build({
  ...common,
  entryPoints: [join(source, "page/main.ts")],
  outfile: join(dist, "viewer.js"),
  plugins: [shareWith(await sharedNames(entryPoints))],
  minify: true,
  format: "iife", // a classic script: browsers load no modules from file://, where the page must show its message
  banner: { js: `/*! The SNeRG viewer, GPL-3.0-or-later. It contains three.js ${version}:\n\n${licence.trim()}\n*/` },
});
for (const entryPoint of entryPoints) {
  const name = JSON.stringify(entryPoint.slice(join(source, "optional").length + 1, -".ts".length));
  await build({
    ...common,
    entryPoints: [entryPoint],
    outdir: join(dist, "optional"),
    plugins: [shareViewer],
    minify: true,
    format: "cjs", // in a function: the script registers, and runs when viewer.js asks for it
    banner: { js: `(globalThis.snergOptional ??= {})[${name}] = (require) => { const module = { exports: {} };` },
    footer: { js: "return module.exports; };" },
  });
}
await build({
  ...common,
  entryPoints: [join(source, "index.ts")],
  entryNames: "snerg-viewer",
  chunkNames: "parts/[name]-[hash]",
  outdir: dist,
  splitting: true, // optional code is in files of its own
  format: "esm",
  external: ["three", "three/*"],
});
