// A camera path: places in time, and the smooth curve through them.

import { clamp, wrap } from "./matrix.js";
import { MOST_ELEVATION } from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose */
/** @typedef {{pose: Pose, seconds: number, time: number}} Point `time`: the index of the frame that was shown */

/** Between two views that were added one by one. */
const SECONDS_BETWEEN = 2;
const LEAST_SECONDS = 0.1;
export const FPS = 30;
export const MOST_POSES = 900;

/** @param {Pose} pose */
const numbers = (pose) => [...pose.target, pose.azimuth, pose.elevation, pose.roll, Math.log(pose.distance), pose.fov];

/** A curve through two high views would pass above the pole and tip over. @param {number[]} values @returns {Pose} */
const poseFrom = ([x, y, z, azimuth, elevation, roll, logDistance, fov]) => ({
  target: [x, y, z], azimuth, elevation: clamp(elevation, -MOST_ELEVATION, MOST_ELEVATION), roll, distance: Math.exp(logDistance), fov,
});

export class Track {
  constructor() {
    /** @type {Point[]} */
    this.points = [];
    this.recordingSince = -1;
  }

  get seconds() {
    return this.points.at(-1)?.seconds ?? 0;
  }

  clear() {
    this.points = [];
    this.recordingSince = -1;
  }

  /** When a view that is added now would be passed. */
  get #next() {
    return this.points.length ? this.seconds + SECONDS_BETWEEN : 0;
  }

  /** Whether one more view has room. */
  get room() {
    return this.#next * FPS < MOST_POSES;
  }

  /** @param {Pose} pose @param {number} time */
  add(pose, time) {
    if (this.room) this.points.push({ pose: { ...pose }, seconds: this.#next, time });
  }

  /**
   * Around the target: a whole turn, or a swing there and back about where the view is.
   * @param {Pose} pose @param {number} arc degrees @param {number} seconds @param {number} time
   */
  turntable(pose, arc, seconds, time) {
    this.clear();
    const whole = arc >= 360;
    const steps = whole ? 8 : 16;
    this.points = Array.from({ length: steps + 1 }, (_, step) => {
      const turn = whole ? (360 * step) / steps : (arc / 2) * Math.sin((2 * Math.PI * step) / steps);
      return { pose: { ...pose, azimuth: pose.azimuth + turn }, seconds: (seconds * step) / steps, time };
    });
  }

  /** Swap a view with the next or the one before; the moments stay. @param {number} index @param {number} steps */
  move(index, steps) {
    const [one, other] = [this.points[index], this.points[index + steps]];
    if (one && other) [one.pose, other.pose] = [other.pose, one.pose];
  }

  /** Set when a view is passed, after the one before; the later ones keep their distance. @param {number} index @param {number} seconds */
  retime(index, seconds) {
    if (index <= 0 || !Number.isFinite(seconds)) return;
    const last = (MOST_POSES - 1) / FPS - (this.seconds - this.points[index].seconds);
    const moved = clamp(seconds, this.points[index - 1].seconds + LEAST_SECONDS, last) - this.points[index].seconds;
    for (const point of this.points.slice(index)) point.seconds += moved;
  }

  /** @param {number} index */
  remove(index) {
    this.points.splice(index, 1);
    const first = this.points[0]?.seconds ?? 0;
    for (const point of this.points) point.seconds -= first;
  }

  /** @param {number} now ms */
  start(now) {
    this.clear();
    this.recordingSince = now;
  }

  /** @param {Pose} pose @param {number} time @param {number} now ms @returns {boolean} whether there is room for more */
  record(pose, time, now) {
    const seconds = (now - this.recordingSince) / 1000;
    if (seconds * FPS >= MOST_POSES - 1) return false;
    if (!this.points.length || seconds - this.seconds >= 0.9 / FPS) this.points.push({ pose: { ...pose }, seconds, time });
    return true;
  }

  /**
   * The pose at a moment: a Catmull-Rom curve through the points, angles the short way round.
   * @param {number} seconds @returns {Pose}
   */
  at(seconds) {
    const { points } = this;
    const next = points.findIndex((point) => point.seconds > seconds);
    if (next <= 0) return (next === 0 ? points[0] : points[points.length - 1]).pose;
    const here = numbers(points[next - 1].pose);
    const turns = (/** @type {number[]} */ values) =>
      values.map((value, i) => (i === 3 || i === 5 ? here[i] + wrap(value - here[i]) : value));
    const [p0, p2, p3] = [next - 2, next, next + 1].map((i) => points[Math.min(points.length - 1, Math.max(0, i))]);
    const p1 = points[next - 1];
    const [v0, v2, v3] = [p0, p2, p3].map((point) => turns(numbers(point.pose)));
    const span = p2.seconds - p1.seconds;
    const s = (seconds - p1.seconds) / span;
    const slope = (/** @type {number} */ a, /** @type {number} */ b, /** @type {Point} */ from, /** @type {Point} */ to) =>
      (span * (b - a)) / Math.max(1e-6, to.seconds - from.seconds);
    return poseFrom(
      here.map((value, i) => {
        const [m1, m2] = [slope(v0[i], v2[i], p0, p2), slope(value, v3[i], p1, p3)];
        const [s2, s3] = [s * s, s * s * s];
        return (2 * s3 - 3 * s2 + 1) * value + (s3 - 2 * s2 + s) * m1 + (3 * s2 - 2 * s3) * v2[i] + (s3 - s2) * m2;
      }),
    );
  }

  /**
   * The frame's index at a moment: as it was shown while recording, running along between views that were added.
   * @param {number} seconds @param {number} fps of the source @param {{first: number, end: number}} range
   */
  timeAt(seconds, fps, { first, end }) {
    const next = this.points.findIndex((point) => point.seconds > seconds);
    const point = this.points[(next < 0 ? this.points.length : Math.max(1, next)) - 1];
    const along = this.recordingSince >= 0 ? 0 : Math.floor((seconds - this.points[0].seconds) * fps + 1e-6);
    const start = this.recordingSince >= 0 ? point.time : this.points[0].time;
    const count = Math.max(1, end - first);
    return first + ((((start + along - first) % count) + count) % count);
  }

  /** Moments of a film of this path. @returns {number[]} seconds */
  get moments() {
    const count = Math.min(MOST_POSES, Math.floor(this.seconds * FPS + 1e-6) + 1);
    return Array.from({ length: count }, (_, i) => i / FPS);
  }
}
