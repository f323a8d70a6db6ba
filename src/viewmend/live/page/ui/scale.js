// The scale of the colours in an image, with the values at its ends.

import { byId } from "./dom.js";

/** Colours of OpenCV's colour maps at equal distances. */
const COLOURS = {
  turbo: "#30123b, #4662d7, #36aaf9, #1ae4b6, #72fe5e, #c7ef34, #faba39, #f66b19, #cb2a04, #7a0403",
  viridis: "#440154, #414487, #2a788e, #22a884, #7ad151, #fde725",
  inferno: "#000004, #420a68, #932667, #dd513a, #fca50a, #fcffa4",
};

/** @param {number} near metres @param {number} far metres */
function buildDepthScale(near, far) {
  return { low: `${far.toFixed(2)} m`, high: `${near.toFixed(2)} m`, colours: COLOURS.turbo };
}

/**
 * Show or hide the scale.
 * @param {import("../settings.js").Settings} settings
 * @param {any} header of the last frame
 */
export function showScale(settings, header) {
  const [near, far] = header?.depth_m ?? [0, 0];
  const scales = {
    depth: far > 0 ? buildDepthScale(near, far) : null,
    confidence: { low: "uncertain", high: "certain", colours: COLOURS.viridis },
    error: { low: "no error", high: "25 % or more", colours: COLOURS.inferno },
  };
  const mode = settings.shownModes.find((shown) => shown in scales);
  const scale = mode ? /** @type {any} */ (scales)[mode] : null;
  const container = byId("scale");
  container.hidden = !scale;
  const key = JSON.stringify(scale);
  if (!scale || container.dataset.key === key) return;
  container.dataset.key = key;
  byId("scale-low").textContent = scale.low;
  byId("scale-high").textContent = scale.high;
  container.children[1].style.background = `linear-gradient(90deg, ${scale.colours})`;
}
