// The section "Camera path": record, add views, play, and export as MP4.

import { fovOf, lensOf } from "../view/lens.js";
import { FPS, MOST_POSES, Track } from "../view/camera_path.js";
import { extrinsicsOf } from "../view/pose.js";
import { pathFile, pointsOf } from "../view/camera_path_file.js";
import { byId, download, element } from "./dom.js";
import { clamp } from "../view/matrix.js";

/** How far a film's two eyes are apart, metres; players know by the name's end, _SBS, that they lie side by side. */
const EYES_M = 0.064;

/**
 * @typedef {object} FilmInMaking
 * @property {number} since when it was begun, ms
 * @property {(request: any) => Promise<Blob | null>} make null where it was called off
 * @property {() => void} cancel
 */

/**
 * @typedef {object} Films what renders films
 * @property {(onProgress: (progress: {part: number, text: string}) => void) => FilmInMaking} make
 * @property {(asked: Record<string, number>) => Promise<{target: number[], distance: number, f: number}>} turntable the distance and
 *   the focal length in pixels at which every image shows the whole motion
 */

/**
 * @typedef {object} Surroundings
 * @property {import("../view/motion.js").Motion} motion
 * @property {import("./transport.js").Transport} transport
 * @property {import("./notices.js").Notices} notices
 * @property {import("../settings.js").Settings} settings
 * @property {Films} films
 * @property {() => void} wake
 */

export class PathPanel {
  /** @param {Surroundings} around */
  constructor(around) {
    this.around = around;
    this.track = new Track();
    this.recording = false;
    /** @type {{since: number, hands: number} | null} */
    this.playing = null;
    /** The film that is being rendered. @type {FilmInMaking | null} */
    this.film = null;
    this.progressText = "";
    this.listed = "";
    byId("path-record").addEventListener("click", () => this.toggleRecording());
    byId("path-add").addEventListener("click", () => this.#add());
    byId("path-play").addEventListener("click", () => this.#play());
    byId("path-clear").addEventListener("click", () => {
      this.track.clear();
      this.playing = null;
      this.#show();
    });
    byId("path-turntable").addEventListener("click", () => void this.#turntable());
    byId("path-export").addEventListener("click", () => this.#export());
    byId("path-cancel").addEventListener("click", () => this.film?.cancel());
    byId("path-save").addEventListener("click", () => this.#save());
    byId("path-open").addEventListener("click", () => byId("path-file").click());
    byId("path-file").addEventListener("change", () => void this.#open());
    this.#show();
  }

  toggleRecording() {
    this.playing = null;
    this.recording = !this.recording && this.around.motion.pose !== null;
    if (this.recording) this.track.start(performance.now());
    this.#show();
    this.around.wake();
  }

  #add() {
    const { motion, transport } = this.around;
    if (!motion.goal) return;
    if (this.track.recordingSince >= 0) this.track.clear();
    this.recording = false;
    this.track.add(motion.goal, transport.shown);
    this.#show();
  }

  /** Around the subject at the height that is looked from, so that the film shows the whole motion. */
  async #turntable() {
    const { motion, transport, notices, films } = this.around;
    if (!motion.goal) return;
    this.recording = false;
    this.playing = null;
    const button = byId("path-turntable");
    const [seconds, arc] = [clamp(Number(byId("path-seconds").value) || 6, 1, (MOST_POSES - 1) / FPS), Number(byId("path-arc").value)];
    const { azimuth, elevation } = motion.goal;
    const time = Math.max(0, transport.shown);
    const frames = this.#still ? 1 : Math.ceil(seconds * (motion.rig.fps ?? 0)) + 1;
    const { width, height } = this.#size();
    button.disabled = true;
    try {
      const { target, distance, f } = await films.turntable({ time, frames, azimuth, arc, elevation, width, height });
      const fov = fovOf({ width, height }, f);
      this.track.turntable({ target, azimuth, elevation, roll: 0, distance, fov }, arc, seconds, time);
    } catch (error) {
      notices.toast(`Could not make the turntable: ${/** @type {Error} */ (error).message}`, "error");
    } finally {
      button.disabled = false;
      this.#show();
    }
  }

  /** The views that were added, to be put in order. */
  #list() {
    const { points, recordingSince } = this.track;
    const change = (/** @type {() => void} */ edit) => () => {
      edit();
      this.playing = null;
      this.#show();
    };
    const button = (/** @type {string} */ text, /** @type {string} */ label, /** @type {() => void} */ act, disabled = false) => {
      const made = element("button", { type: "button", textContent: text, title: label, disabled });
      made.setAttribute("aria-label", label);
      made.addEventListener("click", act);
      return made;
    };
    const rows = recordingSince >= 0 ? [] : points.map(({ pose, seconds }, index) => {
      const view = `view ${index + 1}`;
      const moment = element("input", { type: "number", min: 0, step: 0.1, value: seconds.toFixed(1), disabled: index === 0 });
      moment.setAttribute("aria-label", `Seconds of ${view}`);
      moment.addEventListener("change", change(() => this.track.retime(index, Number(moment.value))));
      return element("li", {},
        button(String(index + 1), `Go to ${view}`, () => {
          this.around.motion.jump(pose);
          this.around.wake();
        }),
        moment, element("span", { textContent: "s" }),
        button("↑", `Move ${view} up`, change(() => this.track.move(index, -1)), index === 0),
        button("↓", `Move ${view} down`, change(() => this.track.move(index, 1)), index === points.length - 1),
        button("✕", `Delete ${view}`, change(() => this.track.remove(index))),
      );
    });
    byId("path-views").replaceChildren(...rows);
    byId("path-views").hidden = !rows.length;
  }

  #play() {
    this.recording = false;
    this.playing = this.playing ? null : { since: performance.now(), hands: this.around.motion.hands };
    this.#show();
    this.around.wake();
  }

  /** Once a repaint. @param {number} now ms @returns {boolean} whether the next repaint must come */
  step(now) {
    const { motion, transport } = this.around;
    if (this.recording && motion.pose) {
      if (!this.track.record(motion.pose, transport.shown, now)) this.toggleRecording();
      this.#show();
    }
    if (this.playing) {
      const seconds = (now - this.playing.since) / 1000;
      const over = seconds >= this.track.seconds || motion.hands !== this.playing.hands;
      if (motion.hands === this.playing.hands) motion.put(this.track.at(Math.min(seconds, this.track.seconds)));
      if (over) this.playing = null;
      if (over) this.#show();
    }
    return this.recording || this.playing !== null;
  }

  #show() {
    const { points, seconds, recordingSince } = this.track;
    const ready = points.length > 1 && !this.recording;
    const record = byId("path-record");
    record.setAttribute("aria-pressed", String(this.recording));
    record.lastElementChild.textContent = this.recording ? "Stop" : "Record";
    const room = recordingSince >= 0 || this.track.room;
    byId("path-add").disabled = !room;
    byId("path-play").disabled = !ready;
    byId("path-play").textContent = this.playing ? "Stop" : "Preview";
    byId("path-clear").disabled = !points.length || this.recording;
    const button = byId("path-export");
    button.disabled = !ready || this.film !== null;
    button.classList.toggle("busy", this.film !== null);
    button.textContent = this.film ? "Rendering" : "Export MP4";
    byId("path-save").disabled = !ready;
    byId("path-film").hidden = this.film === null;
    let text = "Record a movement, or add views to fly through.";
    if (points.length) text = recordingSince >= 0 ? `${seconds.toFixed(1)} s recorded` : `${points.length} view${points.length === 1 ? "" : "s"}, ${seconds.toFixed(0)} s${room ? "" : ", the maximum length"}`;
    if (this.film && this.progressText) text = this.progressText;
    byId("path-text").setAttribute("aria-live", this.recording ? "off" : "polite");
    if (byId("path-text").textContent !== text) byId("path-text").textContent = text;
    const listed = JSON.stringify([recordingSince >= 0, points]);
    if (listed === this.listed || this.recording) return;
    this.listed = listed;
    this.#list();
  }

  /** Whether the film shows one frame only. */
  get #still() {
    return byId("path-time").value === "still";
  }

