// The progress bar while a view at rest is being completed.

import { byId } from "./dom.js";

/** Nothing is shown for views that are completed within this time, in milliseconds. */
const SHOW_AFTER_MS = 300;
/** The first view is expected to take this long, in milliseconds. */
const FIRST_EXPECTED_MS = 2000;
/** The weight of the last view in the expected time. */
const NEWEST_WEIGHT = 0.3;
/** The bar is updated at this interval, in milliseconds. */
const UPDATE_MS = 100;
/** The bar stops here, as a share of its length, while a view takes longer than expected. */
const MAX_PROGRESS = 0.95;

export class Refining {
  constructor() {
    this.expectedMs = FIRST_EXPECTED_MS;
    /** When the view was requested, ms; 0 while none is being completed. */
    this.since = 0;
    setInterval(() => this.#show(), UPDATE_MS);
  }

  /** Start the bar when a view at rest was requested. */
  begin() {
    this.since = performance.now();
  }

  /** Learn from the time that a view took, and hide the bar. */
  finish() {
    if (this.since) {
      const elapsed = performance.now() - this.since;
      this.expectedMs += NEWEST_WEIGHT * (elapsed - this.expectedMs);
    }
    this.stop();
  }

  /** Hide the bar, because the view moves or was cancelled. */
  stop() {
    this.since = 0;
    this.#show();
  }

  #show() {
    const elapsed = this.since ? performance.now() - this.since : 0;
    const shown = elapsed > SHOW_AFTER_MS;
    byId("refining").hidden = !shown;
    if (shown) byId("refining-progress").value = Math.min(MAX_PROGRESS, elapsed / this.expectedMs);
  }
}
