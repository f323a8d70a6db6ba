// The link to the server: hello, messages as events, and a new try when it breaks.

import { address } from "./address.js";

const VERSION = 1;
const LONGEST_WAIT_MS = 15000;
/** Close codes after which another try is pointless. */
const FINAL = {
  4401: "This server needs a token. Open the full address, with its token, that the server printed when it started.",
  4426: "The page and the server have different versions. Reload the page.",
};
const REASONS = { 4429: "This page sent too many messages; the server closed the connection.", 4503: "The maximum number of viewers is reached.", 1012: "The server has stopped." };

/**
 * Events: "message" (detail: a JSON message), "picture" (detail: a frame, decoded), "trouble" (detail: text, of one that cannot
 * be), and "status" (detail: {status, text, wait_s}) where status is "connecting", "open", "lost" (another try in wait_s) or
 * "refused". The socket is a worker's.
 */
export class Connection extends EventTarget {
  /** @param {string | null} token @param {string[]} codecs */
  constructor(token, codecs) {
    super();
    this.token = token;
    this.codecs = codecs;
    this.failures = 0;
    /** @type {"none" | "opening" | "open"} */
    this.socket = "none";
    this.timer = 0;
    this.refused = false;
    this.worker = new Worker(new URL("./worker.js", import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }) => this.#hear(data);
    document.addEventListener("visibilitychange", () => this.#visibility());
  }

  open() {
    clearTimeout(this.timer);
    if (this.socket !== "none") return;
    this.#status("connecting", "Connecting");
    const url = address("ws", this.token);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = "opening";
    this.#order({ open: url.href });
  }

  /** @param {object} message @returns {boolean} whether it went out */
  send(message) {
    if (this.socket !== "open") return false;
    this.#order({ send: JSON.stringify(message) });
    return true;
  }

  /** @param {import("./worker.js").Order} order */
  #order(order) {
    this.worker.postMessage(order);
  }

  /** @param {any} news message of the worker */
  #hear(news) {
    if ("picture" in news) {
      this.dispatchEvent(new CustomEvent("picture", { detail: news.picture }));
      this.#order({ taken: true });
    } else if ("text" in news) this.#receive(JSON.parse(news.text));
    else if ("trouble" in news) this.dispatchEvent(new CustomEvent("trouble", { detail: news.trouble }));
    else if ("closed" in news) void this.#ended(news.closed.code, news.closed.reason);
    else {
      this.socket = "open";
      this.send({ type: "hello", version: VERSION, codecs: this.codecs });
    }
  }

  /** @param {any} message */
  #receive(message) {
    if (message.type === "welcome") {
      this.failures = 0;
      this.#status("open", "Connected");
    }
    this.dispatchEvent(new CustomEvent("message", { detail: message }));
  }

  /** A refused handshake says nothing to a page: whether it is the token, /health says. @param {number} code @param {string} reason */
  async #ended(code, reason) {
    if (code !== 1006 || this.socket !== "opening") return this.#closed(code, reason);
    const health = await fetch(address("health", this.token)).catch(() => null);
    return this.#closed(health?.status === 401 ? 4401 : code, reason);
  }

  /** @param {number} code @param {string} reason */
  #closed(code, reason) {
    this.socket = "none";
    const final = /** @type {any} */ (FINAL)[code];
    if (final) {
      this.refused = true;
      this.#status("refused", final);
      return;
    }
    this.failures += 1;
    const wait = Math.min(LONGEST_WAIT_MS, 500 * 2 ** (this.failures - 1));
    const why = /** @type {any} */ (REASONS)[code] ?? (reason || "Connection lost.");
    this.#status("lost", why, wait / 1000);
    if (!document.hidden) this.timer = setTimeout(() => this.open(), wait);
  }

  /** A hidden page costs the server nothing; it comes back when it is looked at. */
  #visibility() {
    clearTimeout(this.timer);
    if (document.hidden) this.timer = setTimeout(() => this.#order({ close: "hidden" }), 10000);
    else if (!this.refused) this.open();
  }

  /** @param {string} status @param {string} text @param {number} [wait_s] */
  #status(status, text, wait_s = 0) {
    this.dispatchEvent(new CustomEvent("status", { detail: { status, text, wait_s } }));
  }
}
