// How many canvas pixels a CSS pixel gets, and how often they are painted: less where a device cannot do it easily.

/** A sharp view at 15 repaints a second is better than a blurred one at 25. */
const [SLOW_MS, FAST_MS] = [66, 50];
const LEAST = 0.5;

export class Resolution {
  constructor() {
    this.factor = 1;
    this.mean = 20;
    this.count = 0;
  }

  get ratio() {
    return Math.min(2, window.devicePixelRatio) * this.factor;
  }

  /** @param {number} elapsedMs since the last refresh @param {boolean} continuous whether that one was the display's last */
  refreshed(elapsedMs, continuous) {
    if (!continuous) {
      this.count = 0;
      return;
    }
    this.count += 1;
    if (this.count < 3) return;
    this.mean += 0.1 * (elapsedMs - this.mean);
    if (this.count % 15) return;
    if (this.mean > SLOW_MS) this.factor = Math.max(LEAST, this.factor * 0.8);
    else if (this.mean < FAST_MS) this.factor = Math.min(1, this.factor * 1.1);
  }
}

/** Mean time between repaints where there is no GPU: each takes the processor that pictures are decoded with, too. */
const SOFTWARE_MS = 25;

/** Skips some of the display's refreshes, so that repaints have a minimum distance in time. */
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
