// Parts of the viewer that a page holds only where its scene calls for them: scripts of their own, which leave themselves in the page.
import type * as path from "./path_part";

export type PathPart = typeof path;

let given: PathPart | undefined;

/** Use camera paths with this code, where it is bundled with the viewer. */
export function usePaths(part: PathPart): void {
  given = part;
}

/** The code for camera paths: that of `usePaths`, or of the page's path.js; undefined where there is none. */
export const pathPart = (): PathPart | undefined => given ?? (globalThis as { snergPath?: PathPart }).snergPath;
