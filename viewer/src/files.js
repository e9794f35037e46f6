// Reads the scene's files: from the page itself in a single-file page, else from the server.
import { EXPORT_AGAIN, ViewerError } from "./errors.js";

const embedded = (name) => document.querySelector(`script[data-file="${name}"]`);

const isSingleFile = () => document.querySelector("script[data-file]") !== null;

/**
 * The bytes of a file, as a Uint8Array. An embedded file can be read once: reading removes its text from the page, to free memory.
 *
 * Throws a ViewerError that names the file where it is missing, damaged or did not arrive.
 */
export async function readFile(name) {
  if (!isSingleFile()) return fetchFile(name);
  const element = embedded(name);
  if (!element) throw new ViewerError(`The file ${name} is missing from this page. ${EXPORT_AGAIN}`);
  const text = element.textContent;
  element.remove();
  try {
    return fromBase64(text);
  } catch {
    throw new ViewerError(`The file ${name} in this page is damaged. ${EXPORT_AGAIN}`);
  }
}

/** The value of a JSON file. Throws a ViewerError as `readFile` does, or where the file is not JSON. */
export async function readJson(name) {
  const bytes = await readFile(name);
  try {
    return JSON.parse(new TextDecoder("utf-8", { fatal: true }).decode(bytes));
  } catch {
    throw new ViewerError(`The file ${name} is damaged: it is not JSON. ${EXPORT_AGAIN}`);
  }
}

async function fetchFile(name) {
  if (location.protocol === "file:") {
    throw new ViewerError(
      "This page was opened from the disk, and browsers do not let such a page read other files. " +
        "Serve its folder (for instance: python3 -m http.server, in the folder, then open http://localhost:8000), " +
        "or export it as a single file.",
    );
  }
  let response;
  try {
    response = await fetch(name);
  } catch {
    throw new ViewerError(`The file ${name} did not arrive: the server cannot be reached. Reload the page.`);
  }
  if (!response.ok) {
    const what = response.status === 404 ? "is missing from the server" : `did not arrive (the server answered ${response.status})`;
    throw new ViewerError(`The file ${name} ${what}. Upload the whole folder of the page.`);
  }
  try {
    return new Uint8Array(await response.arrayBuffer());
  } catch {
    throw new ViewerError(`The file ${name} arrived incomplete. Reload the page.`);
  }
}

function fromBase64(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}
