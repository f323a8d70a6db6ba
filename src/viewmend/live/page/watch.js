// Watching what is on air: segment by segment, or where scripts cannot do that (iPhones) by the browser's own HLS player.
// Where both can be had ours is chosen: Chromium's player (150) asked for the playlist 47 times a second.

import { address } from "./link/address.js";
import { SegmentPlayer } from "./link/segments.js";
import { byId } from "./ui/dom.js";

const HLS = "application/vnd.apple.mpegurl";
/** Restart playback after it has stalled for this long. */
const STALLED_MS = 8000;
const AGAIN_MS = 2000;
const REASONS = {
  401: "This server needs a token: open the full address that you received.",
  404: "No broadcast: the server was started without --broadcast.",
};

const token = new URLSearchParams(location.search).get("token");
const film = /** @type {HTMLVideoElement} */ (byId("film"));
const playlist = address("broadcast/live.m3u8", token).href;
/** @type {SegmentPlayer | null} */
let player = null;
let playing = false;
let [shownAt, movedAt] = [-1, 0];

/** @param {string} text */
function say(text) {
  byId("said").textContent = text;
  byId("said").hidden = text === "";
}

/** Ask for the film, and again until there is one; then play it from near its end. */
async function begin() {
  playing = false;
  player?.stop();
  player = null;
  const answer = await fetch(playlist).catch(() => null);
  const final = /** @type {any} */ (REASONS)[answer?.status ?? 0];
  if (final) return say(final);
  if (!answer?.ok) {
    say("The broadcast has not started, or the server is unreachable. Retrying.");
    setTimeout(() => void begin(), AGAIN_MS);
    return;
  }
  if ("MediaSource" in window) player = new SegmentPlayer(film, playlist);
  else if (film.canPlayType(HLS)) film.src = playlist;
  else return say("This browser cannot play HLS.");
  [playing, movedAt] = [true, performance.now()];
  void film.play().catch(() => say("Press play."));
}

/** Restart a stalled video unless it is paused. */
function check() {
  if (film.currentTime !== shownAt || film.paused) [shownAt, movedAt] = [film.currentTime, performance.now()];
  else if (playing && performance.now() - movedAt > STALLED_MS) void begin();
}

film.addEventListener("playing", () => say(""));
film.addEventListener("error", () => playing && void setTimeout(() => void begin(), AGAIN_MS));
setInterval(check, 500);
void begin();
