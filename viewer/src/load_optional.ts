// Loads code that only some pages need. In the package it is a module; an exported page has it as a script of its own, or not at all:
// in viewer.js, load_optional_script.ts takes the place of this file.
import type { OptionalModules } from "./optional/modules";

type Loaders = { [Name in keyof OptionalModules]: () => Promise<OptionalModules[Name]> };

const LOADERS: Loaders = {
  annotations: () => import("./optional/annotations"),
  benchmark: () => import("./optional/benchmark"),
  path: () => import("./optional/path"),
  measure: () => import("./optional/measure"),
  vr: () => import("./optional/vr"),
};

/** What the module optional/NAME.ts exports. Rejects with a ViewerError in a page that was exported without it. */
export const loadOptional = <Name extends keyof OptionalModules>(name: Name): Promise<OptionalModules[Name]> => LOADERS[name]();
