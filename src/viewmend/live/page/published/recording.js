// The clock of a published performance, which takes the place of a server's messages "rig" and "state".

import { add, length, scale, sub } from "../view/matrix.js";

/** The state is dispatched at this interval, in milliseconds. */
const STATE_MS = 500;
/** After an error, the files are requested again after this long, in seconds. */
const RETRY_S = 5;
/** A turntable leaves this share of its images free around the subject. */
const MARGIN = 0.06;
/** A turntable is at least this many radii from the subject's centre. */
const MIN_RADII = 1.2;

/**
 * Replaces the connection and the link to a server. Events: "rig" and "state", as link/viewer.js dispatches
 * them; "link" (detail: its query) if the URL was changed; and "status", as link/connection.js does.
 */
export class Recording extends EventTarget {
  /** @param {() => Promise<Response>} load fetches scene.json */
  constructor(load) {
    super();
    this.load = load;
    /** The content of scene.json. @type {any} */
    this.scene = null;
    /** Nothing is requested: the page draws all views. */
    this.requestPending = false;
    this.lastRequest = "";
    this.playing = true;
    this.speed = 1;
    /** Whether the clock waits for frames, as it does until the first ones have arrived. */
    this.buffering = true;
    /** The position at a moment, in frames. */
    this.anchor = { position: 0, at: performance.now() };
    /** Opens the performance again after an error; 0 while there is none. */
    this.timer = 0;
  }

  /** Load the performance, or load it again after an error. */
  async open() {
    clearTimeout(this.timer);
    this.timer = 0;
    this.#reportStatus("connecting", "");
    const isFirst = this.scene === null;
    try {
      const response = await this.load();
      if (!response.ok) throw new Error(`scene.json: the host answered ${response.status}`);
      this.scene = await response.json();
    } catch (error) {
      this.fail(String(/** @type {Error} */ (error).message ?? error));
      return;
    }
    if (isFirst) {
      setInterval(() => this.#reportState(), STATE_MS);
      window.addEventListener("hashchange", ({ newURL }) => {
        this.#dispatch("link", new URLSearchParams(new URL(newURL).hash.slice(1)));
      });
    }
    this.#reportStatus("open", "");
    this.#dispatch("rig", this.scene.rig);
    this.#reportState();
  }

  /** Report an error, and try again later. @param {string} text */
  fail(text) {
    if (this.timer) return;
    this.#reportStatus("lost", text, RETRY_S);
    this.timer = window.setTimeout(() => void this.open(), 1000 * RETRY_S);
  }

  /** Do nothing: there is no server to render a view. */
  requestView() {
    return false;
  }

  cancelRequest() {}

  setOnAir() {}

  /** @param {{playing?: boolean, speed?: number, seek?: number, live?: boolean}} change */
  changeClock({ playing, speed, seek, live }) {
    if (this.scene) this.#setPosition(Math.min(seek ?? this.#computePosition(), this.scene.frames - 1));
    if (speed !== undefined) this.speed = speed;
    if (playing !== undefined) this.playing = playing;
    if (live) this.playing = true;
    if (this.scene) this.#reportState();
  }

  /**
   * Wait at a frame that has not arrived yet, or play on from it.
   * @param {boolean} buffering whether to wait
   * @param {number} time
   */
  setBuffering(buffering, time) {
    if (buffering === this.buffering) return;
    this.buffering = buffering;
    this.#setPosition(time);
    this.#reportState();
  }

  /**
   * Compute the distance and focal length at which every image of a turntable shows the subject's box over
   * all frames.
   * @param {Record<string, number>} request
   */
  fitTurntable({ width, height }) {
    const { low, high } = this.scene.motion;
    const target = scale(add(low, high), 0.5);
    const radius = length(sub(high, low)) / 2;
    const distance = Math.max(this.scene.rig.home.distance, MIN_RADII * radius);
    const free = (1 - MARGIN) * Math.min(width, height);
    const f = (free * Math.sqrt(distance ** 2 - radius ** 2)) / (2 * radius);
    return { target, distance, f };
  }

  /** @param {number} position frames */
  #setPosition(position) {
    this.anchor = { position, at: performance.now() };
  }

  /** @returns {number} frames */
  #computePosition() {
    const { frames, rig } = this.scene;
    const seconds = (performance.now() - this.anchor.at) / 1000;
    const runs = this.playing && !this.buffering;
    const played = runs ? seconds * this.speed * (rig.fps ?? 0) : 0;
    return (this.anchor.position + played) % frames;
  }

  #reportState() {
    const { frames } = this.scene;
    const { playing, speed } = this;
    this.#dispatch("state", {
      kind: "recording",
      first: 0,
      end: frames,
      total: frames,
      source: "ready",
      playing,
      speed,
      live: playing && speed === 1,
      behind: 0,
      time: Math.floor(this.#computePosition()),
      buffering: this.buffering,
    });
  }

  /** @param {string} status @param {string} text @param {number} [wait_s] */
  #reportStatus(status, text, wait_s = 0) {
    this.#dispatch("status", { status, text, wait_s });
  }

  /** @param {string} name @param {any} detail */
  #dispatch(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
