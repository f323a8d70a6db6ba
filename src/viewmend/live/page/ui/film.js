// A film that the server renders: how far it is, how long it will still take, and a way to call it off.

import { address } from "../link/address.js";

const ASK_MS = 500;

export class Film {
  /** @param {string | null} token @param {(progress: {part: number, text: string}) => void} onProgress called while it is rendered */
  constructor(token, onProgress) {
    this.token = token;
    this.onProgress = onProgress;
    this.since = performance.now();
    this.stopped = new AbortController();
  }

  cancel() {
    this.stopped.abort();
  }

  /** @param {object} request what is posted @returns {Promise<Blob | null>} null where it was called off */
  async make(request) {
    const timer = setInterval(() => void this.#ask(), ASK_MS);
    const { signal } = this.stopped;
    try {
      const headers = { "content-type": "application/json" };
      const answer = await fetch(address("path.mp4", this.token), { method: "POST", headers, body: JSON.stringify(request), signal });
      if (!answer.ok) {
        const said = await answer.json().catch(() => ({}));
        throw new Error(said.error ?? `the server answered ${answer.status}`);
      }
      return await answer.blob();
    } catch (error) {
      if (signal.aborted) return null;
      throw error;
    } finally {
      clearInterval(timer);
    }
  }

  async #ask() {
    const answer = await fetch(address("path", this.token)).catch(() => null);
    if (!answer?.ok) return;
    const { done, of } = await answer.json();
    if (!of) return;
    const seconds = (performance.now() - this.since) / 1000;
    const left = done > 0 ? `, about ${Math.ceil((seconds / done) * (of - done))} s left` : "";
    this.onProgress({ part: done / of, text: `${done} of ${of} views${left}` });
  }
}
