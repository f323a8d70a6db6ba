// Playback: play and pause, seek, speed, and jump to live.

import { byId, setIcon, setSlider } from "./dom.js";

/** The speeds of playback. */
const SPEEDS = [0.25, 0.5, 1, 2, 4];
/**
 * A request overrides the server's states for this long, in milliseconds: they may be older than the request.
 */
const OVERRIDE_MS = 1000;
/** The share of a difference from the server's clock that each repaint corrects. */
const CORRECTION = 0.03;
/** A difference of more frames than this, or than a third of a second, is corrected at once. */
const MAX_DIFFERENCE = 2;

export class Transport {
  /**
   * @param {import("../link/viewer.js").ViewerLink} link
   * @param {number} initialFrame the frame to start at, paused; -1 to play
   */
  constructor(link, initialFrame) {
    this.link = link;
    this.initialFrame = initialFrame;
    /** The server's last state, with the requested changes. @type {any} */
    this.state = null;
    /** The requested changes. @type {Record<string, {value: any, at: number}>} */
    this.requested = {};
    this.seeking = false;
    /** The shown frame; -1 for none. */
    this.shown = -1;
    /** The requested frame while it is not shown yet; -1 for none. */
    this.soughtFrame = -1;
    /**
     * Whether the page draws the frames: it then pauses at the shown frame, which may not be the server's.
     */
    this.drawing = false;
    /** The server's clock when its last state arrived. */
    this.serverClock = { time: 0, at: 0 };
    /** The position that follows it smoothly, in frames. */
    this.position = 0;
    this.positionAt = 0;
    const seek = byId("seek");
    seek.addEventListener("input", () => {
      this.seeking = true;
      this.seek(Number(seek.value));
    });
    // some browsers do not fire "change" if a slider is dragged away and back
    for (const end of ["change", "pointerup"]) {
      seek.addEventListener(end, () => {
        this.seeking = false;
        this.soughtFrame = -1;
      });
    }
    byId("play").addEventListener("click", () => this.toggle());
    byId("live").addEventListener("click", () => this.goLive());
    byId("speed").addEventListener("change", () => this.setSpeed(Number(byId("speed").value)));
    link.addEventListener("state", (event) => {
      const state = /** @type {CustomEvent} */ (event).detail;
      this.serverClock = { time: state.time, at: performance.now() };
      this.#setState(state);
    });
    link.addEventListener("welcome", () => this.#restoreClock());
  }

  /** Whether playback is running. */
  get playing() {
    return !this.state || (this.state.playing && this.state.total !== 1);
  }

  /** The paused or initial frame; -1 while playing. */
  get stillFrame() {
    if (this.initialFrame >= 0) return this.initialFrame;
    if (this.playing || this.state.total === 1) return -1;
    return Math.max(this.soughtFrame, this.shown);
  }

  /** Play or pause. */
  toggle() {
    this.soughtFrame = -1;
    const playing = !this.#current("playing", true);
    const pausesAtShown = !playing && this.drawing && this.shown >= 0;
    this.#changeClock(pausesAtShown ? { playing, seek: this.shown } : { playing });
  }

  /** The frames that are available. */
  get range() {
    return { first: this.state?.first ?? 0, end: this.state?.end ?? 0 };
  }

  /**
   * Find the frame to draw now, by the server's clock, which runs on between its messages.
   * @param {number} now ms
   * @param {number} fps of the source
   * @returns {number} -1 if there is none
   */
  timeAt(now, fps) {
    const { state } = this;
    if (!state || state.end <= state.first) return -1;
    if (!this.playing) {
      return this.#clampFrame(this.soughtFrame >= 0 ? this.soughtFrame : this.#current("seek", state.time));
    }
    if (state.kind === "live") return this.#clampFrame(state.time);
    this.#followClock(now, fps);
    return this.#clampFrame(Math.floor(this.position));
  }

  /**
   * Advance the position, and correct its difference from the server's clock; wait where that waits.
   * @param {number} now ms
   * @param {number} fps
   */
  #followClock(now, fps) {
    const { state, serverClock } = this;
    const count = state.end - state.first;
    const framesPerMs = state.buffering ? 0 : (fps * state.speed) / 1000;
    const loops = state.end === state.total;
    this.position += (now - this.positionAt) * framesPerMs;
    this.positionAt = now;
    const serverPosition = serverClock.time + 0.5 + (now - serverClock.at) * framesPerMs;
    const frames = serverPosition - this.position;
    const difference = loops ? frames - count * Math.round(frames / count) : frames;
    const jumps = state.buffering || Math.abs(difference) > Math.max(MAX_DIFFERENCE, fps / 3);
    this.position += jumps ? difference : CORRECTION * difference;
    if (loops) {
      const offset = this.position - state.first;
      this.position = state.first + (((offset % count) + count) % count);
    }
  }

