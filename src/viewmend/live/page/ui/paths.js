// The section "Camera path": record a path, add views, play it, and export it as MP4.

import { fovFromFocal, lensFromFov } from "../view/lens.js";
import { FPS, MAX_POSES, Track } from "../view/camera_path.js";
import { extrinsicsFromPose } from "../view/pose.js";
import { buildPathFile, readPoints } from "../view/camera_path_file.js";
import { byId, download, element } from "./dom.js";
import { clamp } from "../view/matrix.js";

/** The distance between the two eyes of a stereo video, in metres. */
const EYE_DISTANCE_M = 0.064;
/** The file name of a stereo video; players know by its end that the eyes are side by side. */
const STEREO_NAME = "viewmend-path_SBS.mp4";
/** The file name of any other video. */
const NAME = "viewmend-path.mp4";
/** The length of a turntable without a valid choice, in seconds. */
const TURNTABLE_SECONDS = 6;

/**
 * @typedef {object} FilmInProgress
 * @property {number} startedAt ms
 * @property {(request: any) => Promise<Blob | null>} make null if it was cancelled
 * @property {() => void} cancel
 */

/**
 * @typedef {object} TurntableFit
 * @property {number[]} target metres
 * @property {number} distance from the target, metres
 * @property {number} f focal length, pixels
 */

/**
 * @typedef {object} Films what renders videos
 * @property {(onProgress: (progress: {part: number, text: string}) => void) => FilmInProgress} make
 * @property {(request: Record<string, number>) => Promise<TurntableFit>} turntable finds the fit at which
 *   every image shows the whole motion
 */

/**
 * @typedef {object} PathContext parts of the page that the panel uses
 * @property {import("../view/motion.js").Motion} motion
 * @property {import("./transport.js").Transport} transport
 * @property {import("./notices.js").Notices} notices
 * @property {import("../settings.js").Settings} settings
 * @property {Films} films
 * @property {() => void} wake
 */

