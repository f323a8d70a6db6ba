// Which frames the page can draw by itself: asks for their assets ahead of time, and keeps those used last.

import { dot, sub, unit } from "../view/matrix.js";

/** @typedef {import("./asset_worker.js").Shape} Shape */
/** @typedef {import("./asset_worker.js").CameraImage} CameraImage */

/**
 * @typedef {object} Frame
 * @property {number} time its index
 * @property {Shape | null} shape
 * @property {Map<number, CameraImage>} images by the camera's number
 * @property {Set<number | "mesh">} extended numbers of the server's completed views that are there, or that it does not have any more; "mesh" for its fused mesh
 * @property {Frame | null} refined the same frame with the mesh that the server fused from predicted depth
 * @property {number} since when it was asked for, ms
 * @property {boolean} failed
 */

/** Frames that are kept, frames that are asked for at a time, and requests at a time. */
const [KEPT, LOADING, REQUESTS] = [16, 3, 8];
/** Frames beyond the next that would be in time that are asked for while playing, and the longest time that one may take. */
const [AHEAD, MOST_MS] = [3, 2000];
/** Failed frames in a row after which the server draws. */
const MOST_FAILURES = 3;

/** Frames beyond the next that are asked for where the clock waits for late frames, and those that end the wait. */
const [AHEAD_PATIENT, RESUMING] = [8, 4];

/** The cosine between a camera and the eye, seen from the subject's centre. @param {any} header of a shape @param {number[]} eye @param {number} n the camera's number */
export const nearness = ({ cameras, center }, eye, n) => dot(unit(sub(cameras[n].center, center)), unit(sub(eye, center)));

/** All cameras' numbers by their angle to the eye, seen from the subject's centre. @param {Shape} shape @param {number[]} eye @returns {number[]} */
export function rankedCameras({ header: { cameras, center } }, eye) {
  const near = cameras.map((/** @type {any} */ _, /** @type {number} */ n) => nearness({ cameras, center }, eye, n));
  return cameras.map((/** @type {any} */ _, /** @type {number} */ n) => n)
    .sort((/** @type {number} */ a, /** @type {number} */ b) => near[b] - near[a] || a - b);
}

/**
 * The cameras that colour a view: `first` the ones that the blending rule names, `fill` those that fill its holes. Completed
 * views are used like cameras that see more, except where the view is shown as rendered.
 * @param {Shape} shape @param {number[]} eye @param {string} mode @param {number} fillers cameras that fill holes
 * @param {(n: number) => boolean} [usable] whether a camera's image may be used
 * @returns {{first: number[], fill: number[]}} cameras' numbers, the closest first
 */
export function sourcesOf(shape, eye, mode, fillers, usable = () => true) {
  const { cameras, blend } = shape.header;
  const ranked = rankedCameras(shape, eye).filter(usable);
  const real = ranked.filter((n) => !cameras[n].completed);
  if (mode === "rendered" || mode === "holes") return { first: real.slice(0, blend.cameras), fill: [] };
  const closest = ranked.slice(0, blend.completed.cameras);
  if (closest.some((n) => cameras[n].completed)) {
    return { first: closest, fill: real.filter((n) => !closest.includes(n)).slice(0, blend.cameras) };
  }
  return { first: real.slice(0, blend.cameras), fill: real.slice(blend.cameras, blend.cameras + fillers) };
}

/** The name of a frame without some cameras, whatever their order. @param {number} time @param {string[]} without */
const named = (time, without) => [time, ...[...without].sort()].join(" ");

/** Whether as many images are there as the blending rule needs. @param {Frame} frame */
const complete = ({ shape, images }) => shape !== null && images.size >= Math.min(shape.header.blend.cameras, shape.header.cameras.length);

/** Dispatches "change" (detail: the frame) when something has arrived, and "dropped" (detail: the frame) when a frame is let go. */
export class Assets extends EventTarget {
  /**
   * @param {(path: string, version: string, without: string) => string} locate the address of a shape ("TIME") or an image ("TIME/CAMERA")
   * @param {boolean} [patient] whether the clock waits for late frames, and files that were fetched are kept
   */
  constructor(locate, patient = false) {
    super();
    this.locate = locate;
    this.patient = patient;
    /** Cameras of a playing frame beyond the blending rule's. */
    this.fillers = 0;
    /** What is shown. */
    this.modes = ["completed"];
    /** Whether the clock waits. */
    this.buffering = false;
    /** The version that the server's message `rig` names; null if the server draws. @type {string | null} */
    this.version = null;
    /** Names of cameras that are not used, separated by commas. */
    this.without = "";
    /** @type {Map<number, Frame>} the one used last at the end */
    this.frames = new Map();
    /** The frame that is shown: it is kept. @type {Frame | null} */
    this.shown = null;
    /** @type {Set<string>} */
    this.waiting = new Set();
    /** What the server has made ahead, by frame: see `named`. @type {Map<string, {cameras: any[], mesh: boolean}>} */
    this.completed = new Map();
    this.failures = 0;
    /** Grows when all frames are let go of: what was asked for before is of no use. */
    this.round = 0;
    this.bytes = 0;
    /** Time from asking for a frame until it can be drawn, ms. */
    this.latency = 150;
    /** @type {Worker | null} */
    this.worker = null;
  }