  /** @param {number} time */
  #clampFrame(time) {
    return Math.min(this.state.end - 1, Math.max(this.state.first, time));
  }

  /** @param {number} time */
  seek(time) {
    if (time === this.soughtFrame && this.seeking) return;
    this.soughtFrame = time;
    this.#changeClock({ seek: time });
  }

  /** @param {number} time */
  pauseAt(time) {
    this.soughtFrame = time;
    this.#changeClock({ playing: false, seek: time });
  }

  /** Pause, and go to another frame. @param {number} frames */
  step(frames) {
    if (!this.state) return;
    const time = this.state.playing || this.soughtFrame < 0 ? this.shown : this.soughtFrame;
    this.pauseAt(this.#clampFrame(time + frames));
  }

  goLive() {
    this.soughtFrame = -1;
    this.#changeClock({ live: true, speed: 1 });
  }

  /** @param {number} speed */
  setSpeed(speed) {
    this.#changeClock({ speed });
  }

  /** @param {number} steps along the list of speeds */
  changeSpeed(steps) {
    if (this.state?.kind !== "recording") return;
    const index = SPEEDS.indexOf(this.#current("speed", 1)) + steps;
    this.setSpeed(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, index))]);
  }

  /**
   * Get a value of the last request, or of the server's state.
   * @param {string} name
   * @param {any} otherwise
   */
  #current(name, otherwise) {
    const requested = this.requested[name];
    const isNew = requested && (!this.state || performance.now() - requested.at < OVERRIDE_MS);
    if (isNew) return requested.value;
    return this.state?.[name] ?? otherwise;
  }

  /** Request a change of the clock, and show it before the server confirms it. @param {any} change */
  #changeClock(change) {
    this.link.changeClock(change);
    const expected = { ...change };
    const leavesLive = change.seek !== undefined || (change.speed ?? 1) !== 1 || change.playing === false;
    if (change.live) expected.playing = true;
    else if (leavesLive) expected.live = false;
    for (const [name, value] of Object.entries(expected)) {
      this.requested[name] = { value, at: performance.now() };
    }
    if (this.state) this.#setState({ ...this.state, ...expected });
  }

  /** Restore the clock after a lost connection. */
  #restoreClock() {
    const last = this.state;
    if (!last || last.live) return;
    this.link.changeClock({ playing: last.playing, speed: last.speed, seek: this.shown });
  }

  /** Show a state. @param {any} state */
  #setState(state) {
    this.state = state;
    const recording = state.kind === "recording";

    // frames of a live rig that do not exist yet belong to an earlier run of the server
    const hasFrames = state.end > state.first;
    if (state.kind === "live" && hasFrames && this.initialFrame >= state.end) this.initialFrame = -1;

    // pause at the initial frame as soon as it is available
    const lastFrame = (state.total ?? Infinity) - 1;
    if (this.initialFrame >= 0 && state.end > Math.min(this.initialFrame, lastFrame)) {
      const seek = this.initialFrame;
      this.initialFrame = -1;
      this.#changeClock({ playing: false, seek });
      return;
    }

    // slider
    const isSingleFrame = recording && state.total === 1;
    byId("transport").hidden = isSingleFrame;
    const seek = byId("seek");
    seek.min = state.first;
    seek.max = Math.max(state.first, (state.total ?? state.end) - 1);
    seek.disabled = state.end - state.first < 2;

    // buttons
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
    this.showFrame(this.shown);
  }

  /** Show the index of the displayed frame. @param {number} time */
  showFrame(time) {
    this.shown = time;
    if (time === this.soughtFrame && !this.seeking) this.soughtFrame = -1;
    if (!this.state || time < 0) return;
    if (!this.seeking) setSlider(byId("seek"), time);
    else setSlider(byId("seek"), Number(byId("seek").value));
    const { end, first, kind, total } = this.state;
    byId("time").textContent = kind === "live" ? `${time}` : `${time - first + 1} / ${total ?? end - first}`;
  }
}
