// A video that the server renders: its progress, the remaining time, and a way to cancel it.

import { buildAddress } from "../link/address.js";

/** The progress is requested at this interval, in milliseconds. */
const POLL_MS = 500;

export class Film {
  /**
   * @param {string | null} token
   * @param {(progress: {part: number, text: string}) => void} onProgress called while the video is rendered
   */
  constructor(token, onProgress) {
    this.token = token;
    this.onProgress = onProgress;
    this.startedAt = performance.now();
    this.stopped = new AbortController();
  }

  cancel() {
    this.stopped.abort();
  }

  /**
   * Render the video.
   * @param {object} request
   * @returns {Promise<Blob | null>} null if it was cancelled
   */
  async make(request) {
    const timer = setInterval(() => void this.#updateProgress(), POLL_MS);
    const { signal } = this.stopped;
    try {
      const response = await fetch(buildAddress("path.mp4", this.token), {
        method: "POST",
        headers: { "content-type": "application/json" },
        body: JSON.stringify(request),
        signal,
      });
      if (!response.ok) {
        const content = await response.json().catch(() => ({}));
        throw new Error(content.error ?? `the server answered ${response.status}`);
      }
      return await response.blob();
    } catch (error) {
      if (signal.aborted) return null;
      throw error;
    } finally {
      clearInterval(timer);
    }
  }

  async #updateProgress() {
    const response = await fetch(buildAddress("path", this.token)).catch(() => null);
    if (!response?.ok) return;
    const { done, of } = await response.json();
    if (!of) return;
    const seconds = (performance.now() - this.startedAt) / 1000;
    const remaining = done > 0 ? `, about ${Math.ceil((seconds / done) * (of - done))} s left` : "";
    this.onProgress({ part: done / of, text: `${done} of ${of} views${remaining}` });
  }
}
