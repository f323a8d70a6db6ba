// Playback: play and pause, seek, speed, and jump to live.

import { byId, setIcon, setSlider } from "./dom.js";

const SPEEDS = [0.25, 0.5, 1, 2, 4];
/** How long a request overrides states of the server, which may have been sent before the request arrived. */
const HEARD_MS = 1000;

export class Transport {
  /** @param {import("../link/viewer.js").ViewerLink} link @param {number} first the frame to begin at, paused; -1 to play */
  constructor(link, first) {
    this.link = link;
    this.first = first;
    /** @type {any} */
    this.state = null;
    /** @type {Record<string, {value: any, at: number}>} */
    this.requested = {};
    this.seeking = false;
    this.shown = -1;
    /** The requested frame while it is not shown yet; -1 if none. */
    this.sought = -1;
    /** Whether the page draws frames by itself: it pauses at the shown one, which may not be the server's. */
    this.drawing = false;
    /** The server's clock at a moment, and the position that follows it smoothly. */
    this.heard = { time: 0, at: 0 };
    this.position = 0;
    this.positionAt = 0;
    const seek = byId("seek");
    seek.addEventListener("input", () => {
      this.seeking = true;
      this.seek(Number(seek.value));
    });
    // Not every browser fires "change" for a slider that is dragged away and back.
    for (const end of ["change", "pointerup"]) {
      seek.addEventListener(end, () => {
        this.seeking = false;
        this.sought = -1;
      });
    }
    byId("play").addEventListener("click", () => this.toggle());
    byId("live").addEventListener("click", () => this.live());
    byId("speed").addEventListener("change", () => this.speed(Number(byId("speed").value)));
    link.addEventListener("state", (event) => {
      const state = /** @type {CustomEvent} */ (event).detail;
      this.heard = { time: state.time, at: performance.now() };
      this.#state(state);
    });
    link.addEventListener("welcome", () => this.#again());
  }

  /** Whether playback is running. */
  get playing() {
    return !this.state || (this.state.playing && this.state.total !== 1);
  }

  /** The paused or initial frame; -1 while playing. */
  get still() {
    return this.first >= 0 ? this.first : this.playing || this.state.total === 1 ? -1 : Math.max(this.sought, this.shown);
  }

  toggle() {
    this.sought = -1;
    const playing = !this.#current("playing", true);
    this.#sendClock(playing || !this.drawing || this.shown < 0 ? { playing } : { playing, seek: this.shown });
  }

  /** The frames that there are. */
  get range() {
    return { first: this.state?.first ?? 0, end: this.state?.end ?? 0 };
  }

  /**
   * The frame to draw now: the server's clock, continued between its messages.
   * @param {number} now ms @param {number} fps of the source @returns {number} -1 if there is none
   */
  timeAt(now, fps) {
    const { state, heard } = this;
    if (!state || state.end <= state.first) return -1;
    if (!this.playing) return this.#within(this.sought >= 0 ? this.sought : this.#current("seek", state.time));
    if (state.kind === "live") return this.#within(state.time);
    const [count, perMs] = [state.end - state.first, (fps * state.speed) / 1000];
    const wrap = (/** @type {number} */ frames) => (state.end === state.total ? frames - count * Math.round(frames / count) : frames);
    this.position += (now - this.positionAt) * perMs;
    this.positionAt = now;
    const off = wrap(heard.time + 0.5 + (now - heard.at) * perMs - this.position);
    this.position += Math.abs(off) > Math.max(2, fps / 3) ? off : 0.03 * off;
    if (state.end === state.total) this.position = state.first + ((((this.position - state.first) % count) + count) % count);
    return this.#within(Math.floor(this.position));
  }

  /** @param {number} time */
  #within(time) {
    return Math.min(this.state.end - 1, Math.max(this.state.first, time));
  }

  /** @param {number} time */
  seek(time) {
    if (time === this.sought && this.seeking) return;
    this.sought = time;
    this.#sendClock({ seek: time });
  }

  /** @param {number} time */
  pauseAt(time) {
    this.sought = time;
    this.#sendClock({ playing: false, seek: time });
  }

  /** @param {number} frames */
  step(frames) {
    if (!this.state) return;
    const time = this.state.playing || this.sought < 0 ? this.shown : this.sought;
    this.pauseAt(this.#within(time + frames));
  }

  live() {
    this.sought = -1;
    this.#sendClock({ live: true, speed: 1 });
  }

  /** @param {number} speed */
  speed(speed) {
    this.#sendClock({ speed });
  }

  /** @param {number} steps along the list of speeds */
  faster(steps) {
    if (this.state?.kind !== "recording") return;
    const place = SPEEDS.indexOf(this.#current("speed", 1));
    this.speed(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, place + steps))]);
  }

  /** The last request, or the state of the server. @param {string} name @param {any} otherwise */
  #current(name, otherwise) {
    const requested = this.requested[name];
    return requested && performance.now() - requested.at < HEARD_MS ? requested.value : (this.state?.[name] ?? otherwise);
  }

  /** Send a change of the clock, and show it before the server confirms it. @param {any} clock */
  #sendClock(clock) {
    this.link.clock(clock);
    const parted = clock.seek !== undefined || (clock.speed ?? 1) !== 1 || clock.playing === false;
    const meant = { ...clock, ...(clock.live ? { playing: true } : parted ? { live: false } : {}) };
    for (const [name, value] of Object.entries(meant)) this.requested[name] = { value, at: performance.now() };
    if (this.state) this.#state({ ...this.state, ...meant });
  }

  /** Restore the clock after a lost connection. */
  #again() {
    const last = this.state;
    if (last && !last.live) this.link.clock({ playing: last.playing, speed: last.speed, seek: this.shown });
  }

  /** @param {any} state */
  #state(state) {
    this.state = state;
    const recording = state.kind === "recording";
    if (this.first >= 0 && state.end > Math.min(this.first, (state.total ?? Infinity) - 1)) {
      const seek = this.first;
      this.first = -1;
      this.#sendClock({ playing: false, seek });
      return;
    }
    byId("transport").hidden = recording && state.total === 1; // a single frame
    const seek = byId("seek");
    seek.min = state.first;
    seek.max = Math.max(state.first, (state.total ?? state.end) - 1);
    seek.disabled = state.end - state.first < 2;
    const play = byId("play");
    play.setAttribute("aria-label", state.playing ? "Pause" : "Play");
    play.title = state.playing ? "Pause (space)" : "Play (space)";
    setIcon(play, state.playing ? "pause" : "play");
    const live = byId("live");
    live.setAttribute("aria-pressed", String(state.live));
    const behind = !state.live && state.behind > 0 ? ` −${state.behind}` : "";
    live.lastElementChild.textContent = `Live${recording ? "" : behind}`;
    live.title = recording ? "Rejoin the shared playback (L)" : "Jump to live (L)";
    byId("speed").disabled = !recording;
    byId("speed").value = String(state.speed);
    this.picture(this.shown);
  }

  /** Show the index of the displayed frame. @param {number} time */
  picture(time) {
    this.shown = time;
    if (time === this.sought && !this.seeking) this.sought = -1;
    if (!this.state || time < 0) return;
    if (!this.seeking) setSlider(byId("seek"), time);
    else setSlider(byId("seek"), Number(byId("seek").value));
    const { end, first, kind, total } = this.state;
    byId("time").textContent = kind === "live" ? `${time}` : `${time - first + 1} / ${total ?? end - first}`;
  }
}
