// The image of the camera that the view is at, next to the view, and how far the view is from it if the camera is left out.

import { address } from "../link/address.js";
import { byId } from "./dom.js";
import { Scores } from "./scores.js";

/** Between two pictures while time runs. */
const GAP_MS = 250;

export class Original {
  /** @param {string | null} token @param {(mode: "original" | "error", camera: any, image: TexImageSource | null) => void} paint shows an image in the camera's place */
  constructor(token, paint) {
    this.token = token;
    this.asked = "";
    this.askedAt = -Infinity;
    this.paint = paint;
    /** Of the image that is shown. @type {any} */
    this.camera = null;
    this.shown = true;
    const image = byId("original-image");
    image.addEventListener("load", () => {
      byId("original").hidden = this.asked === "" || !this.shown;
      if (this.asked) paint("original", this.camera, image);
    });
    image.addEventListener("error", () => (byId("original").hidden = true));
    this.scores = new Scores(token, (asked, score) => this.#score(asked, score));
  }

  /** @param {any} camera the one that the view is at; null if it is at none @param {number} time the frame's index @param {boolean} shown whether next to the view */
  show(camera, time, shown) {
    this.shown = shown;
    if (!camera || time < 0) {
      if (this.asked) this.paint("original", null, null);
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
    this.camera = camera;
    image.alt = `Image of ${camera.name}`;
    byId("original-name").textContent = `${camera.name}, original`;
    image.src = url.href;
  }

  /** @param {import("./scores.js").Asked | null} asked @param {import("./scores.js").Score | null} score */
  #score(asked, score) {
    const [picture, name] = [byId("error-image"), byId("error-name")];
    picture.hidden = name.hidden = !score;
    if (!asked || !score) {
      name.textContent = "";
      this.paint("error", null, null);
      return;
    }
    const text = `${score.model ? `${score.model}: ` : ""}${score.psnr.toFixed(1)} dB`;
    name.textContent = name.textContent ? `${name.textContent} · ${text}` : `Error map · PSNR of subject ${text}`;
    if (score.model) return;
    picture.onload = () => {
      this.paint("error", asked.camera, picture);
      URL.revokeObjectURL(picture.src);
    };
    picture.src = URL.createObjectURL(score.blob);
  }
}
