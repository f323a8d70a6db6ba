// Poses of the viewer, as angles about a target, and their conversion to and from cameras (OpenCV axes,
// metres).

import {
  add,
  apply,
  clamp,
  cross,
  degrees,
  dot,
  length,
  radians,
  scale,
  sub,
  transpose,
  unit,
  wrap,
} from "./matrix.js";

/**
 * @typedef {object} Pose
 * @property {number[]} target the point that the view turns about, metres
 * @property {number} azimuth degrees
 * @property {number} elevation degrees
 * @property {number} roll degrees, about the line of sight
 * @property {number} distance metres from the target
 * @property {number} fov vertical field of view of the free part of the page, degrees
 */

/**
 * @typedef {object} Basis
 * @property {number[]} up
 * @property {number[]} front
 * @property {number[]} side
 */

/** @typedef {{R: number[], T: number[]}} Extrinsics x_camera = R x_world + T */

/** The elevation of a pose is at most this, in degrees, in both directions. */
export const MAX_ELEVATION = 89;
/** A converted pose is at least this far from its target, in metres. */
const MIN_DISTANCE_M = 0.1;
/** A converted pose is at least this share of its distance to the subject's centre from its target. */
const MIN_DISTANCE_SHARE = 0.25;
/** Poses are almost equal if their angles differ by less than this, in degrees. */
const SAME_DEGREES = 0.01;
/** Poses are almost equal if targets and distances differ by less than this share of the distance. */
const SAME_SHARE = 2e-4;

/**
 * Compute the unit vector from the target to the eye.
 * @param {Basis} basis
 * @param {Pose} pose
 * @returns {number[]}
 */
export function directionToEye(basis, pose) {
  const azimuth = radians(pose.azimuth);
  const elevation = radians(pose.elevation);
  const horizontal = add(scale(basis.front, Math.cos(azimuth)), scale(basis.side, Math.sin(azimuth)));
  return add(scale(horizontal, Math.cos(elevation)), scale(basis.up, Math.sin(elevation)));
}

/**
 * Compute the directions right, down and forward of a camera in the world.
 * @param {Basis} basis
 * @param {Pose} pose
 */
export function cameraAxes(basis, pose) {
  const forward = scale(directionToEye(basis, pose), -1);
  const level = unit(cross(forward, basis.up));
  const below = cross(forward, level);
  const roll = radians(pose.roll);
  const right = add(scale(level, Math.cos(roll)), scale(below, Math.sin(roll)));
  return { right, down: cross(forward, right), forward };
}

/** @param {Basis} basis @param {Pose} pose @returns {number[]} */
export function eyeFromPose(basis, pose) {
  return add(pose.target, scale(directionToEye(basis, pose), pose.distance));
}

/** @param {Basis} basis @param {Pose} pose @returns {Extrinsics} */
export function extrinsicsFromPose(basis, pose) {
  const { right, down, forward } = cameraAxes(basis, pose);
  const R = [...right, ...down, ...forward];
  return { R, T: scale(apply(R, eyeFromPose(basis, pose)), -1) };
}

/**
 * Compute the position of a camera.
 * @param {Extrinsics} camera
 * @returns {number[]}
 */
export const eyeFromExtrinsics = ({ R, T }) => scale(apply(transpose(R), T), -1);

/** Whether azimuth grows to the right (1) or to the left (-1), seen from the camera. @param {Basis} basis */
export const computeAzimuthSign = (basis) => Math.sign(dot(basis.side, cross(basis.up, basis.front))) || 1;

/**
 * Convert a camera to a pose with the same eye and axes, and a target next to the subject's centre.
 * @param {Basis} basis
 * @param {Extrinsics} camera
 * @param {number[]} center
 * @param {number} fov
 * @returns {Pose}
 */
export function poseFromCamera(basis, camera, center, fov) {
  const eye = eyeFromExtrinsics(camera);
  const forward = camera.R.slice(6, 9);
  const toCenter = sub(center, eye);
  const minDistance = MIN_DISTANCE_SHARE * length(toCenter);
  const distance = Math.max(dot(toCenter, forward), minDistance, MIN_DISTANCE_M);
  const back = scale(forward, -1);
  const elevation = degrees(Math.asin(clamp(dot(back, basis.up), -1, 1)));
  const pose = {
    target: add(eye, scale(forward, distance)),
    azimuth: degrees(Math.atan2(dot(back, basis.side), dot(back, basis.front))),
    elevation: clamp(elevation, -MAX_ELEVATION, MAX_ELEVATION),
    roll: 0,
    distance,
    fov,
  };
  const { right, down } = cameraAxes(basis, pose);
  const across = camera.R.slice(0, 3);
  pose.roll = degrees(Math.atan2(dot(across, down), dot(across, right)));
  return pose;
}

/**
 * Interpolate between two poses, with angles the short way round.
 * @param {Pose} from
 * @param {Pose} to
 * @param {number} part
 * @returns {Pose}
 */
export function interpolatePoses(from, to, part) {
  const mix = (/** @type {number} */ a, /** @type {number} */ b) => a + part * (b - a);
  return {
    target: from.target.map((value, i) => mix(value, to.target[i])),
    azimuth: from.azimuth + part * wrap(to.azimuth - from.azimuth),
    elevation: mix(from.elevation, to.elevation),
    roll: from.roll + part * wrap(to.roll - from.roll),
    distance: Math.exp(mix(Math.log(from.distance), Math.log(to.distance))),
    fov: mix(from.fov, to.fov),
  };
}

/**
 * Whether the difference between two poses is invisible.
 * @param {Pose} a
 * @param {Pose} b
 */
export function isAlmostEqual(a, b) {
  return (
    length(sub(a.target, b.target)) < SAME_SHARE * b.distance &&
    Math.abs(wrap(a.azimuth - b.azimuth)) < SAME_DEGREES &&
    Math.abs(a.elevation - b.elevation) < SAME_DEGREES &&
    Math.abs(wrap(a.roll - b.roll)) < SAME_DEGREES &&
    Math.abs(Math.log(a.distance / b.distance)) < SAME_SHARE &&
    Math.abs(a.fov - b.fov) < SAME_DEGREES
  );
}
