// What went wrong, in a sentence for the person who looks at the page.
export class Problem extends Error {}

export const EXPORT_AGAIN = "Export the page again.";
