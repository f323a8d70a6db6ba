// The frames that the page can draw itself: requests their assets ahead of time, and keeps those used last.

import { dot, sub, unit } from "../view/matrix.js";

/** @typedef {import("./asset_worker.js").Shape} Shape */
/** @typedef {import("./asset_worker.js").CameraImage} CameraImage */
/** @typedef {{first: number, end: number}} Range indices of the first frame and of the one after the last */

/**
 * @typedef {object} Frame
 * @property {number} time its index
 * @property {Shape | null} shape
 * @property {Map<number, CameraImage>} images by the camera's number
 * @property {Set<number | "mesh">} extras numbers of the completed views that were requested, also those that
 *   the server no longer has; "mesh" for its fused mesh
 * @property {Frame | null} fused the same frame with the mesh that the server fused from predicted depth
 * @property {number} requestedAt ms
 * @property {boolean} failed whether a request that its view needs failed a short time ago
 * @property {Set<number>} lost numbers of other images whose request failed a short time ago
 */

/** This many frames are kept. */
const MAX_FRAMES = 16;
/** This many frames are loaded at a time while playing. */
const MAX_LOADING = 3;
/** This many requests are sent at a time. */
const MAX_REQUESTS = 8;
/** While playing, this many frames beyond the next one that can be in time are requested. */
const AHEAD = 3;
/** As many, where the clock waits for late frames. */
const AHEAD_WAITING = 8;
/** A clock that waits resumes when this many frames are available. */
const RESUME_FRAMES = 4;
/** A frame is expected to take at most this long, in milliseconds. */
const MAX_EXPECTED_MS = 2000;
/** After this many failed frames in a row, the server draws. */
const MAX_FAILURES = 3;
/** A failed frame is requested again after this long, in milliseconds. */
const RETRY_MS = 1000;
/** What the server has completed is remembered for this many frames; a live rig goes on for hours. */
const MAX_COMPLETED = 1000;
/** The weight of the newest frame in the mean latency. */
const NEWEST_WEIGHT = 0.2;

/**
 * Compute the cosine between a camera and the eye, seen from the subject's centre.
 * @param {any} header of a shape
 * @param {number[]} eye
 * @param {number} n the camera's number
 */
export function computeAlignment({ cameras, center }, eye, n) {
  return dot(unit(sub(cameras[n].center, center)), unit(sub(eye, center)));
}

/**
 * Sort the numbers of all cameras by their angle to the eye, seen from the subject's centre.
 * @param {Shape} shape
 * @param {number[]} eye
 * @returns {number[]}
 */
function rankCameras({ header }, eye) {
  const numbers = [...header.cameras.keys()];
  const alignments = numbers.map((n) => computeAlignment(header, eye, n));
  return numbers.sort((a, b) => alignments[b] - alignments[a] || a - b);
}

/**
 * Choose the cameras that colour a view: `first` are those of the blending rule, `fill` those that fill its
 * holes. Completed views are used like cameras that see more, except where the view is shown as rendered.
 * @param {Shape} shape
 * @param {number[]} eye
 * @param {string} mode
 * @param {number} fillers cameras that fill holes
 * @param {(n: number) => boolean} [usable] whether a camera's image may be used
 * @returns {{first: number[], fill: number[]}} numbers of cameras, the closest first
 */
export function chooseCameras(shape, eye, mode, fillers, usable = () => true) {
  const { cameras, blend } = shape.header;
  const ranked = rankCameras(shape, eye).filter(usable);
  const real = ranked.filter((n) => !cameras[n].completed);
  if (mode === "rendered" || mode === "holes") return { first: real.slice(0, blend.cameras), fill: [] };
  const closest = ranked.slice(0, blend.completed.cameras);
  if (closest.some((n) => cameras[n].completed)) {
    return { first: closest, fill: real.filter((n) => !closest.includes(n)).slice(0, blend.cameras) };
  }
  return { first: real.slice(0, blend.cameras), fill: real.slice(blend.cameras, blend.cameras + fillers) };
}

