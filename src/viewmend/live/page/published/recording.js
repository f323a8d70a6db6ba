// The clock of a published performance: what a server's messages "rig" and "state" say, from one file.

import { add, length, scale, sub } from "../view/matrix.js";
import { poseOf, timeOf } from "../view/url_state.js";

/** Between two states while time runs. */
const GAP_MS = 500;
/** A turntable leaves this share of its pictures free around the subject. */
const MARGIN = 0.06;

/**
 * Events: "rig" and "state", as link/viewer.js dispatches them; "show" where the address was changed; and "status", as
 * link/connection.js does.
 */
export class Recording extends EventTarget {
  /** @param {() => Promise<Response>} load fetches scene.json */
  constructor(load) {
    super();
    this.load = load;
    /** What scene.json says. @type {any} */
    this.scene = null;
    /** No view is ever asked for. */
    this.late = false;
    this.lastLook = "";
    this.playing = true;
    this.speed = 1;
    /** The position at a moment, in frames. */
    this.from = { position: 0, at: performance.now() };
  }

  async open() {
    this.#status("connecting", "");
    try {
      const answer = await this.load();
      if (!answer.ok) throw new Error(`scene.json: the host answered ${answer.status}`);
      this.scene = await answer.json();
    } catch (error) {
      this.fail(String(/** @type {Error} */ (error).message ?? error));
      return;
    }
    this.from.at = performance.now();
    this.#status("open", "");
    this.#dispatch("rig", this.scene.rig);
    this.#state();
    setInterval(() => this.#state(), GAP_MS);
    window.addEventListener("hashchange", () => this.#follow());
  }

  /** @param {string} why */
  fail(why) {
    this.#status("refused", why);
  }

  /** There is no server that could draw a view. */
  look() {
    return false;
  }

  rest() {}

  onAir() {}

  /** @param {{playing?: boolean, speed?: number, seek?: number, live?: boolean}} change */
  clock({ playing, speed, seek, live }) {
    this.#go(seek ?? this.#position());
    if (speed !== undefined) this.speed = speed;
    if (playing !== undefined) this.playing = playing;
    if (live) this.playing = true;
    this.#state();
  }

  /** The clock waits at a frame that is not there yet. @param {number} time */
  hold(time) {
    this.#go(time);
    this.#state();
  }

  /**
   * The distance and focal length at which the subject's box, over all frames, is in every picture of a turn.
   * @param {Record<string, number>} asked
   */
  frame({ width, height }) {
    const { low, high } = this.scene.motion;
    const target = scale(add(low, high), 0.5);
    const radius = length(sub(high, low)) / 2;
    const distance = Math.max(this.scene.rig.home.distance, 1.2 * radius);
    const f = ((1 - MARGIN) * Math.min(width, height) * Math.sqrt(distance ** 2 - radius ** 2)) / (2 * radius);
    return { target, distance, f };
  }

  /** @param {number} position frames */
  #go(position) {
    this.from = { position, at: performance.now() };
  }

  #position() {
    const { frames, rig } = this.scene;
    const gone = this.playing ? ((performance.now() - this.from.at) / 1000) * this.speed * (rig.fps ?? 0) : 0;
    return (this.from.position + gone) % frames;
  }

  /** The view of an address that was opened in this page. */
  #follow() {
    const asked = new URLSearchParams(location.hash.slice(1));
    const time = timeOf(asked.get("time"));
    this.#dispatch("show", { pose: poseOf(asked.get("pose")), mode: asked.get("mode") ?? "completed", ...(time < 0 ? {} : { time }) });
  }

  #state() {
    const { frames } = this.scene;
    const { playing, speed } = this;
    const clock = { playing, speed, live: playing && speed === 1, behind: 0, time: Math.floor(this.#position()) };
    this.#dispatch("state", { kind: "recording", first: 0, end: frames, total: frames, source: "ready", ...clock });
  }

  /** @param {string} status @param {string} text */
  #status(status, text) {
    this.#dispatch("status", { status, text, wait_s: 0 });
  }

  /** @param {string} name @param {any} detail */
  #dispatch(name, detail) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }
}
