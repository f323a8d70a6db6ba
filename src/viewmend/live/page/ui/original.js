// The image of the camera that the view is at, next to the view, and how far the view is from it if the
// camera is left out.

import { buildAddress } from "../link/address.js";
import { byId } from "./dom.js";
import { Scores } from "./scores.js";

/** Images are requested at least this far apart, in milliseconds, while time runs. */
const MIN_INTERVAL_MS = 250;
/** An image that could not be loaded is requested again after this long, in milliseconds. */
const RETRY_MS = 1000;

export class Original {
  /**
   * @param {string | null} token
   * @param {(mode: "original" | "error", camera: any, image: TexImageSource | null) => void} setPhoto shows
   *   an image
   *   at the camera
   */
  constructor(token, setPhoto) {
    this.token = token;
    /** URL of the image; "" for none. */
    this.requestedUrl = "";
    this.requestedAt = -Infinity;
    this.setPhoto = setPhoto;
    /** The camera of the image. @type {any} */
    this.camera = null;
    /** Whether the image is shown next to the view. */
    this.besideView = true;
    const image = byId("original-image");
    image.addEventListener("load", () => {
      byId("original").hidden = this.requestedUrl === "" || !this.besideView;
      if (this.requestedUrl) setPhoto("original", this.camera, image);
    });
    image.addEventListener("error", () => {
      byId("original").hidden = true;
      const failed = this.requestedUrl;
      setTimeout(() => {
        if (this.requestedUrl !== failed) return;
        this.requestedUrl = "";
        setPhoto("original", null, null);
      }, RETRY_MS);
    });
    this.scores = new Scores(token, (request, score) => this.#showScore(request, score));
  }

  /**
   * Show the image of a camera.
   * @param {any} camera the one that the view is at; null if it is at none
   * @param {number} time index of the frame
   * @param {boolean} besideView whether it is shown next to the view
   */
  show(camera, time, besideView) {
    this.besideView = besideView;
    if (!camera || time < 0) {
      if (this.requestedUrl) this.setPhoto("original", null, null);
      this.requestedUrl = "";
      byId("original").hidden = true;
      return;
    }
    const url = buildAddress("camera.jpg", this.token);
    url.searchParams.set("name", camera.name);
    url.searchParams.set("time", String(time));

    // wait for the last image
    const image = byId("original-image");
    const tooSoon = performance.now() - this.requestedAt < MIN_INTERVAL_MS;
    const busy = this.requestedUrl !== "" && (!image.complete || tooSoon);
    if (url.href === this.requestedUrl || busy) return;

    this.requestedUrl = url.href;
    this.requestedAt = performance.now();
    this.camera = camera;
    image.alt = `Image of ${camera.name}`;
    byId("original-name").textContent = `${camera.name}, original`;
    image.src = url.href;
  }

  /** Request images and scores again, because the ones on the GPU were lost. */
  repeat() {
    this.requestedUrl = "";
    this.scores.show(null);
  }

  /**
   * Show the PSNR of a model, and the error map of the server's own.
   * @param {import("./scores.js").ScoreRequest | null} request
   * @param {import("./scores.js").Score | null} score null to show none
   */
  #showScore(request, score) {
    const image = byId("error-image");
    const name = byId("error-name");
    image.hidden = !score;
    name.hidden = !score;
    if (!request || !score) {
      name.textContent = "";
      this.setPhoto("error", null, null);
      return;
    }
    const model = score.model ? `${score.model}: ` : "";
    const text = `${model}${score.psnr.toFixed(1)} dB`;
    const before = name.textContent;
    name.textContent = before ? `${before} · ${text}` : `Error map · PSNR of subject ${text}`;
    if (score.model) return;
    image.onload = () => {
      this.setPhoto("error", request.camera, image);
      URL.revokeObjectURL(image.src);
    };
    URL.revokeObjectURL(image.src); // of a score that was replaced before its image had loaded
    image.src = URL.createObjectURL(score.blob);
  }
}
