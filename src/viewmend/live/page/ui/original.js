// The original image of a camera, next to the view, while the view is at that camera.

import { address } from "../link/connection.js";
import { byId } from "./dom.js";

/** Between two pictures while time runs. */
const GAP_MS = 250;

export class Original {
  /** @param {string | null} token */
  constructor(token) {
    this.token = token;
    this.asked = "";
    this.askedAt = -Infinity;
    const image = byId("original-image");
    image.addEventListener("load", () => (byId("original").hidden = this.asked === ""));
    image.addEventListener("error", () => (byId("original").hidden = true));
  }

  /** @param {any} camera the one that the view stands at; null where it stands nowhere @param {number} time the frame's index */
  show(camera, time) {
    if (!camera || time < 0) {
      this.asked = "";
      byId("original").hidden = true;
      return;
    }
    const url = address("camera.jpg", this.token);
    url.searchParams.set("name", camera.name);
    url.searchParams.set("time", String(time));
    const image = byId("original-image");
    const busy = this.asked !== "" && (!image.complete || performance.now() - this.askedAt < GAP_MS);
    if (url.href === this.asked || busy) return;
    this.asked = url.href;
    this.askedAt = performance.now();
    image.alt = `Image of ${camera.name}`;
    byId("original-name").textContent = `${camera.name}, original`;
    image.src = url.href;
  }
}
