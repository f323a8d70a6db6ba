// A film that the page draws and encodes by itself, frame by frame.

import { Stage } from "../draw/stage.js";
import { Assets } from "../link/assets.js";
import { eyeOfCamera } from "../view/pose.js";
import { mp4 } from "./mp4.js";

/** Codecs to try, and the name that each has in a file. */
const CODECS = [
  { codec: "avc1.640028", avc: { format: "avc" } },
  { codec: "avc1.42E028", avc: { format: "avc" } },
  { codec: "vp09.00.40.08" },
];
/** Bits a pixel: hardly visible losses for views on a plain background. */
const BITS_PER_PIXEL = 0.12;
const KEY_FRAMES = 60;
/** Frames that may wait for the encoder. */
const MOST_WAITING = 4;
/** The longest time without a frame's files. */
const LOST_MS = 30000;

/** @param {{width: number, height: number, fps: number}} size @returns {Promise<VideoEncoderConfig>} */
async function chosenConfig({ width, height, fps }) {
  if (typeof VideoEncoder === "undefined") throw new Error("this browser cannot encode video here; open the page over https in a current browser");
  for (const kind of CODECS) {
    const config = /** @type {any} */ ({ ...kind, width, height, framerate: fps, bitrate: Math.round(BITS_PER_PIXEL * width * height * fps) });
    const answer = await VideoEncoder.isConfigSupported(config).catch(() => null);
    if (answer?.supported) return config;
  }
  throw new Error("this browser encodes neither H.264 nor VP9");
}

export class CanvasFilm {
  /** @param {(path: string) => string} locate @param {() => any} scene what scene.json says @param {(progress: {part: number, text: string}) => void} onProgress */
  constructor(locate, scene, onProgress) {
    this.locate = locate;
    this.scene = scene;
    this.onProgress = onProgress;
    this.since = performance.now();
    this.stopped = false;
  }

  cancel() {
    this.stopped = true;
  }

  /** @param {any} request cameras and times, as a server takes them @returns {Promise<Blob | null>} null where it was called off */
  async make(request) {
    const { poses, times, width, height, fps, mode, background } = request;
    const config = await chosenConfig(request);
    const canvas = Object.assign(document.createElement("canvas"), { width, height });
    const stage = new Stage(canvas);
    const assets = new Assets(this.locate, true);
    assets.fillers = stage.scene.fillers;
    assets.modes = [mode];
    assets.open(this.scene().rig);
    /** @type {{bytes: Uint8Array, key: boolean}[]} */
    const samples = [];
    let [description, failure] = [/** @type {Uint8Array | null} */ (null), /** @type {Error | null} */ (null)];
    const encoder = new VideoEncoder({
      output: (chunk, about) => {
        const bytes = new Uint8Array(chunk.byteLength);
        chunk.copyTo(bytes);
        samples.push({ bytes, key: chunk.type === "key" });
        const given = about?.decoderConfig?.description;
        if (given) description = new Uint8Array(ArrayBuffer.isView(given) ? given.buffer.slice(given.byteOffset, given.byteOffset + given.byteLength) : given);
      },
      error: (error) => (failure = error),
    });
    try {
      encoder.configure(config);
      for (let n = 0; n < poses.length && !this.stopped; n++) {
        const { R, T, ...lens } = poses[n];
        const viewer = { R, T, lens: { ...lens, width, height } };
        const frame = await this.#frame(assets, times[n], eyeOfCamera(viewer));
        while (encoder.encodeQueueSize > MOST_WAITING && !failure) await new Promise((resolve) => setTimeout(resolve, 5));
        if (failure) throw failure;
        stage.clear(background);
        stage.draw(viewer, [0, 0, width, height], { parts: [{ mode, until: 1 }], reproject: false, rig: null, frame });
        const picture = new VideoFrame(canvas, { timestamp: Math.round((1e6 * n) / fps) });
        encoder.encode(picture, { keyFrame: n % KEY_FRAMES === 0 });
        picture.close();
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
    return new Blob([/** @type {any} */ (mp4(samples, { width, height, fps, codec: config.codec, description }))], { type: "video/mp4" });
  }

  /** A frame with all that its view needs. @param {Assets} assets @param {number} time @param {number[]} eye */
  async #frame(assets, time, eye) {
    const range = { first: 0, end: this.scene().frames };
    const until = performance.now() + LOST_MS;
    while (!this.stopped) {
      assets.want(time, eye, range, { playing: true, framesPerMs: 0, live: false });
      const found = assets.choose(time, eye, range, 0);
      if (found) {
        assets.shown = found;
        return found;
      }
      if (performance.now() > until || !assets.usable) throw new Error("files of the performance are out of reach");
      await new Promise((resolve) => setTimeout(resolve, 10));
    }
    return null;
  }
}
