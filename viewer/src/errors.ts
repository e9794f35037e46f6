/** An error whose message is one sentence or two for the person who looks at the page: what is wrong, and what to do. */
export class ViewerError extends Error {}

export const EXPORT_AGAIN = "Export the page again.";

/** A scene that this device's graphics memory or driver does not hold. */
export class TooLarge extends ViewerError {}

/** An error that a person can read. */
export function asViewerError(error: unknown): ViewerError {
  if (error instanceof ViewerError) return error;
  const text = error instanceof Error ? error.message : String(error);
  return new ViewerError(`The viewer failed (${text}). Reload the page, or try another browser.`);
}
