// On air: what this page shows is the film that all who open /watch see.

import { address } from "../link/address.js";
import { byId } from "./dom.js";

export class OnAir {
  /** @param {import("../link/viewer.js").ViewerLink} link @param {import("./notices.js").Notices} notices @param {string | null} token */
  constructor(link, notices, token) {
    this.link = link;
    this.notices = notices;
    this.token = token;
    /** What the person wants, and what the server says. */
    this.wanted = false;
    this.on = false;
    this.button = byId("tool-air");
    this.button.addEventListener("click", () => this.#want(!this.wanted));
    link.addEventListener("welcome", (event) => this.#welcome(/** @type {CustomEvent} */ (event).detail));
    link.addEventListener("state", (event) => this.#state(/** @type {CustomEvent} */ (event).detail));
  }

  /** @param {boolean} on */
  #want(on) {
    this.wanted = on;
    this.link.onAir(on);
    const where = address("watch", this.token).href;
    this.notices.toast(on ? `Broadcasting your view: ${where}` : "Broadcast stopped; spectators keep the last view.");
  }

  /** A server that was left may have forgotten it. @param {any} welcome */
  #welcome(welcome) {
    this.button.hidden = !welcome.broadcast;
    this.on = false;
    if (this.wanted && welcome.broadcast) this.link.onAir(true);
  }

  /** @param {any} state */
  #state(state) {
    if (this.on && !state.on_air && this.wanted) {
      this.wanted = false;
      this.notices.toast("Another viewer is broadcasting now.");
    }
    this.on = Boolean(state.on_air);
    this.button.setAttribute("aria-pressed", String(this.on));
    this.button.dataset.watched = String(Boolean(state.watched));
  }
}
