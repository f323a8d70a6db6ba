// The connection to the server: messages become events, and a broken connection is restored.

import { buildAddress } from "./address.js";

/** The version of the protocol. */
const VERSION = 1;
/** The first wait before another try, in milliseconds; each further wait is twice as long. */
const MIN_RETRY_MS = 500;
/** The longest wait before another try, in milliseconds. */
const MAX_RETRY_MS = 15000;
/** A hidden page closes its connection after this long, in milliseconds. */
const HIDDEN_MS = 10000;
/** WebSocket's close code of a connection that broke or was never established. */
const ABNORMAL_CLOSURE = 1006;
/** The server's close code for a missing or wrong token. */
const UNAUTHORISED = 4401;
/** Explanations of the close codes after which another try is pointless. */
const FINAL_REASONS = {
  4401:
    "This server needs a token. " +
    "Open the full address, with its token, that the server printed when it started.",
  4426: "The page and the server have different versions. Reload the page.",
};
/** Explanations of other close codes. */
const REASONS = {
  1012: "The server has stopped.",
  4429: "This page sent too many messages; the server closed the connection.",
  4503: "The maximum number of viewers is reached.",
};

/**
 * Owns the socket, which lives in a worker. Events: "message" (detail: a JSON message), "picture" (detail: a
 * decoded frame), "undecodable" (detail: the error of a frame that cannot be decoded), and "status" (detail:
 * {status, text, wait_s}), where status is "connecting", "open", "lost" (another try in wait_s) or "refused".
 */
export class Connection extends EventTarget {
  /** @param {string | null} token @param {string[]} codecs that the browser can decode */
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
    this.worker.onmessage = ({ data }) => this.#handle(data);
    document.addEventListener("visibilitychange", () => this.#followVisibility());
  }

  /** Connect, unless there is a connection. */
  open() {
    clearTimeout(this.timer);
    if (this.socket !== "none") return;
    this.#reportStatus("connecting", "Connecting");
    const url = buildAddress("ws", this.token);
    url.protocol = url.protocol.replace("http", "ws");
    this.socket = "opening";
    this.#command({ open: url.href });
  }

  /** @param {object} message @returns {boolean} whether it was sent */
  send(message) {
    if (this.socket !== "open") return false;
    this.#command({ send: JSON.stringify(message) });
    return true;
  }

  /** @param {import("./worker.js").Command} command */
  #command(command) {
    this.worker.postMessage(command);
  }

  /** Handle a report of the worker. @param {any} report */
  #handle(report) {
    if ("picture" in report) {
      this.dispatchEvent(new CustomEvent("picture", { detail: report.picture }));
      this.#command({ taken: true });
    } else if ("text" in report) {
      this.#receive(JSON.parse(report.text));
    } else if ("undecodable" in report) {
      this.dispatchEvent(new CustomEvent("undecodable", { detail: report.undecodable }));
    } else if ("closed" in report) {
      void this.#findReason(report.closed.code, report.closed.reason);
    } else {
      this.socket = "open";
      this.send({ type: "hello", version: VERSION, codecs: this.codecs });
    }
  }

  /** @param {any} message */
  #receive(message) {
    if (message.type === "welcome") {
      this.failures = 0;
      this.#reportStatus("open", "Connected");
    }
    this.dispatchEvent(new CustomEvent("message", { detail: message }));
  }

  /**
   * Find out why the connection was closed. A browser does not say why a handshake was refused, but /health
   * does.
   * @param {number} code
   * @param {string} reason
   */
  async #findReason(code, reason) {
    if (code !== ABNORMAL_CLOSURE || this.socket !== "opening") {
      this.#close(code, reason);
      return;
    }
    const health = await fetch(buildAddress("health", this.token)).catch(() => null);
    this.#close(health?.status === 401 ? UNAUTHORISED : code, reason);
  }

  /**
   * Report that the connection was closed, and try again if that makes sense.
   * @param {number} code
   * @param {string} reason
   */
  #close(code, reason) {
    this.socket = "none";
    const finalReason = /** @type {any} */ (FINAL_REASONS)[code];
    if (finalReason) {
      this.refused = true;
      this.#reportStatus("refused", finalReason);
      return;
    }
    this.failures += 1;
    const wait = Math.min(MAX_RETRY_MS, MIN_RETRY_MS * 2 ** (this.failures - 1));
    const text = /** @type {any} */ (REASONS)[code] ?? (reason || "Connection lost.");
    this.#reportStatus("lost", text, wait / 1000);
    if (!document.hidden) this.timer = setTimeout(() => this.open(), wait);
  }

  /** Disconnect while the page is hidden, so that it costs the server nothing. */
  #followVisibility() {
    clearTimeout(this.timer);
    if (document.hidden) {
      this.timer = setTimeout(() => this.#command({ close: "hidden" }), HIDDEN_MS);
    } else if (!this.refused) {
      this.open();
    }
  }

  /** @param {string} status @param {string} text @param {number} [wait_s] */
  #reportStatus(status, text, wait_s = 0) {
    this.dispatchEvent(new CustomEvent("status", { detail: { status, text, wait_s } }));
  }
}
