// Progress while a view at rest is being completed.

import { byId } from "./dom.js";

/** Nothing is shown for views that are completed within this time. */
const SHOW_AFTER_MS = 300;
/** The expected time before the first completed view. */
const FIRST_EXPECTED_MS = 2000;
/** The share of the newest time in the expected time. */
const NEWEST_SHARE = 0.3;
/** The bar waits here for a view that takes longer than expected. */
const MAX_PROGRESS = 0.95;

export class Refining {
  constructor() {
    this.expectedMs = FIRST_EXPECTED_MS;
    /** When the view was requested; 0 while none is being refined. */
    this.since = 0;
    setInterval(() => this.#show(), 100);
  }

  /** The view at rest was requested. */
  begin() {
    this.since = performance.now();
  }

  /** The completed view has arrived. */
  finish() {
    if (this.since) this.expectedMs += NEWEST_SHARE * (performance.now() - this.since - this.expectedMs);
    this.stop();
  }

  /** The view moves or was given up. */
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
