// How many canvas pixels a CSS pixel gets: fewer while a slow device cannot repaint smoothly.

const [SLOW_MS, FAST_MS] = [36, 20];
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