export class PathPanel {
  /** @param {PathContext} context */
  constructor(context) {
    this.context = context;
    this.track = new Track();
    this.recording = false;
    /**
     * When the preview began, and the user's movements until then.
     * @type {{since: number, userMoves: number} | null}
     */
    this.playing = null;
    /** The video that is being rendered. @type {FilmInProgress | null} */
    this.film = null;
    this.progressText = "";
    /** The listed views as JSON. */
    this.listed = "";
    byId("path-record").addEventListener("click", () => this.toggleRecording());
    byId("path-add").addEventListener("click", () => this.#addView());
    byId("path-play").addEventListener("click", () => this.#togglePreview());
    byId("path-clear").addEventListener("click", () => {
      this.track.clear();
      this.playing = null;
      this.#show();
    });
    byId("path-turntable").addEventListener("click", () => void this.#makeTurntable());
    byId("path-export").addEventListener("click", () => this.#export());
    byId("path-cancel").addEventListener("click", () => this.film?.cancel());
    byId("path-save").addEventListener("click", () => this.#save());
    byId("path-open").addEventListener("click", () => byId("path-file").click());
    byId("path-file").addEventListener("change", () => void this.#open());
    this.#show();
  }

  toggleRecording() {
    this.playing = null;
    this.recording = !this.recording && this.context.motion.pose !== null;
    if (this.recording) this.track.start(performance.now());
    this.#show();
    this.context.wake();
  }

  #addView() {
    const { motion, transport } = this.context;
    if (!motion.goal) return;
    if (this.track.recordingSince >= 0) this.track.clear();
    this.recording = false;
    this.track.add(motion.goal, transport.shown);
    this.#show();
  }

  /** Make a path around the subject at the current elevation, at a distance that shows the whole motion. */
  async #makeTurntable() {
    const { motion, transport, notices, films } = this.context;
    if (!motion.goal) return;
    this.recording = false;
    this.playing = null;
    const button = byId("path-turntable");
    const maxSeconds = (MAX_POSES - 1) / FPS;
    const seconds = clamp(Number(byId("path-seconds").value) || TURNTABLE_SECONDS, 1, maxSeconds);
    const arc = Number(byId("path-arc").value);
    const { azimuth, elevation } = motion.goal;
    const time = Math.max(0, transport.shown);
    const frames = this.#still ? 1 : Math.ceil(seconds * (motion.rig.fps ?? 0)) + 1;
    const { width, height } = this.#readSize();
    button.disabled = true;
    try {
      const request = { time, frames, azimuth, arc, elevation, width, height };
      const { target, distance, f } = await films.turntable(request);
      const fov = fovFromFocal({ width, height }, f);
      const pose = { target, azimuth, elevation, roll: 0, distance, fov };
      this.track.turntable(pose, arc, seconds, time);
    } catch (error) {
      notices.toast(`Could not make the turntable: ${/** @type {Error} */ (error).message}`, "error");
    } finally {
      button.disabled = false;
      this.#show();
    }
  }

  #togglePreview() {
    this.recording = false;
    const { userMoves } = this.context.motion;
    this.playing = this.playing ? null : { since: performance.now(), userMoves };
    this.#show();
    this.context.wake();
  }

  /**
   * Record or play at each repaint.
   * @param {number} now ms
   * @returns {boolean} whether another repaint is needed
   */
  step(now) {
    const { motion, transport } = this.context;
    if (this.recording && motion.pose) {
      if (!this.track.record(motion.pose, transport.shown, now)) this.toggleRecording();
      this.#show();
    }
    if (this.playing) {
      const seconds = (now - this.playing.since) / 1000;
      const interrupted = motion.userMoves !== this.playing.userMoves;
      const over = seconds >= this.track.seconds || interrupted;
      if (!interrupted) motion.jumpTo(this.track.at(Math.min(seconds, this.track.seconds)));
      if (over) {
        this.playing = null;
        this.#show();
      }
    }
    return this.recording || this.playing !== null;
  }

  /** Update all controls of the section. */
  #show() {
    const { points, recordingSince } = this.track;
    const ready = points.length > 1 && !this.recording;

    // buttons
    const record = byId("path-record");
    record.setAttribute("aria-pressed", String(this.recording));
    record.lastElementChild.textContent = this.recording ? "Stop" : "Record";
    byId("path-add").disabled = !this.#hasRoom;
    byId("path-play").disabled = !ready;
    byId("path-play").textContent = this.playing ? "Stop" : "Preview";
    byId("path-clear").disabled = !points.length || this.recording;
    byId("path-save").disabled = !ready;

    // export
    const exportButton = byId("path-export");
    exportButton.disabled = !ready || this.film !== null;
    exportButton.classList.toggle("busy", this.film !== null);
    exportButton.textContent = this.film ? "Rendering" : "Export MP4";
    byId("path-film").hidden = this.film === null;

    // description
    const text = this.film && this.progressText ? this.progressText : this.#describePath();
    byId("path-text").setAttribute("aria-live", this.recording ? "off" : "polite");
    if (byId("path-text").textContent !== text) byId("path-text").textContent = text;

    // list of views, which is not updated while recording
    const listed = JSON.stringify([recordingSince >= 0, points]);
    if (listed === this.listed || this.recording) return;
    this.listed = listed;
    this.#listViews();
  }

  /** Whether a view can be added; a recorded path is replaced by it. */
  get #hasRoom() {
    return this.track.recordingSince >= 0 || this.track.room;
  }

  #describePath() {
    const { points, seconds, recordingSince } = this.track;
    if (!points.length) return "Record a movement, or add views to fly through.";
    if (recordingSince >= 0) return `${seconds.toFixed(1)} s recorded`;
    const plural = points.length === 1 ? "" : "s";
    const limit = this.#hasRoom ? "" : ", the maximum length";
    return `${points.length} view${plural}, ${seconds.toFixed(0)} s${limit}`;
  }

  /** List the views that were added, to be sorted, timed and deleted. Rows stay, and with them the focus. */
  #listViews() {
    const { points, recordingSince } = this.track;
    const list = byId("path-views");
    const count = recordingSince >= 0 ? 0 : points.length;
    while (list.children.length > count) list.lastElementChild.remove();
    while (list.children.length < count) list.append(this.#buildRow(list.children.length));
    for (const [index, row] of [...list.children].entries()) {
      row.querySelector("input").value = points[index].seconds.toFixed(1);
      row.querySelector("[aria-label$=down]").disabled = index === count - 1;
    }
    list.hidden = !count;
  }