  /** Whether the server's frames can be drawn here. */
  get usable() {
    return this.version !== null && this.failures < MOST_FAILURES;
  }

  /** @param {any} rig the message */
  open(rig) {
    if (rig.assets === this.version) return;
    this.#clear();
    this.completed.clear();
    this.version = rig.assets ?? null;
    this.failures = 0;
    if (this.version === null || this.worker) return;
    this.worker = new Worker(new URL("./asset_worker.js", import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }) => this.#take(data);
  }

  /** Frames of all cameras but some. @param {string} without names, separated by commas */
  leaveOut(without) {
    if (without === this.without) return;
    this.without = without;
    this.failures = 0;
    this.#clear();
  }

  /** Let go of everything. */
  close() {
    this.#clear();
    this.worker?.terminate();
    this.worker = null;
    this.version = null;
  }

  #clear() {
    this.shown = null;
    for (const frame of this.frames.values()) this.#forget(frame);
    this.waiting.clear();
    this.round += 1;
  }

  /**
   * The frame to draw: the one at `time`, or the last before it that is there.
   * @param {number} time @param {number[]} eye @param {{first: number, end: number}} range @param {number} late frames that it may be behind
   * @returns {Frame | null}
   */
  choose(time, eye, { first, end }, late) {
    const count = Math.max(1, end - first);
    for (let back = 0; back <= Math.min(late, count - 1); back++) {
      const frame = this.frames.get(first + ((((time - back - first) % count) + count) % count));
      if (frame && this.drawable(frame, eye)) return this.#touch(frame);
    }
    return null;
  }

  /** Whether all that the blending rule needs is there. @param {Frame} frame @param {number[]} eye */
  drawable(frame, eye) {
    return frame.shape !== null && this.needed(frame, eye).every((n) => frame.images.has(n));
  }

  /** The cameras' numbers that colour what is shown. @param {Frame} frame whose shape is there @param {number[]} eye @returns {number[]} */
  needed({ shape }, eye) {
    const used = this.modes.map((mode) => sourcesOf(/** @type {Shape} */ (shape), eye, mode, this.fillers).first);
    return [...new Set(used.flat())];
  }

  /** Whether playback has to wait at a frame: once it does, until some of the next ones are there, too. @param {number} time @param {number[]} eye @param {{first: number, end: number}} range */
  buffers(time, eye, { first, end }) {
    const count = Math.max(1, end - first);
    const ahead = this.buffering ? Math.min(count, RESUMING) : 1;
    const frames = Array.from({ length: ahead }, (_, step) => this.frames.get(first + ((time - first + step) % count)));
    this.buffering = !frames.every((frame) => frame && this.drawable(frame, eye));
    return this.buffering;
  }

  /**
   * Ask for what is missing: first for the rest of frames that were begun and are still of use, then for the next ones.
   * @param {number} time @param {number[]} eye @param {{first: number, end: number}} range
   * @param {{playing: boolean, framesPerMs: number, live: boolean}} clock a live rig's next frames cannot be asked for
   */
  want(time, eye, { first, end }, { playing, framesPerMs, live }) {
    const count = Math.max(1, end - first);
    const late = playing && !this.patient ? Math.ceil(framesPerMs * this.#expected()) : 0;
    const ahead = playing && !live && !this.#begins ? Math.min(count - 1, (this.patient ? AHEAD_PATIENT : AHEAD) + late) : 0;
    const steps = (/** @type {Frame} */ frame) => (((frame.time - time) % count) + count) % count;
    let loading = 0;
    for (const frame of this.frames.values()) {
      const useful = steps(frame) <= ahead || (playing && count - steps(frame) <= AHEAD + 2 * late);
      if (useful && !frame.failed && !this.#load(frame, eye, playing)) loading += 1;
      else if (!useful && !complete(frame)) this.#forget(frame);
    }
    for (let step = 0; step <= ahead && loading < (playing && !live ? LOADING : 1); step++) {
      const index = first + ((time - first + step) % count);
      if (this.frames.has(index) || (ahead && step < late && loading > 0)) continue; // known, or it would come too late
      this.#load(this.#add(index), eye, playing);
      loading += 1;
    }
  }

  /** Whether nothing was shown yet, and the clock waits: the first picture shares the line with nothing else. */
  get #begins() {
    return this.patient && this.shown === null;
  }

  /** How long the next frame will probably take, ms. */
  #expected() {
    const now = performance.now();
    let longest = this.latency;
    for (const frame of this.frames.values()) if (!complete(frame)) longest = Math.max(longest, now - frame.since);
    return Math.min(MOST_MS, longest);
  }

  /** Ask for a frame's missing parts. @param {Frame} frame @param {number[]} eye @param {boolean} playing @returns {boolean} whether all is there */
  #load(frame, eye, playing) {
    const { shape, images, time } = frame;
    if (!shape) {
      this.#ask(`${time}`, null);
      return false;
    }
    const played = this.modes.map((mode) => sourcesOf(shape, eye, mode, this.fillers));
    const wanted = playing ? played.flatMap(({ first, fill }) => [...first, ...fill]) : rankedCameras(shape, eye);
    const drawsFirst = (!playing || this.#begins) && !this.drawable(frame, eye);
    const missing = [...new Set(drawsFirst ? this.needed(frame, eye) : wanted)].filter((n) => !images.has(n));
    for (const n of missing) this.#ask(`${time}/${n}`, shape.header.cameras[n]);
    if (missing.length === 0) this.#extend(frame, eye);
    return missing.length === 0;
  }

  /** Completed views and the mesh of a frame that the server has made. @param {{time: number, without: string[], cameras: any[], mesh: boolean}} message */
  offer({ time, without, cameras, mesh }) {
    this.completed.set(named(time, without), { cameras, mesh });
    this.dispatchEvent(new CustomEvent("change", { detail: undefined }));
  }

  /** What is offered of a frame. @param {Frame} frame */
  #offers({ time }) {
    return this.completed.get(named(time, this.without.split(",").filter(Boolean))) ?? { cameras: [], mesh: false };
  }

  /** Ask for the fused mesh, then for the completed view that is closest to the eye, of those that are missing, once all else is there. @param {Frame} frame @param {number[]} eye */
  #extend(frame, eye) {
    if (this.waiting.size) return;
    const { cameras, mesh } = this.#offers(frame);
    if (mesh && !frame.extended.has("mesh")) {
      this.#ask(`${frame.time}/mesh`, null);
      return;
    }
    const missing = cameras.filter(({ number }) => !frame.extended.has(number));
    if (!missing.length) return;
    const { center } = /** @type {Shape} */ (frame.shape).header;
    const near = missing.map((_, n) => nearness({ cameras: missing, center }, eye, n));
    const closest = missing[near.indexOf(Math.max(...near))];
    this.#ask(`${frame.time}/${closest.number}`, closest);
  }

  /** @param {string} path @param {any} camera */
  #ask(path, camera) {
    const key = `${this.round} ${path}`;
    if (this.waiting.has(key) || this.waiting.size >= REQUESTS) return;
    this.waiting.add(key);
    const url = this.locate(path, this.version ?? "", this.without);
    this.worker?.postMessage({ key, url, camera, keeps: this.patient });
  }

  /** @param {number} time @returns {Frame} */
  #add(time) {
    /** @type {Frame} */
    const frame = { time, shape: null, images: new Map(), extended: new Set(), refined: null, since: performance.now(), failed: false };
    this.frames.set(time, frame);
    for (const old of this.frames.values()) if (this.frames.size > KEPT) this.#forget(old);
    return frame;
  }

  /** @param {Frame} frame */
  #forget(frame) {
    if (frame === this.shown) return;
    this.frames.delete(frame.time);
    this.dispatchEvent(new CustomEvent("dropped", { detail: frame }));
    for (const { picture } of frame.images.values()) picture.close();
    frame.images.clear();
  }

  /** @param {Frame} frame */
  #touch(frame) {
    this.frames.delete(frame.time);
    this.frames.set(frame.time, frame);
    return frame;
  }

  /** @param {import("./asset_worker.js").News} news */
  #take({ key, shape, image, bytes, failed }) {
    this.waiting.delete(key);
    const [round, path] = key.split(" ");
    const [time, part] = path.split("/");
    const camera = Number(part);
    const frame = Number(round) === this.round ? this.frames.get(Number(time)) : undefined;
    const offered = frame && this.#offers(frame).cameras.find(({ number }) => number === camera);
    if (!frame) image?.picture.close();
    else if (part === "mesh") this.#refine(frame, shape);
    else if (offered) {
      frame.extended.add(camera);
      if (image) frame.images.set(/** @type {Shape} */ (frame.shape).header.cameras.push(offered) - 1, image);
    } else if (shape) frame.shape = shape;
    else if (image) frame.images.set(camera, image);
    else if (failed !== undefined) this.#fail(frame);
    if (frame && !frame.failed) {
      this.failures = shape ? 0 : this.failures;
      this.bytes += bytes ?? 0;
      if (image && frame.images.size === frame.shape?.header.blend.cameras) {
        this.latency += 0.2 * (performance.now() - frame.since - this.latency);
      }
    }
    this.dispatchEvent(new CustomEvent("change", { detail: frame }));
  }

  /** Keep a frame's fused mesh, which is drawn where completed views are shown. @param {Frame} frame @param {Shape | undefined} mesh undefined if the server does not have it any more */
  #refine(frame, mesh) {
    frame.extended.add("mesh");
    if (!mesh || !frame.shape) return;
    const header = { ...frame.shape.header, ...mesh.header };
    frame.refined = { ...frame, shape: { ...mesh, header } };
  }

  /** It is tried again when it is wanted the next time round. @param {Frame} frame */
  #fail(frame) {
    frame.failed = true;
    this.failures += 1;
    setTimeout(() => {
      if (this.frames.get(frame.time) === frame && !frame.shape) this.frames.delete(frame.time);
      frame.failed = false;
    }, 1000);
  }
}
