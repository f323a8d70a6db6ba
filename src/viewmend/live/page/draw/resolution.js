// Adapts the resolution of the canvas, and the rate of repaints, to what the device can do.

/**
 * The resolution falls if repaints are farther apart than this, in milliseconds. A sharp view at 15 repaints
 * per second is better than a blurred one at 25.
 */
const SLOW_MS = 66;
/** The resolution rises if repaints are closer together than this, in milliseconds. */
const FAST_MS = 50;
/** The resolution never falls below this share of the display's. */
const MIN_FACTOR = 0.5;
/**
 * Repaints are at least this far apart, in milliseconds, where there is no GPU, because the processor that
 * draws also decodes the images.
 */
const SOFTWARE_MS = 25;

/** Chooses the share of the display's resolution that a moving view has. */
export class Resolution {
  constructor() {
    /** The share of the display's resolution. */
    this.factor = 1;
    /** The mean time between refreshes, ms. */
    this.mean = 20;
    /** Refreshes in a row. */
    this.count = 0;
  }

  /**
   * Take a refresh into account.
   * @param {number} elapsedMs since the last refresh
   * @param {boolean} continuous whether that was the display's last refresh
   */
  update(elapsedMs, continuous) {
    if (!continuous) {
      this.count = 0;
      return;
    }
    this.count += 1;
    if (this.count < 3) return;
    this.mean += 0.1 * (elapsedMs - this.mean);
    if (this.count % 15) return;
    if (this.mean > SLOW_MS) this.factor = Math.max(MIN_FACTOR, this.factor * 0.8);
    else if (this.mean < FAST_MS) this.factor = Math.min(1, this.factor * 1.1);
  }
}

/** Skips some of the display's refreshes, so that repaints are a minimum time apart. */
export class RepaintLimiter {
  /** @param {boolean} software whether the processor draws */
  constructor(software) {
    this.gap = software ? SOFTWARE_MS : 0;
    this.next = -Infinity;
  }

  /** @param {number} now time of a refresh, ms @returns {boolean} whether to repaint */
  due(now) {
    if (now < this.next - 1) return false;
    this.next = Math.max(now, this.next + this.gap);
    return true;
  }
}
