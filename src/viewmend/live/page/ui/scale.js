// What the colours of a picture mean: from which value to which.

import { byId } from "./dom.js";

/** OpenCV's colour maps, at equal distances. */
const COLOURS = {
  turbo: "#30123b, #4662d7, #36aaf9, #1ae4b6, #72fe5e, #c7ef34, #faba39, #f66b19, #cb2a04, #7a0403",
  viridis: "#440154, #414487, #2a788e, #22a884, #7ad151, #fde725",
  inferno: "#000004, #420a68, #932667, #dd513a, #fca50a, #fcffa4",
};

/** @param {import("../settings.js").Settings} settings @param {any} header of the server's last frame */
export function showScale(settings, header) {
  const [near, far] = header?.depth_m ?? [0, 0];
  const scales = {
    depth: far > 0 ? { low: `${far.toFixed(2)} m`, high: `${near.toFixed(2)} m`, colours: COLOURS.turbo } : null,
    confidence: { low: "uncertain", high: "certain", colours: COLOURS.viridis },
    error: { low: "no error", high: "25 % or more", colours: COLOURS.inferno },
  };
  const mode = settings.shown.find((shown) => shown in scales);
  const scale = mode ? /** @type {any} */ (scales)[mode] : null;
  const shown = byId("scale");
  shown.hidden = !scale;
  const key = JSON.stringify(scale);
  if (!scale || shown.dataset.key === key) return;
  shown.dataset.key = key;
  byId("scale-low").textContent = scale.low;
  byId("scale-high").textContent = scale.high;
  shown.children[1].style.background = `linear-gradient(90deg, ${scale.colours})`;
}
