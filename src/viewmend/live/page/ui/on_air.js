// The broadcast: this page's view is what spectators see on /watch.

import { buildAddress } from "../link/address.js";
import { byId } from "./dom.js";

export class OnAir {
  /**
   * @param {import("../link/viewer.js").ViewerLink} link
   * @param {import("./notices.js").Notices} notices
   * @param {string | null} token
   */
  constructor(link, notices, token) {
    this.link = link;
    this.notices = notices;
    this.token = token;
    /** Whether the user wants to broadcast. */
    this.wanted = false;
    /** Whether the server broadcasts this page's view. */
    this.on = false;
    this.button = byId("tool-air");
    this.button.addEventListener("click", () => this.#setWanted(!this.wanted));
    link.addEventListener("welcome", (event) => this.#resume(/** @type {CustomEvent} */ (event).detail));
    link.addEventListener("state", (event) => this.#update(/** @type {CustomEvent} */ (event).detail));
  }

  /** @param {boolean} on */
  #setWanted(on) {
    this.wanted = on;
    this.link.setOnAir(on);
    const url = buildAddress("watch", this.token).href;
    const stopped = "Broadcast stopped; spectators keep the last view.";
    this.notices.toast(on ? `Broadcasting your view: ${url}` : stopped);
  }

  /** Resume the broadcast after a lost connection. @param {any} welcome the message */
  #resume(welcome) {
    this.button.hidden = !welcome.broadcast;
    this.on = false;
    if (this.wanted && welcome.broadcast) this.link.setOnAir(true);
  }

  /** @param {any} state the message */
  #update(state) {
    if (this.on && !state.on_air && this.wanted) {
      this.wanted = false;
      this.notices.toast("Another viewer is broadcasting now.");
    }
    this.on = Boolean(state.on_air);
    this.button.setAttribute("aria-pressed", String(this.on));
    this.button.dataset.watched = String(Boolean(state.watched));
  }
}
