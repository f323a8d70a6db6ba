// The score of a view at a camera that is left out: error map and PSNR of the subject, computed by the
// server.

import { buildAddress } from "../link/address.js";

/** A view is scored after it has been at the camera for this long, in milliseconds. */
const WAIT_MS = 300;
/** The JPEG quality of the error map. */
const QUALITY = 90;
/** The first wait, in milliseconds, before a score is requested again; each further wait is twice as long. */
const RETRY_MS = 1000;
/** Status codes of a server that is too busy to answer. */
const BUSY = [429, 503];

/**
 * @typedef {object} ScoreRequest
 * @property {any} camera
 * @property {number} time index of the frame
 * @property {string} without names of cameras that are not used, separated by commas
 * @property {(string | null)[]} models null for the server's own
 */

/** @typedef {{model: string | null, psnr: number, blob: Blob}} Score */

export class Scores {
  /**
   * @param {string | null} token
   * @param {(request: ScoreRequest | null, score: Score | null) => void} report called with each score, and
   *   with null
   *   when none is valid any more
   */
  constructor(token, report) {
    this.token = token;
    this.report = report;
    /** The last request as JSON. */
    this.key = "null";
    this.timer = 0;
    this.stopped = new AbortController();
  }

  /** Request scores soon. @param {ScoreRequest | null} request null while there is nothing to score */
  show(request) {
    const key = JSON.stringify(request && { ...request, camera: request.camera.name });
    if (key === this.key) return;
    this.key = key;
    clearTimeout(this.timer);
    this.stopped.abort();
    this.report(null, null);
    if (request) this.timer = window.setTimeout(() => void this.#fetchScores(request), WAIT_MS);
  }

  /** @param {ScoreRequest} request */
  async #fetchScores(request) {
    this.stopped = new AbortController();
    const { signal } = this.stopped;
    const { camera, time, without, models } = request;
    for (const model of models) {
      const url = buildAddress("frame.jpg", this.token);
      const query = { mode: "error", camera: camera.name, time, without, quality: QUALITY };
      for (const [name, value] of Object.entries(query)) url.searchParams.set(name, String(value));
      if (model) url.searchParams.set("model", model);
      const response = await fetchWithRetries(url, signal);
      const psnr = Number(response?.headers.get("X-Viewmend-PSNR"));
      const blob = await response?.blob().catch(() => null);
      if (response?.ok && blob && !signal.aborted) this.report(request, { model, psnr, blob });
    }
  }
}

/**
 * Fetch, and try again while the server is too busy or unreachable.
 * @param {URL} url
 * @param {AbortSignal} signal
 * @returns {Promise<Response | null>} null if the request was aborted
 */
async function fetchWithRetries(url, signal) {
  for (let wait = RETRY_MS; !signal.aborted; wait *= 2) {
    const response = await fetch(url, { signal }).catch(() => null);
    if (response && !BUSY.includes(response.status)) return response;
    await new Promise((resolve) => setTimeout(resolve, wait));
  }
  return null;
}
