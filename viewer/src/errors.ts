/** An error whose message is one sentence or two for the person who looks at the page: what is wrong, and what to do. */
export class ViewerError extends Error {}

export const EXPORT_AGAIN = "Export the page again.";

/** A scene that this device's graphics memory or driver does not hold. */
export class TooLarge extends ViewerError {}