  /** Build the row of a view. @param {number} index */
  #buildRow(index) {
    const { track } = this;
    const { motion, wake } = this.context;
    const name = `view ${index + 1}`;
    const edit = (/** @type {() => void} */ change) => () => {
      change();
      this.playing = null;
      this.#show();
    };
    const goTo = () => {
      motion.moveTo(track.points[index].pose);
      wake();
    };
    const isFirst = index === 0;
    const moment = element("input", { type: "number", min: 0, step: 0.1, disabled: isFirst });
    moment.setAttribute("aria-label", `Seconds of ${name}`);
    moment.addEventListener(
      "change",
      edit(() => track.retime(index, Number(moment.value))),
    );
    const move = (/** @type {number} */ steps) => {
      track.move(index, steps);
      // the focus goes along; at the end of the list, to the button for the way back
      const buttons = row.parentElement.children[index + steps].querySelectorAll("button:enabled");
      [...buttons].at(steps < 0 ? 1 : -2).focus();
    };
    const remove = () => {
      track.remove(index);
      const isLast = row.nextElementSibling === null;
      if (isLast) (row.previousElementSibling?.lastElementChild ?? byId("path-add")).focus();
    };
    const row = element(
      "li",
      {},
      buildButton(String(index + 1), `Go to ${name}`, goTo),
      moment,
      element("span", { textContent: "s" }),
      buildButton("↑", `Move ${name} up`, edit(() => move(-1)), isFirst),
      buildButton("↓", `Move ${name} down`, edit(() => move(1))),
      buildButton("✕", `Delete ${name}`, edit(remove)),
    );
    return row;
  }

  /** Whether the video shows one frame only. */
  get #still() {
    return byId("path-time").value === "still";
  }

  /** Read the size of one eye's images. @param {boolean} [stereo] whether two eyes share the width */
  #readSize(stereo = byId("path-stereo").checked) {
    const [width, height] = byId("path-size").value.split("x").map(Number);
    return { width: stereo ? width / 2 : width, height };
  }

  /**
   * Build the request for a video: its cameras and frames.
   * @param {boolean} stereo whether two eyes share the width
   */
  #buildRequest(stereo = false) {
    const { motion, transport, settings } = this.context;
    const { width, height } = this.#readSize(stereo);
    const box = { left: 0, top: 0, width, height };
    const round = (/** @type {number} */ value) => Number(value.toFixed(6));
    const { moments } = this.track;
    const poses = moments.map((seconds) => {
      const pose = this.track.at(seconds);
      const { R, T } = extrinsicsFromPose(motion.rig, pose);
      const { fx, fy, cx, cy } = lensFromFov(box, box, pose.fov);
      return { R: R.map(round), T: T.map(round), fx: round(fx), fy: round(fy), cx, cy };
    });
    const range = transport.state ?? { first: 0, end: 1 };
    const fps = motion.rig.fps ?? FPS;
    const times = moments.map((seconds) => {
      return this.#still ? transport.shown : this.track.timeAt(seconds, fps, range);
    });
    return {
      poses,
      times,
      fps: FPS,
      width,
      height,
      mode: settings.renderedModes[settings.renderedModes.length - 1],
      error_rule: settings.get("errorRule") || null,
      background: settings.backgroundColour,
      without: settings.excludedCameras,
      model: settings.comparedModel,
      stereo_m: stereo ? EYE_DISTANCE_M : null,
    };
  }

  /** Export the path as a video. */
  async #export() {
    const { notices, films } = this.context;
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
      const video = await film.make(this.#buildRequest(stereo));
      if (video) download(video, stereo ? STEREO_NAME : NAME);
      const seconds = (performance.now() - film.startedAt) / 1000;
      notices.toast(video ? `Video exported (${seconds.toFixed(0)} s)` : "Export cancelled");
    } catch (error) {
      notices.toast(`Export failed: ${/** @type {Error} */ (error).message}`, "error");
    } finally {
      this.film = null;
      this.#show();
    }
  }

  /** Save the path as a file. */
  #save() {
    const text = JSON.stringify(buildPathFile(this.track, this.#buildRequest()), null, 1);
    download(new Blob([text], { type: "application/json" }), "viewmend-path.json");
  }

  /** Open the file that the user has chosen. */
  async #open() {
    const { motion, transport, notices } = this.context;
    const [file] = byId("path-file").files;
    if (!file || !motion.rig || !motion.goal) return;
    try {
      const content = JSON.parse(await file.text());
      const time = Math.max(0, transport.shown);
      const { points, recorded } = readPoints(content, motion.rig, motion.goal.fov, time);
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

/**
 * Build a button whose text is a symbol.
 * @param {string} text
 * @param {string} label
 * @param {() => void} act
 * @param {boolean} [disabled]
 */
function buildButton(text, label, act, disabled = false) {
  const button = element("button", { type: "button", textContent: text, title: label, disabled });
  button.setAttribute("aria-label", label);
  button.addEventListener("click", act);
  return button;
}
