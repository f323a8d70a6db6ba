// The tools at the top: reset, screenshot, headset, full screen, help, panel.

import { byId, download } from "./dom.js";

/** @param {() => string} link @param {import("./notices.js").Notices} notices */
function copyLink(link, notices) {
  const copied = navigator.clipboard?.writeText(link()) ?? Promise.reject(new Error("no clipboard"));
  copied.then(() => notices.toast("Link copied"), () => notices.toast(`Copy this link: ${link()}`)); // browsers offer a clipboard over HTTPS and on localhost
}

/**
 * @param {{settings: import("../settings.js").Settings, reset: () => void, shot: () => void, link: () => string, headset: () => Promise<void>,
 *   notices: import("./notices.js").Notices}} page
 * @returns {{shot: () => void, help: () => void}}
 */
export function buildTools({ settings, reset, shot, link, headset, notices }) {
  const dialog = byId("help");
  const help = () => (dialog.open ? dialog.close() : dialog.showModal());
  byId("tool-help").addEventListener("click", help);
  byId("help-close").addEventListener("click", help);
  dialog.addEventListener("click", (/** @type {Event} */ event) => {
    if (event.target === dialog) dialog.close();
  });
  byId("tool-reset").addEventListener("click", reset);
  byId("tool-shot").addEventListener("click", shot);
  byId("tool-link").addEventListener("click", () => copyLink(link, notices));
  byId("tool-panel").addEventListener("click", () => settings.set("panel", !settings.get("panel")));
  byId("tool-headset").addEventListener("click", () => {
    headset().catch((error) => notices.toast(`Cannot start VR: ${error.message}`, "error"));
  });
  const full = byId("tool-full");
  full.hidden = !document.fullscreenEnabled;
  full.addEventListener("click", () => {
    void (document.fullscreenElement ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  });
  return { shot, help };
}

/** Save what is on the canvas. @param {HTMLCanvasElement} canvas @param {() => void} paint @param {string} name @param {import("./notices.js").Notices} notices */
export function screenshot(canvas, paint, name, notices) {
  paint();
  canvas.toBlob((blob) => {
    if (!blob) return;
    download(blob, name);
    notices.toast(`Saved as ${name}`);
  }, "image/png");
}
