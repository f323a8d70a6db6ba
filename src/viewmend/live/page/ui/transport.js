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
    link.addEventListener("state", (event) => this.#state(/** @type {CustomEvent} */ (event).detail));
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
    this.#tell({ playing: !this.#current("playing", true) });
  }

  /** @param {number} time */
  seek(time) {
    if (time === this.sought && this.seeking) return;
    this.sought = time;
    this.#tell({ seek: time });
  }

  /** @param {number} frames */
  step(frames) {
    if (!this.state) return;
    const time = this.state.playing || this.sought < 0 ? this.shown : this.sought;
    const next = Math.min(this.state.end - 1, Math.max(this.state.first, time + frames));
    this.sought = next;
    this.#tell({ playing: false, seek: next });
  }

  live() {
    this.sought = -1;
    this.#tell({ live: true, speed: 1 });
  }

  /** @param {number} speed */
  speed(speed) {
    this.#tell({ speed });
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

  /** @param {any} clock */
  #tell(clock) {
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
      this.#tell({ playing: false, seek });
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