  /** Of one eye's pictures. @param {boolean} [stereo] */
  #size(stereo = byId("path-stereo").checked) {
    const [across, height] = byId("path-size").value.split("x").map(Number);
    return { width: stereo ? across / 2 : across, height };
  }

  /** What is posted: cameras and times of the film's frames. @param {boolean} stereo whether two eyes share its width */
  #request(stereo = false) {
    const { motion, transport, settings } = this.around;
    const { width, height } = this.#size(stereo);
    const box = { left: 0, top: 0, width, height };
    const short = (/** @type {number} */ value) => Number(value.toFixed(6));
    const moments = this.track.moments;
    const poses = moments.map((seconds) => {
      const pose = this.track.at(seconds);
      const { R, T } = extrinsicsOf(motion.rig, pose);
      const { fx, fy, cx, cy } = lensOf(box, box, pose.fov);
      return { R: R.map(short), T: T.map(short), fx: short(fx), fy: short(fy), cx, cy };
    });
    const range = transport.state ?? { first: 0, end: 1 };
    const times = moments.map((seconds) =>
      this.#still ? transport.shown : this.track.timeAt(seconds, motion.rig.fps ?? FPS, range),
    );
    return { poses, times, fps: FPS, width, height, mode: settings.modes[settings.modes.length - 1], error_rule: settings.get("errorRule") || null, background: settings.ground, without: settings.without, model: settings.model, stereo_m: stereo ? EYES_M : null };
  }

  async #export() {
    const { notices, films } = this.around;
    const film = films.make(({ part, text }) => {
      byId("path-progress").value = part;
      this.progressText = text;
      this.#show();
    });
    const stereo = byId("path-stereo").checked;
    this.film = film;
    this.progressText = "";
    byId("path-progress").value = 0;
    this.#show();
    try {
      const made = await film.make(this.#request(stereo));
      if (made) download(made, stereo ? "viewmend-path_SBS.mp4" : "viewmend-path.mp4");
      notices.toast(made ? `Video exported (${((performance.now() - film.since) / 1000).toFixed(0)} s)` : "Export cancelled");
    } catch (error) {
      notices.toast(`Export failed: ${/** @type {Error} */ (error).message}`, "error");
    } finally {
      this.film = null;
      this.#show();
    }
  }

  #save() {
    const text = JSON.stringify(pathFile(this.track, this.#request()), null, 1);
    download(new Blob([text], { type: "application/json" }), "viewmend-path.json");
  }

  async #open() {
    const { motion, transport, notices } = this.around;
    const [file] = byId("path-file").files;
    if (!file || !motion.rig || !motion.goal) return;
    try {
      const { points, recorded } = pointsOf(JSON.parse(await file.text()), motion.rig, motion.goal.fov, Math.max(0, transport.shown));
      this.track.points = points;
      this.track.recordingSince = recorded ? 0 : -1;
      this.recording = false;
      this.playing = null;
      this.#show();
    } catch (error) {
      notices.toast(`${file.name} is not a camera path: ${/** @type {Error} */ (error).message}`, "error");
    } finally {
      byId("path-file").value = "";
    }
  }
}
