// Plays a broadcast: appends the segments that its playlist names.

/** The playlist is requested at this interval, in milliseconds. */
const POLL_MS = 500;
/** Playback begins this many segments before the end, as HLS recommends. */
const BEFORE_END = 3;
/** Playback that is farther behind the end than this, in seconds, skips ahead. */
const MAX_BEHIND_S = 8;
/** Playback skips to this long before the end, in seconds. */
const BEHIND_S = 3;
/** When more than this was played, in seconds, half of it is removed from the buffer. */
const KEPT_S = 20;

/**
 * List the segments that a playlist names, in their order, and the file that begins each of them.
 * @param {string} text
 * @param {string} url
 */
function parsePlaylist(text, url) {
  const init = /#EXT-X-MAP:URI="([^"]+)"/.exec(text)?.[1];
  const names = text.split("\n").filter((line) => line && !line.startsWith("#"));
  return { init: init && new URL(init, url).href, segments: names.map((name) => new URL(name, url).href) };
}

/**
 * Read the codec, with its profile and level, from the avcC box of the file that begins each segment.
 * @param {Uint8Array} init
 */
function readCodec(init) {
  const at = init.findIndex((_, n) => String.fromCharCode(...init.subarray(n, n + 4)) === "avcC");
  const hex = [...init.subarray(at + 5, at + 8)].map((value) => value.toString(16).padStart(2, "0"));
  return `avc1.${hex.join("")}`;
}

/** Plays the segments of a playlist in a video element. */
export class SegmentPlayer {
  /** @param {HTMLVideoElement} video @param {string} url of the playlist */
  constructor(video, url) {
    this.video = video;
    this.url = url;
    /** @type {SourceBuffer | null} */
    this.buffer = null;
    /** URL of the segment that was appended last. */
    this.last = "";
    this.stopped = false;
    this.source = new MediaSource();
    video.src = URL.createObjectURL(this.source);
    this.source.addEventListener("sourceopen", () => void this.#run(), { once: true });
  }

  stop() {
    this.stopped = true;
  }

  async #run() {
    URL.revokeObjectURL(this.video.src);
    while (!this.stopped) {
      await this.#update().catch(() => null); // whatever failed is requested again
      await new Promise((done) => setTimeout(done, POLL_MS));
    }
  }

  /** Append the new segments of the playlist, unless a picture is paused. */
  async #update() {
    if (this.video.paused && this.video.currentTime > 0) return;
    const response = await fetchFile(this.url);
    const { init, segments } = parsePlaylist(await response.text(), this.url);
    if (!this.buffer && init) await this.#begin(await fetchBytes(init));
    const known = segments.indexOf(this.last);
    const fresh = known < 0 ? segments.slice(-BEFORE_END) : segments.slice(known + 1);
    for (const name of fresh) {
      await this.#append(await fetchBytes(name));
      this.last = name;
    }
    await this.#follow();
  }

  /** @param {Uint8Array} init */
  async #begin(init) {
    this.buffer = this.source.addSourceBuffer(`video/mp4; codecs="${readCodec(init)}"`);
    this.buffer.mode = "sequence"; // a restarted broadcast is appended to the previous one
    await this.#append(init);
  }

  /** @param {Uint8Array} data */
  #append(data) {
    return this.#change((buffer) => buffer.appendBuffer(/** @type {any} */ (data)));
  }

  /** Change the buffer, and wait until it was updated. @param {(buffer: SourceBuffer) => void} change */
  #change(change) {
    const { buffer } = this;
    if (!buffer) return Promise.resolve();
    return new Promise((done, failed) => {
      buffer.addEventListener("updateend", () => done(undefined), { once: true });
      try {
        change(buffer);
      } catch (error) {
        failed(error);
      }
    });
  }

  /** Stay near the end, and remove what was played. */
  async #follow() {
    const { video, buffer } = this;
    if (!buffer?.buffered.length) return;
    const { buffered } = buffer;
    const start = buffered.start(0);
    const end = buffered.end(buffered.length - 1);
    if (video.currentTime < start || end - video.currentTime > MAX_BEHIND_S) {
      video.currentTime = Math.max(start, end - BEHIND_S);
    }
    if (video.currentTime - start > KEPT_S) {
      await this.#change((own) => own.remove(start, video.currentTime - KEPT_S / 2));
    }
  }
}

/** @param {string} url */
async function fetchFile(url) {
  const response = await fetch(url);
  if (!response.ok) throw new Error(`the server answered ${response.status}`);
  return response;
}

/** @param {string} url */
async function fetchBytes(url) {
  const response = await fetchFile(url);
  return new Uint8Array(await response.arrayBuffer());
}
