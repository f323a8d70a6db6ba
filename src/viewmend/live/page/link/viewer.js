// What this page tells the server about its view, and what it hears: the protocol, without pixels on a screen.

import { decodeDepth, parseFrame } from "./frames.js";
import { PictureDecoder } from "./pictures.js";
import { surfaceOf } from "../draw/surface.js";

/** @typedef {import("../draw/stage.js").Shown} Shown */

/**
 * Events, with the message as detail: "welcome", "rig", "state", "stats", "error"; "picture" (detail: Shown with `bytes`)
 * in the order of the frames; "trouble" (detail: text) when a picture could not be decoded.
 */
export class ViewerLink extends EventTarget {
  /** @param {import("./connection.js").Connection} connection */
  constructor(connection) {
    super();
    this.connection = connection;
    this.decoder = new PictureDecoder();
    this.looks = 0;
    this.lastLook = "";
    this.lastSent = -Infinity;
    this.leastGapMs = 16;
    /** Whether the view that `look` was last called with still has to be asked for. */
    this.late = false;
    this.queue = Promise.resolve();
    connection.addEventListener("message", (event) => this.#hear(/** @type {CustomEvent} */ (event).detail));
    connection.addEventListener("frame", (event) => this.#frame(/** @type {CustomEvent} */ (event).detail));
  }

  /** @param {any} message */
  #hear(message) {
    if (message.type === "welcome") {
      this.lastLook = "";
      this.decoder.close();
      this.leastGapMs = Math.max(16, 2000 / message.limits.messages_per_s);
    }
    this.dispatchEvent(new CustomEvent(message.type, { detail: message }));
  }

  /**
   * Ask for a view unless it is what was asked for last, or it comes too soon after that: call it again a frame later.
   * @param {object} look without `type`, `id` and `sent_ms`
   * @returns {boolean} whether it was sent
   */
  look(look) {
    const asked = JSON.stringify(look);
    const now = performance.now();
    this.late = asked !== this.lastLook && now - this.lastSent < this.leastGapMs;
    if (asked === this.lastLook || this.late) return false;
    if (!this.connection.send({ type: "look", id: this.looks + 1, sent_ms: now, ...look })) return false;
    this.looks += 1;
    this.lastLook = asked;
    this.lastSent = now;
    return true;
  }

  /** @param {{playing?: boolean, speed?: number, seek?: number, live?: boolean}} clock */
  clock(clock) {
    this.connection.send({ type: "clock", ...clock });
  }

  /** Pictures are decoded side by side and shown in order. @param {ArrayBuffer} message */
  #frame(message) {
    const frame = parseFrame(message);
    this.connection.send({ type: "ack", frame: frame.header.frame });
    const decoded = this.#decode(frame);
    this.queue = this.queue
      .then(async () => {
        const detail = { ...(await decoded), bytes: frame.bytes };
        this.dispatchEvent(new CustomEvent("picture", { detail }));
      })
      .catch((error) => {
        this.dispatchEvent(new CustomEvent("trouble", { detail: String(error.message ?? error) }));
      });
    decoded.catch(() => {});
  }

  /** @param {ReturnType<typeof parseFrame>} frame @returns {Promise<Shown>} */
  async #decode({ header, parts }) {
    const eyes = header.cameras.map(() => ({ modes: /** @type {any} */ ({}), surface: /** @type {any} */ (null) }));
    await Promise.all(
      parts.map(async (part) => {
        const eye = eyes[part.about.eye ?? 0];
        if (part.about.kind === "image") eye.modes[part.about.mode] = await this.decoder.decode(part, header.frame);
        else if (part.about.kind === "depth") {
          eye.surface = surfaceOf(await decodeDepth(part), header.width, header.height);
        }
      }),
    );
    return { header, eyes };
  }
}
