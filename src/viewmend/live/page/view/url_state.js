// Keeps the view in the URL, so that links and reloads show the same view.

import { MAX_ELEVATION } from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose */

/**
 * The URL is changed at most once in this time, in milliseconds; browsers allow about three changes per
 * second.
 */
const MIN_INTERVAL_MS = 400;
/** A pose consists of this many numbers. */
const POSE_NUMBERS = 8;
/** The distances that a pose may have, in metres. */
const DISTANCES = { min: 0.02, max: 1000 };
/** The fields of view that a pose may have, in degrees. */
const FOVS = { min: 2, max: 150 };
/** No coordinate of a target is larger than this, in metres. */
const MAX_COORDINATE = 1e4;

/** @param {Pose} pose @returns {string} azimuth, elevation, roll, distance, field of view, target */
export function formatPose({ azimuth, elevation, roll, distance, fov, target }) {
  const numbers = [azimuth, elevation, roll, distance, fov, ...target];
  return numbers.map((value) => Number(value.toFixed(4))).join(",");
}

/** @param {string | null} text result of `formatPose` @returns {Pose | null} null if the text is no pose */
export function parsePose(text) {
  const numbers = (text ?? "").split(",").map(Number);
  const [azimuth, elevation, roll, distance, fov, ...target] = numbers;
  if (numbers.length !== POSE_NUMBERS || !numbers.every(Number.isFinite)) return null;
  const valid =
    Math.abs(elevation) <= MAX_ELEVATION &&
    distance >= DISTANCES.min &&
    distance <= DISTANCES.max &&
    fov >= FOVS.min &&
    fov <= FOVS.max &&
    target.every((value) => Math.abs(value) <= MAX_COORDINATE);
  if (!valid) return null;
  return { azimuth, elevation, roll, distance, fov, target };
}

/** @param {string | null} text @returns {number} the index of a frame; -1 if the text is none */
export const parseFrameIndex = (text) => (/^\d{1,9}$/.test(text ?? "") ? Number(text) : -1);

/** Writes the view to the URL, at a limited rate. */
export class UrlState {
  /** @param {"search" | "hash"} part of the URL that holds it */
  constructor(part) {
    this.part = part;
    this.timer = 0;
    /** @type {Record<string, string | null>} */
    this.query = {};
  }

  /**
   * Write parameters soon.
   * @param {Record<string, string | null>} query parameters by name; null removes one
   */
  update(query) {
    this.query = query;
    this.timer ||= window.setTimeout(() => this.#write(), MIN_INTERVAL_MS);
  }

  /** Write the view to the URL now, and return the URL. */
  getLink() {
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
