// The movement of the view: mouse, touch and keys set a goal, and the pose follows it smoothly.

import { add, clamp, scale, sub } from "./matrix.js";
import {
  MAX_ELEVATION,
  cameraAxes,
  computeAzimuthSign,
  directionToEye,
  eyeFromPose,
  interpolatePoses,
  isAlmostEqual,
  poseFromCamera,
} from "./pose.js";

/** @typedef {import("./pose.js").Pose} Pose */

/** The pose follows mouse, touch and keys with this time constant, in milliseconds. */
const USER_MS = 30;
/** The pose moves to another position with this time constant, in milliseconds. */
const MOVE_MS = 100;
/** The view counts as moving until it has been still for this long, in milliseconds. */
const REST_MS = 140;
/** The view gets no closer to its target than this share of the rig's home distance. */
const MIN_DISTANCE_SHARE = 0.05;
/** The view gets no farther from its target than this multiple of the rig's home distance. */
const MAX_DISTANCE_SHARE = 8;
/** Each turn multiplies the roll by this factor, so that the view becomes level. */
const ROLL_DECAY = 0.9;

/** The viewer's pose over time; there is none until `setRig` is called. */
export class Motion {
  /** @param {boolean} reducedMotion whether the user prefers no animation */
  constructor(reducedMotion) {
    this.reducedMotion = reducedMotion;
    /** @type {"orbit" | "fly"} */
    this.mode = "orbit";
    /** @type {Pose | null} */
    this.pose = null;
    /** @type {Pose | null} */
    this.goal = null;
    /** The first pose; null for the rig's home. @type {Pose | null} */
    this.initialPose = null;
    /** @type {any} */
    this.rig = null;
    this.lastChange = -Infinity;
    this.timeConstantMs = USER_MS;
    /** Grows whenever the user moves the view, which stops all other movement. */
    this.userMoves = 0;
  }

  /** Set the rig; the view starts at its home, or stays where it is if there was a rig. @param {any} rig */
  setRig(rig) {
    this.rig = rig;
    this.pose ??= this.initialPose ?? this.computeHome();
    this.goal ??= this.pose;
  }

  /** Whether the view is at the rig's home. */
  get atHome() {
    return this.goal !== null && isAlmostEqual(this.goal, this.computeHome());
  }

  /** @returns {Pose} */
  computeHome() {
    const { azimuth, elevation, distance, fov_y } = this.rig.home;
    return { target: this.rig.center.slice(), azimuth, elevation, roll: 0, distance, fov: fov_y };
  }

  /** Move to a pose smoothly. @param {Pose} pose */
  moveTo(pose) {
    this.goal = { ...pose, target: pose.target.slice() };
    this.timeConstantMs = MOVE_MS;
    if (this.reducedMotion) this.pose = this.goal;
    this.lastChange = performance.now();
  }

  /** Jump to a pose. @param {Pose} pose */
  jumpTo(pose) {
    this.moveTo(pose);
    this.pose = this.goal;
  }

  reset() {
    this.moveTo(this.computeHome());
  }

  /**
   * Move to a camera of the rig.
   * @param {any} camera
   * @param {number} fov of the free part of the page, degrees
   */
  moveToCamera(camera, fov) {
    this.moveTo(poseFromCamera(this.rig, camera, this.rig.center, fov));
  }

  /**
   * Turn about the target (orbit) or about the eye (fly).
   * @param {number} right degrees that the image moves to the right
   * @param {number} down degrees that it moves down
   */
  turn(right, down) {
    this.#change((goal) => {
      const eye = eyeFromPose(this.rig, goal);
      const sign = this.mode === "fly" ? -1 : 1;
      goal.azimuth -= sign * computeAzimuthSign(this.rig) * right;
      goal.elevation = clamp(goal.elevation + sign * down, -MAX_ELEVATION, MAX_ELEVATION);
      goal.roll *= ROLL_DECAY;
      if (this.mode !== "fly") return;
      goal.target = sub(eye, scale(directionToEye(this.rig, goal), goal.distance));
    });
  }

  /**
   * Move the eye and the target.
   * @param {number} right
   * @param {number} down
   * @param {number} forward metres
   */
  pan(right, down, forward) {
    this.#change((goal) => {
      const axes = cameraAxes(this.rig, goal);
      const sideways = add(scale(axes.right, right), scale(axes.down, down));
      goal.target = add(goal.target, add(sideways, scale(axes.forward, forward)));
    });
  }

  /** Change the distance to the target; in the mode "fly", move the target, too. @param {number} factor */
  zoom(factor) {
    if (this.mode === "fly") {
      this.pan(0, 0, (1 - factor) * (this.goal?.distance ?? 0));
      return;
    }
    this.#change((goal) => {
      const home = this.rig.home.distance;
      goal.distance = clamp(goal.distance * factor, MIN_DISTANCE_SHARE * home, MAX_DISTANCE_SHARE * home);
    });
  }

  /** @param {number} fov degrees */
  setFov(fov) {
    this.#change((goal) => {
      goal.fov = fov;
    });
  }

  /** Change the goal on behalf of the user. @param {(goal: Pose) => void} edit */
  #change(edit) {
    if (!this.goal) return;
    const goal = { ...this.goal, target: this.goal.target.slice() };
    edit(goal);
    this.goal = goal;
    this.timeConstantMs = USER_MS;
    this.userMoves += 1;
    this.lastChange = performance.now();
  }

  /**
   * Follow the goal.
   * @param {number} elapsedMs
   * @returns {boolean} whether the pose changed
   */
  step(elapsedMs) {
    if (!this.pose || !this.goal || this.pose === this.goal) return false;
    const part = 1 - Math.exp(-elapsedMs / this.timeConstantMs);
    this.pose = isAlmostEqual(this.pose, this.goal)
      ? this.goal
      : interpolatePoses(this.pose, this.goal, part);
    this.lastChange = performance.now();
    return true;
  }

  /** Whether the view is moving. */
  get moving() {
    return performance.now() - this.lastChange < REST_MS;
  }
}
