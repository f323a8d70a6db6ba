// The tools at the top: reset, screenshot, link, headset, full screen, help and panel.

import { byId, download } from "./dom.js";

/**
 * @typedef {object} ToolActions
 * @property {import("../settings.js").Settings} settings
 * @property {import("./notices.js").Notices} notices
 * @property {() => void} reset
 * @property {() => void} saveScreenshot
 * @property {() => string} getLink
 * @property {() => Promise<void>} enterHeadset
 */

/**
 * Copy the link of the view.
 * @param {() => string} getLink
 * @param {import("./notices.js").Notices} notices
 */
function copyLink(getLink, notices) {
  // browsers offer a clipboard over HTTPS and on localhost only
  const copied = navigator.clipboard?.writeText(getLink()) ?? Promise.reject(new Error("no clipboard"));
  copied.then(
    () => notices.toast("Link copied"),
    () => notices.toast(`Copy this link: ${getLink()}`),
  );
}

/**
 * Set up the tools.
 * @param {ToolActions} actions
 * @returns {{saveScreenshot: () => void, toggleHelp: () => void}} actions that keys have, too
 */
export function buildTools({ settings, notices, reset, saveScreenshot, getLink, enterHeadset }) {
  const dialog = byId("help");
  const toggleHelp = () => (dialog.open ? dialog.close() : dialog.showModal());
  byId("tool-help").addEventListener("click", toggleHelp);
  byId("help-close").addEventListener("click", toggleHelp);
  dialog.addEventListener("click", (/** @type {Event} */ event) => {
    if (event.target === dialog) dialog.close();
  });
  byId("tool-reset").addEventListener("click", reset);
  byId("tool-shot").addEventListener("click", saveScreenshot);
  byId("tool-link").addEventListener("click", () => copyLink(getLink, notices));
  byId("tool-panel").addEventListener("click", () => settings.set("panel", !settings.get("panel")));
  byId("tool-headset").addEventListener("click", () => {
    enterHeadset().catch((error) => notices.toast(`Cannot start VR: ${error.message}`, "error"));
  });
  const fullScreen = byId("tool-full");
  fullScreen.hidden = !document.fullscreenEnabled;
  fullScreen.addEventListener("click", () => {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void document.documentElement.requestFullscreen();
  });
  return { saveScreenshot, toggleHelp };
}

/**
 * Save the image on the canvas as a file.
 * @param {HTMLCanvasElement} canvas
 * @param {() => void} paint
 * @param {string} name of the file
 * @param {import("./notices.js").Notices} notices
 */
export function saveScreenshot(canvas, paint, name, notices) {
  paint();
  canvas.toBlob((blob) => {
    if (!blob) return;
    download(blob, name);
    notices.toast(`Saved as ${name}`);
  }, "image/png");
}
