// The protocol between page and server, without the display.

/** Requests are at least this far apart, in milliseconds. */
const MIN_INTERVAL_MS = 16;
/** Requests use at most this share of the messages that the server accepts. */
const MESSAGE_SHARE = 0.5;

/**
 * Sends requests and receives messages. Events, with the message as detail: "welcome", "rig", "state",
 * "stats", "error"; "picture" (detail: worker.js's Picture) in the order of the frames; "undecodable"
 * (detail: the error) if a frame could not be decoded.
 */
export class ViewerLink extends EventTarget {
  /** @param {import("./connection.js").Connection} connection */
  constructor(connection) {
    super();
    this.connection = connection;
    this.requestCount = 0;
    /** The last request as JSON; "" for none. */
    this.lastRequest = "";
    this.lastSentAt = -Infinity;
    this.minIntervalMs = MIN_INTERVAL_MS;
    /** Whether the view that was last passed to `requestView` has not been requested yet. */
    this.requestPending = false;
    connection.addEventListener("message", (event) => {
      this.#receive(/** @type {CustomEvent} */ (event).detail);
    });
    for (const name of ["picture", "undecodable"]) {
      connection.addEventListener(name, (event) => {
        this.dispatchEvent(new CustomEvent(name, { detail: /** @type {CustomEvent} */ (event).detail }));
      });
    }
  }

  /** @param {any} message */
  #receive(message) {
    if (message.type === "welcome") {
      this.lastRequest = "";
      const intervalMs = 1000 / (MESSAGE_SHARE * message.limits.messages_per_s);
      this.minIntervalMs = Math.max(MIN_INTERVAL_MS, intervalMs);
    }
    this.dispatchEvent(new CustomEvent(message.type, { detail: message }));
  }

  /**
   * Request a view, unless it was the last one requested. If this is too soon after the last request, call it
   * again a frame later.
   * @param {object} view the message "look" without `type`, `id` and `sent_ms`
   * @returns {boolean} whether it was sent
   */
  requestView(view) {
    const request = JSON.stringify(view);
    const now = performance.now();
    this.requestPending = request !== this.lastRequest && now - this.lastSentAt < this.minIntervalMs;
    if (request === this.lastRequest || this.requestPending) return false;
    const message = { type: "look", id: this.requestCount + 1, sent_ms: now, ...view };
    if (!this.connection.send(message)) return false;
    this.requestCount += 1;
    this.lastRequest = request;
    this.lastSentAt = now;
    return true;
  }

  /** Cancel the last request. */
  cancelRequest() {
    this.requestPending = false;
    if (this.lastRequest && this.connection.send({ type: "cancel" })) this.lastRequest = "";
  }

  /** Start or stop the broadcast of this page's view. @param {boolean} on */
  setOnAir(on) {
    this.connection.send({ type: "on_air", on });
  }

  /** @param {{playing?: boolean, speed?: number, seek?: number, live?: boolean}} change */
  changeClock(change) {
    this.connection.send({ type: "clock", ...change });
  }
}
