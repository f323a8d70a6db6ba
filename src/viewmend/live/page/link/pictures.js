// Decodes JPEGs and video streams to images that WebGL accepts as textures.

/** @typedef {ImageBitmap | VideoFrame} Picture call `close()` after it was uploaded */

/** The video codecs of the server, and the strings that browsers know them by. */
const CANDIDATES = { vp9: "vp09.00.10.08", h264: "avc1.42E01E" };

/** Find the codecs that this browser can decode, by the server's names. @returns {Promise<string[]>} */
export async function findDecodableCodecs() {
  const codecs = ["jpeg"];
  if (typeof VideoDecoder === "undefined") return codecs;
  for (const [name, codec] of Object.entries(CANDIDATES)) {
    try {
      const support = await VideoDecoder.isConfigSupported({ codec, codedWidth: 320, codedHeight: 320 });
      if (support.supported) codecs.push(name);
    } catch {
      // the browser does not know the codec
    }
  }
  return codecs;
}

/** @param {Uint8Array} bytes @returns {Promise<ImageBitmap>} */
export function decodeJpeg(bytes) {
  const blob = new Blob([/** @type {any} */ (bytes)], { type: "image/jpeg" });
  return createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
}

/** Decodes the stream of one eye and mode. */
class VideoStream {
  constructor() {
    /**
     * The frames that are being decoded, by number.
     * @type {Map<number, {resolve: (frame: VideoFrame) => void, reject: (error: Error) => void}>}
     */
    this.waiting = new Map();
    this.config = "";
    this.decoder = this.#createDecoder();
  }

  #createDecoder() {
    return new VideoDecoder({
      output: (frame) => {
        const waiter = this.waiting.get(frame.timestamp);
        this.waiting.delete(frame.timestamp);
        if (waiter) waiter.resolve(frame);
        else frame.close();
      },
      error: (error) => this.#fail(new Error(error.message)),
    });
  }

  /** Reject all frames that are being decoded. @param {Error} error */
  #fail(error) {
    for (const { reject } of this.waiting.values()) reject(error);
    this.waiting.clear();
  }

  /** @param {any} about @param {Uint8Array} bytes @param {number} number @returns {Promise<VideoFrame>} */
  decode(about, bytes, number) {
    if (about.key && (about.codec_string !== this.config || this.decoder.state !== "configured")) {
      if (this.decoder.state === "closed") this.decoder = this.#createDecoder();
      this.decoder.configure({ codec: about.codec_string, optimizeForLatency: true });
      this.config = about.codec_string;
    }
    return new Promise((resolve, reject) => {
      if (this.decoder.state !== "configured") {
        reject(new Error("expected a key frame first"));
        return;
      }
      this.waiting.set(number, { resolve, reject });
      const type = about.key ? "key" : "delta";
      this.decoder.decode(new EncodedVideoChunk({ type, timestamp: number, data: bytes }));
    });
  }

  close() {
    this.#fail(new Error("closed"));
    if (this.decoder.state !== "closed") this.decoder.close();
  }
}

/** Decodes the images of all eyes and modes of one connection. */
export class PictureDecoder {
  constructor() {
    /** @type {Map<string, VideoStream>} */
    this.streams = new Map();
  }

  /**
   * @param {import("./frames.js").Part} part
   * @param {number} number of the frame
   * @returns {Promise<Picture>}
   */
  decode({ about, bytes }, number) {
    if (about.codec === "jpeg") return decodeJpeg(bytes);
    const key = `${about.codec} ${about.eye} ${about.mode}`;
    const stream = this.streams.get(key) ?? new VideoStream();
    this.streams.set(key, stream);
    return stream.decode(about, bytes, number);
  }

  close() {
    for (const stream of this.streams.values()) stream.close();
    this.streams.clear();
  }
}
