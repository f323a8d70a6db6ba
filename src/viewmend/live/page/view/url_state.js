// The view in the URL, so that links and reloads show the same.

import { MOST_ELEVATION } from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose */

/** Browsers limit URL changes to about three per second. */
const GAP_MS = 400;

/** @param {Pose} pose @returns {string} azimuth, elevation, roll, distance, field of view, target */
export function poseText({ azimuth, elevation, roll, distance, fov, target }) {
  return [azimuth, elevation, roll, distance, fov, ...target].map((value) => Number(value.toFixed(4))).join(",");
}

/** @param {string | null} text what `poseText` gives @returns {Pose | null} */
export function poseOf(text) {
  const numbers = (text ?? "").split(",").map(Number);
  const [azimuth, elevation, roll, distance, fov, ...target] = numbers;
  const good = numbers.length === 8 && numbers.every(Number.isFinite) && Math.abs(elevation) <= MOST_ELEVATION;
  if (!good || distance < 0.02 || distance > 1000 || fov < 2 || fov > 150 || target.some((value) => Math.abs(value) > 1e4)) return null;
  return { azimuth, elevation, roll, distance, fov, target };
}

/** @param {string | null} text @returns {number} a frame's index; -1 for none */
export const timeOf = (text) => (/^\d{1,9}$/.test(text ?? "") ? Number(text) : -1);

/** Writes the view to the URL once it rests. */
export class UrlState {
  /** @param {"search" | "hash"} part of the URL that holds it */
  constructor(part) {
    this.part = part;
    this.timer = 0;
    /** @type {Record<string, string | null>} */
    this.query = {};
  }

  /** @param {Record<string, string | null>} query parameters by name; null omits one */
  update(query) {
    this.query = query;
    this.timer ||= window.setTimeout(() => this.#write(), GAP_MS);
  }

  /** The address of what is shown. */
  link() {
    this.#write();
    return location.href;
  }

  #write() {
    clearTimeout(this.timer);
    this.timer = 0;
    const values = new URLSearchParams(location[this.part].slice(1));
    for (const [name, value] of Object.entries(this.query)) {
      if (value === null) values.delete(name);
      else values.set(name, value);
    }
    const text = values.toString().replaceAll("%2C", ",");
    if (text === location[this.part].slice(1)) return;
    const url = new URL(location.href);
    url[this.part] = text;
    history.replaceState(null, "", url);
  }
}
