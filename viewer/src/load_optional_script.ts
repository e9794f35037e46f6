// Takes the place of load_optional.ts in viewer.js: optional code is the script optional/NAME.js beside viewer.js, or stands in a page of
// one file. Those scripts only register a function; it gets the classes and functions of viewer.js, and returns what NAME.ts exports.
import { SHARED } from "snerg-shared";
import { ViewerError } from "./errors";
import type { OptionalModules } from "./optional/modules";

type Factory = (require: (name: string) => unknown) => unknown;
const registry = globalThis as { snergOptional?: Record<string, Factory> };
const loaded = new Map<string, Promise<unknown>>();
const script = document.currentScript as HTMLScriptElement | null; // viewer.js

/** See load_optional.ts. */
export function loadOptional<Name extends keyof OptionalModules>(name: Name): Promise<OptionalModules[Name]> {
  const module = loaded.get(name) ?? load(name);
  loaded.set(name, module);
  module.catch(() => loaded.delete(name)); // so that one may try again
  return module as Promise<OptionalModules[Name]>;
}

async function load(name: string): Promise<unknown> {
  if (!registry.snergOptional?.[name]) {
    if (!script?.src) throw new ViewerError(`This page of one file was exported without the part "${name}". Export it as a folder.`);
    await addScript(new URL(`optional/${name}.js`, script.src)).catch(() => undefined);
  }
  const factory = registry.snergOptional?.[name];
  if (!factory) throw new ViewerError(`The file optional/${name}.js did not arrive. Upload the whole folder of the page.`);
  return factory((path) => SHARED[path]);
}

function addScript(address: URL): Promise<unknown> {
  return new Promise((resolve, reject) => {
    const element = document.createElement("script");
    element.src = address.href;
    element.onload = resolve;
    element.onerror = reject;
    document.head.append(element);
  });
}