/**
 * Bring an index into the range from 0 to `count` - 1.
 * @param {number} index
 * @param {number} count
 */
const wrapIndex = (index, count) => ((index % count) + count) % count;

/**
 * Name a frame without some cameras, whatever their order.
 * @param {number} time
 * @param {string[]} without
 */
const nameFrame = (time, without) => [time, ...[...without].sort()].join(" ");

/** Whether as many images have arrived as the blending rule needs. @param {Frame} frame */
function isComplete({ shape, images }) {
  return shape !== null && images.size >= Math.min(shape.header.blend.cameras, shape.header.cameras.length);
}

/**
 * Dispatches "change" (detail: the frame) when an asset has arrived, and "dropped" (detail: the frame) when a
 * frame is no longer kept.
 */
export class Assets extends EventTarget {
  /**
   * @param {(path: string, version: string, without: string) => string} locate finds the URL of a shape
   *   ("TIME") or
   *   of an image ("TIME/CAMERA")
   * @param {boolean} [waitsForFrames] whether the clock waits for late frames, and fetched files are cached
   */
  constructor(locate, waitsForFrames = false) {
    super();
    this.locate = locate;
    this.waitsForFrames = waitsForFrames;
    /** Cameras beyond those of the blending rule that fill holes. */
    this.fillers = 0;
    /** The modes that are shown. */
    this.modes = ["completed"];
    /** Whether the clock waits. */
    this.buffering = false;
    /** The version that the message "rig" names; null if the server draws. @type {string | null} */
    this.version = null;
    /** Names of cameras that are not used, separated by commas. */
    this.without = "";
    /** The frames by index; those used last are at the end. @type {Map<number, Frame>} */
    this.frames = new Map();
    /** The position of the view at the last request, in metres. */
    this.eye = [0, 0, 0];
    /** The frame that is shown, which is kept. @type {Frame | null} */
    this.shown = null;
    /** Keys of the requests that have no answer yet. @type {Set<string>} */
    this.pending = new Set();
    /**
     * Assets that the server has made ahead, by frame; see `nameFrame`.
     * @type {Map<string, {cameras: any[], mesh: boolean}>}
     */
    this.completed = new Map();
    this.failures = 0;
    /** Grows when all frames are dropped; answers to requests of an earlier generation are of no use. */
    this.generation = 0;
    this.bytes = 0;
    /** Mean time from the request of a frame until it can be drawn, ms. */
    this.latency = 150;
    /** @type {Worker | null} */
    this.worker = null;
  }

  /** Whether the page can draw the server's frames. */
  get usable() {
    return this.version !== null && this.failures < MAX_FAILURES;
  }

  /** Use the assets of a rig, also after too many frames have failed. @param {any} rig the message */
  open(rig) {
    this.failures = 0;
    if (rig.assets === this.version) return;
    this.#clear();
    this.completed.clear();
    this.version = rig.assets ?? null;
    if (this.version === null || this.worker) return;
    this.worker = new Worker(new URL("./asset_worker.js", import.meta.url), { type: "module" });
    this.worker.onmessage = ({ data }) => this.#take(data);
  }

  /** Use all cameras except some. @param {string} without names, separated by commas */
  exclude(without) {
    if (without === this.without) return;
    this.without = without;
    this.failures = 0;
    this.#clear();
  }

  /** Drop everything. */
  close() {
    this.#clear();
    this.worker?.terminate();
    this.worker = null;
    this.version = null;
  }

