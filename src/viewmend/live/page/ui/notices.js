// Reports of the page's state: a cover before the first image, a pill after it, and toasts.

import { byId, element } from "./dom.js";

/** A toast is shown for this long, in milliseconds; that of an error for twice as long. */
const TOAST_MS = 4200;
/** An image that does not arrive within this time after its request, in milliseconds, is reported as late. */
const LATE_MS = 3000;
/** The state is updated at this interval, in milliseconds. */
const UPDATE_MS = 500;

/**
 * @typedef {object} Situation
 * @property {"fine" | "wait" | "warning" | "lost" | "error"} kind
 * @property {string} title
 * @property {string} text
 * @property {boolean} [retry] whether the user can try again
 */

export class Notices {
  /** @param {() => void} retry */
  constructor(retry) {
    this.connection = { status: "connecting", text: "", wait_s: 0, since: 0 };
    /** @type {any} */
    this.state = null;
    /** Whether an image is shown. */
    this.hasImage = false;
    this.lacksConfidence = false;
    /** When the image was requested that has not arrived yet, ms; 0 for none. */
    this.waitingSince = 0;
    byId("cover-retry").addEventListener("click", retry);
    setInterval(() => this.show(), UPDATE_MS);
  }

  /** @param {{status: string, text: string, wait_s: number}} status */
  setConnection(status) {
    this.connection = { ...status, since: performance.now() };
    if (status.status !== "open") this.waitingSince = 0;
    this.show();
  }

  /** @param {any} state of the source */
  setSourceState(state) {
    this.state = state;
    this.show();
  }

  /** Note that an image was requested. */
  markRequested() {
    this.waitingSince ||= performance.now();
  }

  /**
   * Note that an image has arrived.
   * @param {boolean} lacksConfidence whether its mode shows confidence, which the model does not predict
   */
  markArrived(lacksConfidence) {
    this.waitingSince = 0;
    if (this.hasImage && this.lacksConfidence === lacksConfidence) return;
    this.hasImage = true;
    this.lacksConfidence = lacksConfidence;
    this.show();
  }

  /** @param {string} text @param {"plain" | "error"} [kind] */
  toast(text, kind = "plain") {
    const toast = element("div", { className: "toast", textContent: text });
    toast.dataset.kind = kind;
    byId("toasts").replaceChildren(toast);
    setTimeout(() => toast.remove(), kind === "error" ? 2 * TOAST_MS : TOAST_MS);
  }

  show() {
    const { kind, title, text, retry } = this.#findSituation();
    const cover = byId("cover");
    const pill = byId("pill");
    document.body.dataset.situation = kind;
    const covered = kind !== "fine" && (!this.hasImage || kind === "error" || kind === "lost");
    cover.hidden = !covered;
    pill.hidden = covered || kind === "fine";
    if (!cover.hidden) {
      cover.dataset.kind = kind === "wait" || kind === "lost" ? "wait" : "error";
      setText(byId("cover-title"), title);
      setText(byId("cover-text"), text);
      byId("cover-retry").hidden = !retry;
    }
    if (!pill.hidden) {
      pill.dataset.kind = kind;
      setText(pill, title);
      pill.title = text;
    }
  }

  /** @returns {Situation} */
  #findSituation() {
    return this.#checkConnection() ?? this.#checkSource() ?? this.#checkImage();
  }

  /** Find what is wrong with the connection; null for nothing. @returns {Situation | null} */
  #checkConnection() {
    const { status, text, wait_s, since } = this.connection;
    if (status === "refused") return { kind: "error", title: "Cannot connect", text };
    if (status === "lost") {
      const remaining = Math.max(0, Math.ceil(wait_s - (performance.now() - since) / 1000));
      return { kind: "lost", title: text, text: `Retrying in ${remaining} s.`, retry: true };
    }
    if (status === "connecting") {
      return { kind: this.hasImage ? "lost" : "wait", title: "Connecting", text: "" };
    }
    return null;
  }

  /** Find what is wrong with the source of the frames; null for nothing. @returns {Situation | null} */
  #checkSource() {
    const { state } = this;
    if (!state || state.source === "loading") {
      return { kind: "wait", title: "Loading", text: state?.error ?? "Waiting for the first frame." };
    }
    if (state.source === "failing") {
      const text = state.error ?? "No frames from the source.";
      return { kind: this.hasImage ? "warning" : "error", title: "Source error", text };
    }
    return null;
  }

  /** Find what is wrong with the images. @returns {Situation} */
  #checkImage() {
    const { state } = this;
    if (state.model_error) {
      return { kind: "warning", title: "Model failed; showing the rendered view", text: state.model_error };
    }
    if (this.lacksConfidence) {
      const text = "This model has no confidence map. Start the server with --model views to see one.";
      return { kind: "warning", title: "No confidence", text };
    }
    if (!this.hasImage) {
      return { kind: "wait", title: "Rendering the first view", text: "This takes a moment." };
    }
    const late = this.waitingSince && performance.now() - this.waitingSince > LATE_MS;
    if (late) return { kind: "wait", title: "Waiting for the server", text: "" };
    if (state.buffering) return { kind: "wait", title: "Waiting for frames", text: "" };
    return { kind: "fine", title: "", text: "" };
  }
}

/** @param {HTMLElement} target @param {string} text */
function setText(target, text) {
  if (target.textContent !== text) target.textContent = text;
}
