// A film of segments: what the playlist names is appended, one after the other.

const ASK_MS = 500;
/** Segments before the end with which a player begins, as HLS wants it. */
const BEFORE_END = 3;
/** Seconds behind the end that are too many, and how many are right. */
const [TOO_LATE_S, BEHIND_S] = [8, 3];
const KEPT_S = 20;

/** The files that a playlist names, in their order, and the beginning of each. @param {string} text @param {string} url */
export function parsePlaylist(text, url) {
  const init = /#EXT-X-MAP:URI="([^"]+)"/.exec(text)?.[1];
  const names = text.split("\n").filter((line) => line && !line.startsWith("#"));
  return { init: init && new URL(init, url).href, segments: names.map((name) => new URL(name, url).href) };
}

/** The codec of a segment's beginning: what its avcC box says of profile and level. @param {Uint8Array} init */
export function codecOf(init) {
  const at = init.findIndex((_, n) => String.fromCharCode(...init.subarray(n, n + 4)) === "avcC");
  const hex = [...init.subarray(at + 5, at + 8)].map((value) => value.toString(16).padStart(2, "0"));
  return `avc1.${hex.join("")}`;
}

export class SegmentPlayer {
  /** @param {HTMLVideoElement} video @param {string} url the playlist's */
  constructor(video, url) {
    this.video = video;
    this.url = url;
    /** @type {SourceBuffer | null} */
    this.buffer = null;
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
      await this.#step().catch(() => null); // what does not come is asked for again
      await new Promise((done) => setTimeout(done, ASK_MS));
    }
  }

  async #step() {
    const { init, segments } = parsePlaylist(await (await get(this.url)).text(), this.url);
    if (!this.buffer && init) await this.#begin(await bytes(init));
    const known = segments.indexOf(this.last);
    const fresh = known < 0 ? segments.slice(-BEFORE_END) : segments.slice(known + 1);
    for (const name of fresh) {
      await this.#append(await bytes(name));
      this.last = name;
    }
    await this.#follow();
  }

  /** @param {Uint8Array} init */
  async #begin(init) {
    this.buffer = this.source.addSourceBuffer(`video/mp4; codecs="${codecOf(init)}"`);
    this.buffer.mode = "sequence"; // a restarted broadcast is appended to the previous one
    await this.#append(init);
  }

  /** @param {Uint8Array} data */
  #append(data) {
    return this.#change((buffer) => buffer.appendBuffer(/** @type {any} */ (data)));
  }

  /** @param {(buffer: SourceBuffer) => void} change */
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

  /** Stay near the end, and let go of what was shown. */
  async #follow() {
    const { video, buffer } = this;
    if (!buffer?.buffered.length) return;
    const [start, end] = [buffer.buffered.start(0), buffer.buffered.end(buffer.buffered.length - 1)];
    if (video.currentTime < start || end - video.currentTime > TOO_LATE_S) video.currentTime = Math.max(start, end - BEHIND_S);
    if (video.currentTime - start > KEPT_S) await this.#change((own) => own.remove(start, video.currentTime - KEPT_S / 2));
  }
}

/** @param {string} url */
async function get(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`the server answered ${answer.status}`);
  return answer;
}

/** @param {string} url */
const bytes = async (url) => new Uint8Array(await (await get(url)).arrayBuffer());
