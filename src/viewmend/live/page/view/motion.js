// How the view moves: people and keys set a goal, the pose follows it without a jerk.

import { add, clamp, scale, sub } from "./matrix.js";
import { MOST_ELEVATION, alike, axes, between, eyeOf, handedness, outward, poseOfCamera } from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose */

/** Time constants: of a hand's movement, and of a jump to another place. */
const HAND_MS = 30;
const JUMP_MS = 100;
/** The view counts as moving until it has been still for so long. */
const REST_MS = 140;

/** The viewer's pose over time. Until `place` was called there is none. */
export class Motion {
  /** @param {boolean} calm whether the person wants no animation */
  constructor(calm) {
    this.calm = calm;
    /** @type {"orbit" | "fly"} */
    this.mode = "orbit";
    /** @type {Pose | null} */
    this.pose = null;
    /** @type {Pose | null} */
    this.goal = null;
    /** Where the view begins; null for the rig's home. @type {Pose | null} */
    this.first = null;
    /** @type {any} */
    this.rig = null;
    this.lastChange = -Infinity;
    this.constant = HAND_MS;
    /** Grows whenever a person moves the view: whatever moves it by itself stops then. */
    this.hands = 0;
  }

  /** Take a rig; the view begins at its home, or stays where it is if there was one. @param {any} rig */
  place(rig) {
    this.rig = rig;
    this.pose ??= this.first ?? this.home();
    this.goal ??= this.pose;
  }

  /** Whether the view is where it began. */
  get atHome() {
    return this.goal !== null && alike(this.goal, this.home());
  }

  /** @returns {Pose} */
  home() {
    const { azimuth, elevation, distance, fov_y } = this.rig.home;
    return { target: this.rig.center.slice(), azimuth, elevation, roll: 0, distance, fov: fov_y };
  }

  /** @param {Pose} pose */
  jump(pose) {
    this.goal = { ...pose, target: pose.target.slice() };
    this.constant = JUMP_MS;
    if (this.calm) this.pose = this.goal;
    this.lastChange = performance.now();
  }

  /** To a place at once. @param {Pose} pose */
  put(pose) {
    this.jump(pose);
    this.pose = this.goal;
  }

  reset() {
    this.jump(this.home());
  }

  /** @param {any} camera one of the rig's @param {number} fov of the free part of the page, degrees */
  snap(camera, fov) {
    this.jump(poseOfCamera(this.rig, camera, this.rig.center, fov));
  }

  /**
   * Turn about the target (orbit) or about the eye (fly).
   * @param {number} right degrees that the picture goes to the right @param {number} down degrees that it goes down
   */
  turn(right, down) {
    this.#change((goal) => {
      const eye = eyeOf(this.rig, goal);
      const sign = this.mode === "fly" ? -1 : 1;
      goal.azimuth -= sign * handedness(this.rig) * right;
      goal.elevation = clamp(goal.elevation + sign * down, -MOST_ELEVATION, MOST_ELEVATION);
      goal.roll *= 0.9;
      if (this.mode === "fly") goal.target = sub(eye, scale(outward(this.rig, goal), goal.distance));
    });
  }

  /** Move the eye and the target. @param {number} right @param {number} down @param {number} forward metres */
  shift(right, down, forward) {
    this.#change((goal) => {
      const camera = axes(this.rig, goal);
      const along = add(add(scale(camera.right, right), scale(camera.down, down)), scale(camera.forward, forward));
      goal.target = add(goal.target, along);
    });
  }

  /** Come closer or go away; in fly, move on. @param {number} factor of the distance */
  zoom(factor) {
    if (this.mode === "fly") {
      this.shift(0, 0, (1 - factor) * (this.goal?.distance ?? 0));
      return;
    }
    this.#change((goal) => {
      const home = this.rig.home.distance;
      goal.distance = clamp(goal.distance * factor, 0.05 * home, 8 * home);
    });
  }

  /** @param {number} fov degrees */
  lens(fov) {
    this.#change((goal) => {
      goal.fov = fov;
    });
  }

  /** @param {(goal: Pose) => void} edit */
  #change(edit) {
    if (!this.goal) return;
    const goal = { ...this.goal, target: this.goal.target.slice() };
    edit(goal);
    this.goal = goal;
    this.constant = HAND_MS;
    this.hands += 1;
    this.lastChange = performance.now();
  }

  /** Follow the goal. @param {number} elapsedMs @returns {boolean} whether the pose changed */
  step(elapsedMs) {
    if (!this.pose || !this.goal || this.pose === this.goal) return false;
    this.pose = alike(this.pose, this.goal)
      ? this.goal
      : between(this.pose, this.goal, 1 - Math.exp(-elapsedMs / this.constant));
    this.lastChange = performance.now();
    return true;
  }

  /** Whether the person is moving the view. */
  get moving() {
    return performance.now() - this.lastChange < REST_MS;
  }
}
