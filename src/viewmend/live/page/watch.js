// The page of spectators, which plays the broadcast: segment by segment, or with the browser's own HLS player
// where scripts cannot play segments (iPhones). Where both work, the segment player is chosen, because
// Chromium's HLS player (150) requested the playlist 47 times a second.

import { buildAddress } from "./link/address.js";
import { SegmentPlayer } from "./link/segments.js";
import { byId } from "./ui/dom.js";

/** The media type of HLS playlists. */
const HLS = "application/vnd.apple.mpegurl";
/** Playback restarts after it has stalled for this long, in milliseconds. */
const STALLED_MS = 8000;
/** The page waits this long, in milliseconds, before it tries again. */
const RETRY_MS = 2000;
/** Stalls are looked for at this interval, in milliseconds. */
const CHECK_MS = 500;
/** Explanations of the status codes after which another try is pointless. */
const REASONS = {
  401: "This server needs a token: open the full address that you received.",
  404: "No broadcast: the server was started without --broadcast.",
};

const token = new URLSearchParams(location.search).get("token");
const film = /** @type {HTMLVideoElement} */ (byId("film"));
const playlist = buildAddress("broadcast/live.m3u8", token).href;
/** @type {SegmentPlayer | null} */
let player = null;
let playing = false;
/** The position of the video at the last check, in seconds. */
let lastPosition = -1;
/** The time of the last check at which the video had moved, in milliseconds. */
let lastMovedAt = 0;

/** @param {string} text */
function showMessage(text) {
  byId("said").textContent = text;
  byId("said").hidden = text === "";
}

/** Request the playlist until there is one, then play from near its end. */
async function begin() {
  playing = false;
  player?.stop();
  player = null;
  const response = await fetch(playlist).catch(() => null);
  const reason = /** @type {any} */ (REASONS)[response?.status ?? 0];
  if (reason) {
    showMessage(reason);
    return;
  }
  if (!response?.ok) {
    showMessage("The broadcast has not started, or the server is unreachable. Retrying.");
    setTimeout(() => void begin(), RETRY_MS);
    return;
  }
  if ("MediaSource" in window) {
    player = new SegmentPlayer(film, playlist);
  } else if (film.canPlayType(HLS)) {
    film.src = playlist;
  } else {
    showMessage("This browser cannot play HLS.");
    return;
  }
  playing = true;
  lastMovedAt = performance.now();
  void film.play().catch(() => showMessage("Press play."));
}

/** Restart a stalled video unless it is paused. */
function restartIfStalled() {
  if (film.currentTime !== lastPosition || film.paused) {
    lastPosition = film.currentTime;
    lastMovedAt = performance.now();
  } else if (playing && performance.now() - lastMovedAt > STALLED_MS) {
    void begin();
  }
}

film.addEventListener("playing", () => showMessage(""));
film.addEventListener("error", () => {
  if (playing) setTimeout(() => void begin(), RETRY_MS);
});
setInterval(restartIfStalled, CHECK_MS);
void begin();
