// How close the view is to the image of a camera that is left out: error map and PSNR of the subject, from the server.

import { address } from "../link/address.js";

/** The view has been at the camera for so long before it is scored. */
const WAIT_MS = 300;

/** @typedef {{camera: any, time: number, without: string, models: (string | null)[]}} Asked `models`: null for the server's own */
/** @typedef {{model: string | null, psnr: number, blob: Blob}} Score */

export class Scores {
  /** @param {string | null} token @param {(asked: Asked | null, score: Score | null) => void} report called with each score, and with null when none holds any more */
  constructor(token, report) {
    this.token = token;
    this.report = report;
    this.key = "null";
    this.timer = 0;
    this.stopped = new AbortController();
  }

  /** @param {Asked | null} asked null while there is nothing to score */
  show(asked) {
    const key = JSON.stringify(asked && [asked.camera.name, asked.time, asked.without, asked.models]);
    if (key === this.key) return;
    this.key = key;
    clearTimeout(this.timer);
    this.stopped.abort();
    this.report(null, null);
    if (asked) this.timer = window.setTimeout(() => void this.#ask(asked), WAIT_MS);
  }

  /** @param {Asked} asked */
  async #ask(asked) {
    const { signal } = (this.stopped = new AbortController());
    for (const model of asked.models) {
      const url = address("frame.jpg", this.token);
      const query = { mode: "error", camera: asked.camera.name, time: asked.time, without: asked.without, quality: 90 };
      for (const [name, value] of Object.entries(query)) url.searchParams.set(name, String(value));
      if (model) url.searchParams.set("model", model);
      const answer = await fetch(url, { signal }).catch(() => null);
      const psnr = Number(answer?.headers.get("X-Viewmend-PSNR"));
      const blob = await answer?.blob().catch(() => null);
      if (answer?.ok && blob && !signal.aborted) this.report(asked, { model, psnr, blob });
    }
  }
}
