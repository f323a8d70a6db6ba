// The protocol between page and server, without display.

/**
 * Events, with the message as detail: "welcome", "rig", "state", "stats", "error"; "picture" (detail: worker.js's Picture) in
 * the order of the frames; "trouble" (detail: text) when a picture could not be decoded.
 */
export class ViewerLink extends EventTarget {
  /** @param {import("./connection.js").Connection} connection */
  constructor(connection) {
    super();
    this.connection = connection;
    this.looks = 0;
    this.lastLook = "";
    this.lastSent = -Infinity;
    this.leastGapMs = 16;
    /** Whether the view that `look` was last called with still has to be asked for. */
    this.late = false;
    connection.addEventListener("message", (event) => this.#hear(/** @type {CustomEvent} */ (event).detail));
    for (const name of ["picture", "trouble"]) {
      connection.addEventListener(name, (event) => {
        this.dispatchEvent(new CustomEvent(name, { detail: /** @type {CustomEvent} */ (event).detail }));
      });
    }
  }

  /** @param {any} message */
  #hear(message) {
    if (message.type === "welcome") {
      this.lastLook = "";
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

  /** Give up what was asked for, and do not ask for a view. */
  rest() {
    this.late = false;
    if (this.lastLook && this.connection.send({ type: "cancel" })) this.lastLook = "";
  }

  /** Show all who watch what is looked at here. @param {boolean} on */
  onAir(on) {
    this.connection.send({ type: "on_air", on });
  }

  /** @param {{playing?: boolean, speed?: number, seek?: number, live?: boolean}} clock */
  clock(clock) {
    this.connection.send({ type: "clock", ...clock });
  }
}
