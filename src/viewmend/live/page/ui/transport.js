// Time: play and pause, seek, speed, and the way back to the live edge.

import { byId, setIcon, setSlider } from "./dom.js";

const SPEEDS = [0.25, 0.5, 1, 2, 4];

export class Transport {
  /** @param {import("../link/viewer.js").ViewerLink} link */
  constructor(link) {
    this.link = link;
    /** @type {any} */
    this.state = null;
    this.seeking = false;
    this.shown = -1;
    this.sought = -1;
    const seek = byId("seek");
    seek.addEventListener("input", () => {
      this.seeking = true;
      this.seek(Number(seek.value));
    });
    seek.addEventListener("change", () => (this.seeking = false));
    byId("play").addEventListener("click", () => this.toggle());
    byId("live").addEventListener("click", () => this.live());
    byId("speed").addEventListener("change", () => this.speed(Number(byId("speed").value)));
    link.addEventListener("state", (event) => this.#state(/** @type {CustomEvent} */ (event).detail));
    link.addEventListener("welcome", () => this.#again());
  }

  toggle() {
    const playing = !(this.state?.playing ?? true);
    this.#tell({ playing });
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
    this.#tell({ live: true, speed: 1 });
  }

  /** @param {number} speed */
  speed(speed) {
    this.#tell({ speed });
  }

  /** @param {number} steps along the list of speeds */
  faster(steps) {
    const place = SPEEDS.indexOf(this.state?.speed ?? 1);
    this.speed(SPEEDS[Math.min(SPEEDS.length - 1, Math.max(0, place + steps))]);
  }

  /** @param {any} clock */
  #tell(clock) {
    this.link.clock(clock);
    const parted = clock.seek !== undefined || (clock.speed ?? 1) !== 1 || clock.playing === false;
    if (this.state) this.#state({ ...this.state, ...clock, ...(clock.live ? { playing: true } : parted ? { live: false } : {}) });
  }

  /** After a lost connection the clock is put back to where it was. */
  #again() {
    const last = this.state;
    if (last && !last.live) this.link.clock({ playing: last.playing, speed: last.speed, seek: this.shown });
  }

  /** @param {any} state */
  #state(state) {
    this.state = state;
    const recording = state.kind === "recording";
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
    live.title = recording ? "Return to where all viewers are (L)" : "Return to the live edge (L)";
    byId("speed").disabled = !recording;
    byId("speed").value = String(state.speed);
    this.picture(this.shown);
  }

  /** The time of the picture that is shown. @param {number} time */
  picture(time) {
    this.shown = time;
    if (!this.state || time < 0) return;
    if (!this.seeking) setSlider(byId("seek"), time);
    else setSlider(byId("seek"), Number(byId("seek").value));
    const { end, first, kind, total } = this.state;
    byId("time").textContent = kind === "live" ? `${time}` : `${time - first + 1} / ${total ?? end - first}`;
  }
}
