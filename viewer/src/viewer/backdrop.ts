// What is behind the scene: a colour, nothing, or a picture.
import type { Colour } from "./progressive_renderer";

/** The backgrounds with a name, as grey values. */
export const BACKGROUNDS: ReadonlyMap<string, number> = new Map([
  ["white", 1],
  ["grey", 128 / 255],
  ["black", 0],
]);
export const TRANSPARENT = "transparent"; // what is behind the element shows through
export const IMAGE = "image"; // the page's own picture
const NOTHING: Colour = [0, 0, 0, 0];

/** The colour that the scene is drawn over; null for a text that is no background: neither one of the words above nor #rrggbb or #rgb. */
export function colourOf(background: string): Colour | null {
  const text = background.trim().toLowerCase();
  const value = BACKGROUNDS.get(text);
  if (value !== undefined) return [value, value, value, 1];
  if (text === TRANSPARENT || text === IMAGE) return NOTHING;
  const digits = /^#?([0-9a-f]{6}|[0-9a-f]{3})$/.exec(text)?.[1].replace(/^(.)(.)(.)$/, "$1$1$2$2$3$3");
  if (!digits) return null;
  const channel = (i: number) => Number.parseInt(digits.slice(2 * i, 2 * i + 2), 16) / 255;
  return [channel(0), channel(1), channel(2), 1];
}

/** As an input of the type "color" wants it. */
export const hexOf = ([red, green, blue]: Colour): string =>
  `#${[red, green, blue]
    .map((value) =>
      Math.round(255 * value)
        .toString(16)
        .padStart(2, "0"),
    )
    .join("")}`;

/** Draw a picture so that it covers a canvas, as `object-fit: cover` does. */
export function drawCovering(context: OffscreenCanvasRenderingContext2D, picture: HTMLImageElement): void {
  const { width, height } = context.canvas;
  const scale = Math.max(width / picture.naturalWidth, height / picture.naturalHeight);
  const [w, h] = [scale * picture.naturalWidth, scale * picture.naturalHeight];
  context.drawImage(picture, (width - w) / 2, (height - h) / 2, w, h);
}
