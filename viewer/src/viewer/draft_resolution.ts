// The resolution of the images of a moving view: 1, 1/2, 1/4 or 1/8 of the width and height, as the device can afford.

const COARSEST = 3; // 1 / 2^3
const TOO_SLOW = 40; // milliseconds of an image above which the next one is coarser
const FAST = 20; // milliseconds below which a finer image must stay
const PATIENCE = 3; // images in a row for which a finer one must be affordable: steps do not alternate

/** Chooses the step of each image from the measured cost of the ones before. Without a measurement an image is the coarsest. */
export class DraftResolution {
  private step = COARSEST;
  private measured = false;
  private affordable = 0; // images in a row for which a finer step was affordable

  /**
   * The share of the width and height for the next image: 1, 1/2, 1/4 or 1/8.
   *
   * cost: measured milliseconds a pixel, or null. pixels: of the whole image.
   */
  next(cost: number | null, pixels: number): number {
    if (cost !== null) this.choose((step) => (cost * pixels) / 4 ** step);
    return 2 ** -this.step;
  }

  /** milliseconds: of an image at a step. */
  private choose(milliseconds: (step: number) => number): void {
    if (!this.measured) {
      this.measured = true;
      while (this.step > 0 && milliseconds(this.step - 1) <= FAST) this.step--;
      return;
    }
    if (milliseconds(this.step) > TOO_SLOW) {
      this.affordable = 0;
      while (this.step < COARSEST && milliseconds(this.step) > TOO_SLOW) this.step++;
      return;
    }
    this.affordable = this.step > 0 && milliseconds(this.step - 1) < FAST ? this.affordable + 1 : 0;
    if (this.affordable < PATIENCE) return;
    this.affordable = 0;
    this.step--;
  }
}
