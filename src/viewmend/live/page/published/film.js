// A video that the page draws and encodes itself, frame by frame.

import { Stage } from "../draw/stage.js";
import { Assets } from "../link/assets.js";
import { eyeFromExtrinsics } from "../view/pose.js";
import { writeMp4 } from "./mp4.js";

/** The codecs to try, in this order. */
const CODECS = [
  { codec: "avc1.640028", avc: { format: "avc" } },
  { codec: "avc1.42E028", avc: { format: "avc" } },
  { codec: "vp09.00.40.08" },
];
/** The bits per pixel; losses are hardly visible for views on a plain background. */
const BITS_PER_PIXEL = 0.12;
/** One frame out of this many is a key frame. */
const KEY_INTERVAL = 60;
/** At most this many frames wait for the encoder. */
const MAX_QUEUED = 4;
/** A full encoder is checked at this interval, in milliseconds. */
const ENCODER_POLL_MS = 5;
/** The files of a frame are checked at this interval, in milliseconds. */
const FRAME_POLL_MS = 10;
/** The video fails if the files of a frame do not arrive within this time, in milliseconds. */
const TIMEOUT_MS = 30000;

/** @param {number} ms */
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** @param {{width: number, height: number, fps: number}} size @returns {Promise<VideoEncoderConfig>} */
async function chooseConfig({ width, height, fps }) {
  if (typeof VideoEncoder === "undefined") {
    throw new Error("this browser cannot encode video here; open the page over https in a current browser");
  }
  const bitrate = Math.round(BITS_PER_PIXEL * width * height * fps);
  for (const codec of CODECS) {
    const config = /** @type {any} */ ({ ...codec, width, height, framerate: fps, bitrate });
    const support = await VideoEncoder.isConfigSupported(config).catch(() => null);
    if (support?.supported) return config;
  }
  throw new Error("this browser encodes neither H.264 nor VP9");
}

/** Copy bytes that are given as a buffer, or as a view of one. @param {any} source */
function copyBytes(source) {
  if (!ArrayBuffer.isView(source)) return new Uint8Array(source);
  const { buffer, byteOffset, byteLength } = source;
  return new Uint8Array(buffer.slice(byteOffset, byteOffset + byteLength));
}

export class CanvasFilm {
  /**
   * @param {(path: string, version: string) => string} locate finds the URL of an asset
   * @param {() => any} getScene returns the content of scene.json
   * @param {(progress: {part: number, text: string}) => void} onProgress
   */
  constructor(locate, getScene, onProgress) {
    this.locate = locate;
    this.getScene = getScene;
    this.onProgress = onProgress;
    this.startedAt = performance.now();
    this.stopped = false;
  }

  cancel() {
    this.stopped = true;
  }

  /**
   * Render the video.
   * @param {any} request cameras and frames, as a server accepts them
   * @returns {Promise<Blob | null>} null if it was cancelled
   */
  async make(request) {
    const { poses, times, width, height, fps, mode, background } = request;
    const config = await chooseConfig(request);

    // a canvas and assets of its own
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const stage = new Stage(canvas);
    const assets = new Assets(this.locate, true);
    assets.fillers = stage.scene.fillers;
    assets.modes = [mode];
    assets.open(this.getScene().rig);

    // an encoder that collects its frames
    /** @type {{bytes: Uint8Array, key: boolean}[]} */
    const samples = [];
    /** @type {Uint8Array | null} */
    let description = null;
    /** @type {Error | null} */
    let failure = null;
    const encoder = new VideoEncoder({
      output: (chunk, metadata) => {
        const bytes = new Uint8Array(chunk.byteLength);
        chunk.copyTo(bytes);
        samples.push({ bytes, key: chunk.type === "key" });
        const newDescription = metadata?.decoderConfig?.description;
        if (newDescription) description = copyBytes(newDescription);
      },
      error: (error) => (failure = error),
    });

    // draw and encode each frame
    try {
      encoder.configure(config);
      for (let n = 0; n < poses.length && !this.stopped; n++) {
        const { R, T, ...lens } = poses[n];
        const viewer = { R, T, lens: { ...lens, width, height } };
        const frame = await this.#loadFrame(assets, times[n], eyeFromExtrinsics(viewer));
        while (encoder.encodeQueueSize > MAX_QUEUED && !failure) await sleep(ENCODER_POLL_MS);
        if (failure) throw failure;
        stage.clear(background);
        const options = { parts: [{ mode, until: 1 }], reproject: false, rig: null, frame };
        stage.draw(viewer, [0, 0, width, height], options);
        const image = new VideoFrame(canvas, { timestamp: Math.round((1e6 * n) / fps) });
        encoder.encode(image, { keyFrame: n % KEY_INTERVAL === 0 });
        image.close();
        this.onProgress({ part: (n + 1) / poses.length, text: `${n + 1} of ${poses.length} views` });
      }
      if (this.stopped) return null;
      await encoder.flush();
      if (failure) throw failure;
    } finally {
      if (encoder.state !== "closed") encoder.close();
      assets.close();
      stage.gl.getExtension("WEBGL_lose_context")?.loseContext();
    }
    const file = writeMp4(samples, { width, height, fps, codec: config.codec, description });
    return new Blob([/** @type {any} */ (file)], { type: "video/mp4" });
  }

  /**
   * Wait for a frame with all that its view needs; null if the video was cancelled.
   * @param {Assets} assets
   * @param {number} time
   * @param {number[]} eye
   */
  async #loadFrame(assets, time, eye) {
    const range = { first: 0, end: this.getScene().frames };
    const deadline = performance.now() + TIMEOUT_MS;
    while (!this.stopped) {
      assets.request(time, eye, range, { playing: true, framesPerMs: 0, live: false });
      const frame = assets.choose(time, eye, range, 0);
      if (frame) assets.shown = frame;
      if (frame && assets.isFilled(frame, eye)) return frame;
      if (performance.now() > deadline || !assets.usable) {
        throw new Error("files of the performance are out of reach");
      }
      await sleep(FRAME_POLL_MS);
    }
    return null;
  }
}
