// What state the page is in, in words: a cover before the first picture, a pill afterwards, and toasts.

import { byId, element } from "./dom.js";

const TOAST_MS = 4200;
/** A picture that was asked for and does not come within this time is called late. */
const STALLED_MS = 3000;

export class Notices {
  /** @param {() => void} retry */
  constructor(retry) {
    this.connection = { status: "connecting", text: "", wait_s: 0, since: 0 };
    /** @type {any} */
    this.state = null;
    this.pictured = false;
    this.lacksConfidence = false;
    this.waitingSince = 0;
    byId("cover-retry").addEventListener("click", retry);
    setInterval(() => this.show(), 500);
  }

  /** @param {{status: string, text: string, wait_s: number}} status */
  connect(status) {
    this.connection = { ...status, since: performance.now() };
    if (status.status !== "open") this.waitingSince = 0;
    this.show();
  }

  /** @param {any} state */
  source(state) {
    this.state = state;
    this.show();
  }

  /** A picture was asked for. */
  asked() {
    this.waitingSince ||= performance.now();
  }

  /** A picture has arrived. @param {boolean} lacksConfidence whether its mode shows confidence, which the model does not predict */
  arrived(lacksConfidence) {
    this.waitingSince = 0;
    if (this.pictured && this.lacksConfidence === lacksConfidence) return;
    this.pictured = true;
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
    const { kind, title, text, retry } = this.#situation();
    const [cover, pill] = [byId("cover"), byId("pill")];
    document.body.dataset.situation = kind;
    const covered = kind !== "fine" && (!this.pictured || kind === "error" || kind === "lost");
    cover.hidden = !covered;
    pill.hidden = covered || kind === "fine";
    if (!cover.hidden) {
      cover.dataset.kind = kind === "wait" || kind === "lost" ? "wait" : "error";
      set(byId("cover-title"), title);
      set(byId("cover-text"), text);
      byId("cover-retry").hidden = !retry;
    }
    if (!pill.hidden) {
      pill.dataset.kind = kind;
      set(pill, title);
      pill.title = text;
    }
  }

  /** @returns {{kind: "fine" | "wait" | "warning" | "lost" | "error", title: string, text: string, retry?: boolean}} */
  #situation() {
    const { status, text, wait_s, since } = this.connection;
    if (status === "refused") return { kind: "error", title: "Access denied", text };
    if (status === "lost") {
      const left = Math.max(0, Math.ceil(wait_s - (performance.now() - since) / 1000));
      return { kind: "lost", title: text, text: `Retrying in ${left} s.`, retry: true };
    }
    if (status === "connecting") return { kind: this.pictured ? "lost" : "wait", title: "Connecting", text: "" };
    if (!this.state || this.state.source === "loading") {
      return { kind: "wait", title: "Loading", text: this.state?.error ?? "Waiting for the first frame." };
    }
    if (this.state.source === "failing") {
      const reason = this.state.error ?? "No frames from the source.";
      return { kind: this.pictured ? "warning" : "error", title: "Source error", text: reason };
    }
    if (this.state.model_error) return { kind: "warning", title: "Model failed; showing the rendered view", text: this.state.model_error };
    if (this.lacksConfidence) return { kind: "warning", title: "No confidence", text: "This model has no confidence map. Start the server with --model views to see one." };
    if (!this.pictured) return { kind: "wait", title: "Rendering the first view", text: "This takes a moment." };
    const late = this.waitingSince && performance.now() - this.waitingSince > STALLED_MS;
    if (late || this.state.buffering) return { kind: "wait", title: "Waiting for the server", text: "" };
    return { kind: "fine", title: "", text: "" };
  }
}

/** @param {HTMLElement} place @param {string} text */
function set(place, text) {
  if (place.textContent !== text) place.textContent = text;
}
