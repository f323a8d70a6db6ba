// A camera path: poses at moments in time, and the smooth curve through them.

import { clamp, wrap } from "./matrix.js";
import { MAX_ELEVATION } from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose */
/**
 * @typedef {{pose: Pose, seconds: number, time: number}} Point `time` is the index of the frame shown there
 */

/** Views that are added one by one are this many seconds apart. */
const STEP_S = 2;
/** Views are at least this many seconds apart. */
const MIN_STEP_S = 0.1;
/** A path is recorded and exported with this many poses per second. */
export const FPS = 30;
/** A path has at most this many poses. */
export const MAX_POSES = 900;
/** A recorded pose is stored if this share of a pose's time has passed since the last one. */
const RECORDED_SHARE = 0.9;
/** A full turn has this many steps between its views. */
const TURN_STEPS = 8;
/** A swing to both sides has this many steps between its views. */
const SWING_STEPS = 16;
/** The indices of azimuth and roll in the numbers of a pose; see `numbersFromPose`. */
const ANGLES = [3, 5];

/** Convert a pose to numbers that can be interpolated. @param {Pose} pose */
function numbersFromPose({ target, azimuth, elevation, roll, distance, fov }) {
  return [...target, azimuth, elevation, roll, Math.log(distance), fov];
}

/**
 * Convert numbers to a pose. The elevation is limited, because a curve through two high views would pass
 * above the pole and tip over.
 * @param {number[]} numbers
 * @returns {Pose}
 */
function poseFromNumbers([x, y, z, azimuth, elevation, roll, logDistance, fov]) {
  return {
    target: [x, y, z],
    azimuth,
    elevation: clamp(elevation, -MAX_ELEVATION, MAX_ELEVATION),
    roll,
    distance: Math.exp(logDistance),
    fov,
  };
}

/** A camera path that is recorded, or made of views that are added one by one. */
export class Track {
  constructor() {
    /** @type {Point[]} */
    this.points = [];
    /** When the recording began, ms; -1 if views were added one by one. */
    this.recordingSince = -1;
  }

  /** The length of the path. */
  get seconds() {
    return this.points.at(-1)?.seconds ?? 0;
  }

  clear() {
    this.points = [];
    this.recordingSince = -1;
  }