  #clear() {
    this.shown = null;
    for (const frame of this.frames.values()) this.#drop(frame);
    this.pending.clear();
    this.generation += 1;
  }

  /**
   * Choose the frame to draw: the one at `time`, or the last one before it that is available.
   * @param {number} time
   * @param {number[]} eye
   * @param {Range} range
   * @param {number} maxDelay frames that the chosen one may be behind
   * @returns {Frame | null}
   */
  choose(time, eye, { first, end }, maxDelay) {
    const count = Math.max(1, end - first);
    for (let delay = 0; delay <= Math.min(maxDelay, count - 1); delay++) {
      const frame = this.frames.get(first + wrapIndex(time - delay - first, count));
      if (frame && this.isDrawable(frame, eye)) {
        this.#markUsed(frame);
        return frame;
      }
    }
    return null;
  }

  /**
   * Whether all assets that the blending rule needs have arrived.
   * @param {Frame} frame
   * @param {number[]} eye
   */
  isDrawable(frame, eye) {
    return frame.shape !== null && this.findNeededCameras(frame, eye).every((n) => frame.images.has(n));
  }

  /**
   * Whether the images that fill the holes of what is shown have arrived, too.
   * @param {Frame} frame that is drawable
   * @param {number[]} eye
   */
  isFilled({ shape, images }, eye) {
    return this.#listWantedCameras(/** @type {Shape} */ (shape), eye, true).every((n) => images.has(n));
  }

  /**
   * Find the numbers of the cameras that colour what is shown.
   * @param {Frame} frame whose shape has arrived
   * @param {number[]} eye
   * @returns {number[]}
   */
  findNeededCameras({ shape }, eye) {
    const numbers = this.modes.map((mode) => {
      return chooseCameras(/** @type {Shape} */ (shape), eye, mode, this.fillers).first;
    });
    return [...new Set(numbers.flat())];
  }

  /**
   * Decide whether playback waits at a frame. Once it does, it waits until some of the next frames are
   * available.
   * @param {number} time
   * @param {number[]} eye
   * @param {Range} range
   */
  updateBuffering(time, eye, { first, end }) {
    const count = Math.max(1, end - first);
    const ahead = this.buffering ? Math.min(count, RESUME_FRAMES) : 1;
    const frames = Array.from({ length: ahead }, (_, step) => {
      return this.frames.get(first + ((time - first + step) % count));
    });
    this.buffering = !frames.every((frame) => frame && this.isDrawable(frame, eye));
    return this.buffering;
  }

  /**
   * Request missing assets: first the rest of frames that are partly loaded and still of use, then the next
   * ones.
   * @param {number} time
   * @param {number[]} eye
   * @param {Range} range
   * @param {{playing: boolean, framesPerMs: number, live: boolean}} clock the next frames of a live rig
   *   cannot be
   *   requested
   */
  request(time, eye, { first, end }, { playing, framesPerMs, live }) {
    this.eye = eye;
    const count = Math.max(1, end - first);
    const playsAhead = playing && !live;
    // frames that would arrive too late
    const late = playing && !this.waitsForFrames ? Math.ceil(framesPerMs * this.#expectLatency()) : 0;
    const maxAhead = (this.waitsForFrames ? AHEAD_WAITING : AHEAD) + late;
    const ahead = playsAhead && !this.#loadsFirstFrame ? Math.min(count - 1, maxAhead) : 0;

    // complete the frames that are partly loaded
    let loading = 0;
    for (const frame of this.frames.values()) {
      const steps = wrapIndex(frame.time - time, count);
      const useful = steps <= ahead || (playing && count - steps <= AHEAD + 2 * late);
      if (useful && !frame.failed && !this.#load(frame, eye, playing)) loading += 1;
      else if (!useful && !isComplete(frame)) this.#drop(frame);
    }

    // begin the next ones
    const maxLoading = playsAhead ? MAX_LOADING : 1;
    for (let step = 0; step <= ahead && loading < maxLoading; step++) {
      const index = first + ((time - first + step) % count);
      const tooLate = ahead && step < late && loading > 0;
      if (this.frames.has(index) || tooLate) continue;
      this.#load(this.#add(index), eye, playing);
      loading += 1;
    }
  }

  /** Whether nothing was shown yet and the clock waits: the first frame is loaded alone. */
  get #loadsFirstFrame() {
    return this.waitsForFrames && this.shown === null;
  }

  /** Estimate how long the next frame will take, in milliseconds. */
  #expectLatency() {
    const now = performance.now();
    let longest = this.latency;
    for (const frame of this.frames.values()) {
      if (!isComplete(frame)) longest = Math.max(longest, now - frame.requestedAt);
    }
    return Math.min(MAX_EXPECTED_MS, longest);
  }

  /**
   * Request the missing assets of a frame.
   * @param {Frame} frame
   * @param {number[]} eye
   * @param {boolean} playing
   * @returns {boolean} whether none is missing
   */
  #load(frame, eye, playing) {
    const { shape, images, lost, time } = frame;
    if (!shape) {
      this.#requestAsset(`${time}`, null);
      return false;
    }
    const drawsFirst = (!playing || this.#loadsFirstFrame) && !this.isDrawable(frame, eye);
    const wanted = drawsFirst
      ? this.findNeededCameras(frame, eye)
      : this.#listWantedCameras(shape, eye, playing);
    const missing = [...new Set(wanted)].filter((n) => !images.has(n) && !lost.has(n));
    for (const n of missing) this.#requestAsset(`${time}/${n}`, shape.header.cameras[n]);
    if (missing.length === 0) this.#loadExtra(frame, eye);
    return missing.length === 0;
  }

  /**
   * List the cameras that colour what is shown or fill its holes while playing, or all cameras at rest.
   * @param {Shape} shape
   * @param {number[]} eye
   * @param {boolean} playing
   */
  #listWantedCameras(shape, eye, playing) {
    if (!playing) return rankCameras(shape, eye);
    return this.modes.flatMap((mode) => {
      const { first, fill } = chooseCameras(shape, eye, mode, this.fillers);
      return [...first, ...fill];
    });
  }

  /**
   * Take the message that the server has completed views, or the mesh, of a frame.
   * @param {{time: number, without: string[], cameras: any[], mesh: boolean}} message
   */
  addCompleted({ time, without, cameras, mesh }) {
    const name = nameFrame(time, without);
    this.completed.delete(name); // the newest are at the end
    this.completed.set(name, { cameras, mesh });
    const [oldest] = this.completed.keys();
    if (this.completed.size > MAX_COMPLETED) this.completed.delete(oldest);
    this.dispatchEvent(new CustomEvent("change", { detail: undefined }));
  }

  /** Find what the server has completed of a frame. @param {Frame} frame */
  #findCompleted({ time }) {
    const name = nameFrame(time, this.without.split(",").filter(Boolean));
    return this.completed.get(name) ?? { cameras: [], mesh: false };
  }

  /**
   * Request the fused mesh or, after it, the completed view that is closest to the eye, once all else has
   * arrived.
   * @param {Frame} frame
   * @param {number[]} eye
   */
  #loadExtra(frame, eye) {
    if (this.pending.size) return;
    const { cameras, mesh } = this.#findCompleted(frame);
    if (mesh && !frame.extras.has("mesh")) {
      this.#requestAsset(`${frame.time}/mesh`, null);
      return;
    }
    const missing = cameras.filter(({ number }) => !frame.extras.has(number));
    if (!missing.length) return;
    const { center } = /** @type {Shape} */ (frame.shape).header;
    const alignments = missing.map((_, n) => computeAlignment({ cameras: missing, center }, eye, n));
    const closest = missing[alignments.indexOf(Math.max(...alignments))];
    this.#requestAsset(`${frame.time}/${closest.number}`, closest);
  }

  /** @param {string} path @param {any} camera */
  #requestAsset(path, camera) {
    const key = `${this.generation} ${path}`;
    if (this.pending.has(key) || this.pending.size >= MAX_REQUESTS) return;
    this.pending.add(key);
    const url = this.locate(path, this.version ?? "", this.without);
    this.worker?.postMessage({ key, url, camera, keep: this.waitsForFrames });
  }

  /**
   * Add a frame, and drop the ones used least recently.
   * @param {number} time
   * @returns {Frame}
   */
  #add(time) {
    /** @type {Frame} */
    const frame = {
      time,
      shape: null,
      images: new Map(),
      extras: new Set(),
      fused: null,
      requestedAt: performance.now(),
      failed: false,
      lost: new Set(),
    };
    this.frames.set(time, frame);
    for (const oldest of this.frames.values()) {
      if (this.frames.size > MAX_FRAMES) this.#drop(oldest);
    }
    return frame;
  }

  /** Drop a frame unless it is shown. @param {Frame} frame */
  #drop(frame) {
    if (frame === this.shown) return;
    this.frames.delete(frame.time);
    this.dispatchEvent(new CustomEvent("dropped", { detail: frame }));
    for (const { picture } of frame.images.values()) picture.close();
    frame.images.clear();
  }

  /** Move a frame to the end, where those used last are. @param {Frame} frame */
  #markUsed(frame) {
    this.frames.delete(frame.time);
    this.frames.set(frame.time, frame);
  }

  /** Take an answer of the worker. @param {import("./asset_worker.js").Result} result */
  #take(result) {
    const { key, shape, image, bytes } = result;
    this.pending.delete(key);
    const [generation, path] = key.split(" ");
    const [time, part] = path.split("/");
    const frame = Number(generation) === this.generation ? this.frames.get(Number(time)) : undefined;
    if (frame) this.#store(frame, part, result);
    else image?.picture.close();
    if (frame && !frame.failed) {
      this.failures = shape || image ? 0 : this.failures;
      this.bytes += bytes ?? 0;
      if (image && frame.images.size === frame.shape?.header.blend.cameras) {
        this.latency += NEWEST_WEIGHT * (performance.now() - frame.requestedAt - this.latency);
      }
    }
    this.dispatchEvent(new CustomEvent("change", { detail: frame }));
  }

  /**
   * Store an asset in its frame.
   * @param {Frame} frame
   * @param {string | undefined} part the camera's number, "mesh", or undefined for the shape
   * @param {import("./asset_worker.js").Result} result
   */
  #store(frame, part, { shape, image, failed }) {
    const number = Number(part);
    const completed = this.#findCompleted(frame).cameras.find((camera) => camera.number === number);
    if (part === "mesh") {
      this.#storeMesh(frame, shape);
    } else if (completed) {
      frame.extras.add(number);
      if (!image) return;
      const { cameras } = /** @type {Shape} */ (frame.shape).header;
      cameras.push(completed);
      frame.images.set(cameras.length - 1, image);
    } else if (shape) {
      frame.shape = shape;
    } else if (image) {
      frame.images.set(number, image);
    } else if (failed !== undefined) {
      this.#fail(frame, number);
    }
  }

  /**
   * Store the fused mesh of a frame, which is drawn where completed views are shown.
   * @param {Frame} frame
   * @param {Shape | undefined} mesh undefined if the server no longer has it
   */
  #storeMesh(frame, mesh) {
    frame.extras.add("mesh");
    if (!mesh || !frame.shape) return;
    const header = { ...frame.shape.header, ...mesh.header };
    frame.fused = { ...frame, shape: { ...mesh, header } };
  }

  /**
   * Try an asset again later. A frame counts as failed once, however many of the assets fail that its view
   * needs.
   * @param {Frame} frame
   * @param {number} number of the camera
   */
  #fail(frame, number) {
    const needed = !frame.shape || this.findNeededCameras(frame, this.eye).includes(number);
    if (needed && frame.failed) return;
    if (needed) {
      frame.failed = true;
      this.failures += 1;
    } else {
      frame.lost.add(number);
    }
    setTimeout(() => {
      if (this.frames.get(frame.time) === frame && !frame.shape) this.frames.delete(frame.time);
      if (needed) frame.failed = false;
      frame.lost.delete(number);
      this.dispatchEvent(new CustomEvent("change", { detail: frame }));
    }, RETRY_MS);
  }
}