  /** The moment of a view that is added now, in seconds. */
  get #nextSeconds() {
    return this.points.length ? this.seconds + STEP_S : 0;
  }

  /** Whether there is room for one more view. */
  get room() {
    return this.#nextSeconds * FPS < MAX_POSES;
  }

  /**
   * Add a view at the end.
   * @param {Pose} pose
   * @param {number} time
   */
  add(pose, time) {
    if (this.room) this.points.push({ pose: { ...pose }, seconds: this.#nextSeconds, time });
  }

  /**
   * Replace the path by a full turn around the target, or by a swing to both sides of the pose and back.
   * @param {Pose} pose
   * @param {number} arc degrees
   * @param {number} seconds
   * @param {number} time
   */
  turntable(pose, arc, seconds, time) {
    this.clear();
    const fullTurn = arc >= 360;
    const steps = fullTurn ? TURN_STEPS : SWING_STEPS;
    this.points = Array.from({ length: steps + 1 }, (_, step) => {
      const turn = fullTurn ? (360 * step) / steps : (arc / 2) * Math.sin((2 * Math.PI * step) / steps);
      return { pose: { ...pose, azimuth: pose.azimuth + turn }, seconds: (seconds * step) / steps, time };
    });
  }

  /**
   * Swap a view with the next or the previous one; their moments stay.
   * @param {number} index
   * @param {number} steps
   */
  move(index, steps) {
    const point = this.points[index];
    const other = this.points[index + steps];
    if (!point || !other) return;
    const { pose } = point;
    point.pose = other.pose;
    other.pose = pose;
  }

  /**
   * Move a view in time, at most to the previous one; the later ones keep their distance from it.
   * @param {number} index
   * @param {number} seconds
   */
  retime(index, seconds) {
    if (index <= 0 || !Number.isFinite(seconds)) return;
    const current = this.points[index].seconds;
    const earliest = this.points[index - 1].seconds + MIN_STEP_S;
    const latest = (MAX_POSES - 1) / FPS - (this.seconds - current);
    const shift = clamp(seconds, earliest, latest) - current;
    for (const point of this.points.slice(index)) point.seconds += shift;
  }

  /** @param {number} index */
  remove(index) {
    this.points.splice(index, 1);
    const first = this.points[0]?.seconds ?? 0;
    for (const point of this.points) point.seconds -= first;
  }

  /** Start a recording. @param {number} now ms */
  start(now) {
    this.clear();
    this.recordingSince = now;
  }

  /**
   * @param {Pose} pose
   * @param {number} time
   * @param {number} now ms
   * @returns {boolean} whether there is room for more
   */
  record(pose, time, now) {
    if (!this.points.length) this.recordingSince = now;
    const seconds = (now - this.recordingSince) / 1000;
    if (seconds * FPS >= MAX_POSES - 1) return false;
    const due = !this.points.length || seconds - this.seconds >= RECORDED_SHARE / FPS;
    if (due) this.points.push({ pose: { ...pose }, seconds, time });
    return true;
  }

  /**
   * Compute the pose at a moment: a Catmull-Rom curve through the points, with angles the short way round.
   * @param {number} seconds
   * @returns {Pose}
   */
  at(seconds) {
    const { points } = this;
    const next = points.findIndex((point) => point.seconds > seconds);
    if (next <= 0) return (next === 0 ? points[0] : points[points.length - 1]).pose;

    // the two points around the moment, p1 and p2, and their neighbours
    const pointAt = (/** @type {number} */ i) => points[clamp(i, 0, points.length - 1)];
    const p0 = pointAt(next - 2);
    const p1 = points[next - 1];
    const p2 = pointAt(next);
    const p3 = pointAt(next + 1);

    // their numbers, with angles within half a turn of those of p1
    const v1 = numbersFromPose(p1.pose);
    const unwrap = (/** @type {Point} */ { pose }) => {
      return numbersFromPose(pose).map((value, i) => {
        return ANGLES.includes(i) ? v1[i] + wrap(value - v1[i]) : value;
      });
    };
    const v0 = unwrap(p0);
    const v2 = unwrap(p2);
    const v3 = unwrap(p3);

    // the cubic Hermite polynomial
    const span = p2.seconds - p1.seconds;
    const span1 = Math.max(1e-6, p2.seconds - p0.seconds);
    const span2 = Math.max(1e-6, p3.seconds - p1.seconds);
    const s = (seconds - p1.seconds) / span;
    const s2 = s * s;
    const s3 = s * s * s;
    const values = v1.map((value, i) => {
      const slope1 = (span * (v2[i] - v0[i])) / span1;
      const slope2 = (span * (v3[i] - value)) / span2;
      const start = (2 * s3 - 3 * s2 + 1) * value + (s3 - 2 * s2 + s) * slope1;
      return start + (3 * s2 - 2 * s3) * v2[i] + (s3 - s2) * slope2;
    });
    return poseFromNumbers(values);
  }

  /**
   * Find the index of the frame at a moment: the one that was shown while recording. If views were added one
   * by one, time runs on from the first of them.
   * @param {number} seconds
   * @param {number} fps of the source
   * @param {{first: number, end: number}} range
   */
  timeAt(seconds, fps, { first, end }) {
    const next = this.points.findIndex((point) => point.seconds > seconds);
    const point = this.points[(next < 0 ? this.points.length : Math.max(1, next)) - 1];
    const recorded = this.recordingSince >= 0;
    const passed = recorded ? 0 : Math.floor((seconds - this.points[0].seconds) * fps + 1e-6);
    const start = recorded ? point.time : this.points[0].time;
    const count = Math.max(1, end - first);
    return first + ((((start + passed - first) % count) + count) % count);
  }

  /** The moments of a video of this path. @returns {number[]} seconds */
  get moments() {
    const count = Math.min(MAX_POSES, Math.floor(this.seconds * FPS + 1e-6) + 1);
    return Array.from({ length: count }, (_, i) => i / FPS);
  }
}
