// Where the viewer stands: angles about a target, and what they mean as a camera (OpenCV axes, metres).

import { add, apply, clamp, cross, degrees, dot, length, radians, scale, sub, transpose, unit, wrap } from "./matrix.js";

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

export const MOST_ELEVATION = 89;

/** From the target to the eye. @param {Basis} basis @param {Pose} pose @returns {number[]} */
export function outward(basis, pose) {
  const [a, e] = [radians(pose.azimuth), radians(pose.elevation)];
  const flat = add(scale(basis.front, Math.cos(a)), scale(basis.side, Math.sin(a)));
  return add(scale(flat, Math.cos(e)), scale(basis.up, Math.sin(e)));
}

/** Right, down and forward of a camera in the world. @param {Basis} basis @param {Pose} pose */
export function axes(basis, pose) {
  const forward = scale(outward(basis, pose), -1);
  const level = unit(cross(forward, basis.up));
  const below = cross(forward, level);
  const roll = radians(pose.roll);
  const right = add(scale(level, Math.cos(roll)), scale(below, Math.sin(roll)));
  return { right, down: cross(forward, right), forward };
}

/** @param {Basis} basis @param {Pose} pose @returns {number[]} */
export const eyeOf = (basis, pose) => add(pose.target, scale(outward(basis, pose), pose.distance));

/** @param {Basis} basis @param {Pose} pose @returns {Extrinsics} */
export function extrinsicsOf(basis, pose) {
  const { right, down, forward } = axes(basis, pose);
  const R = [...right, ...down, ...forward];
  return { R, T: scale(apply(R, eyeOf(basis, pose)), -1) };
}

/** Where a camera stands. @param {Extrinsics} camera @returns {number[]} */
export const eyeOfCamera = ({ R, T }) => scale(apply(transpose(R), T), -1);

/** How azimuth grows, seen from the camera: 1 to the right, -1 to the left. @param {Basis} basis */
export const handedness = (basis) => Math.sign(dot(basis.side, cross(basis.up, basis.front))) || 1;

/**
 * The pose of a camera: the same eye and axes, its target next to the subject's centre.
 * @param {Basis} basis @param {Extrinsics} camera @param {number[]} center @param {number} fov
 * @returns {Pose}
 */
export function poseOfCamera(basis, camera, center, fov) {
  const eye = eyeOfCamera(camera);
  const forward = camera.R.slice(6, 9);
  const distance = Math.max(dot(sub(center, eye), forward), 0.25 * length(sub(center, eye)), 0.1);
  const back = scale(forward, -1);
  const pose = {
    target: add(eye, scale(forward, distance)),
    azimuth: degrees(Math.atan2(dot(back, basis.side), dot(back, basis.front))),
    elevation: clamp(degrees(Math.asin(clamp(dot(back, basis.up), -1, 1))), -MOST_ELEVATION, MOST_ELEVATION),
    roll: 0,
    distance,
    fov,
  };
  const { right, down } = axes(basis, pose);
  const across = camera.R.slice(0, 3);
  pose.roll = degrees(Math.atan2(dot(across, down), dot(across, right)));
  return pose;
}

/** A part of the way from one pose to another. @param {Pose} from @param {Pose} to @param {number} part @returns {Pose} */
export function between(from, to, part) {
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

/** Whether the difference is invisible. @param {Pose} a @param {Pose} b */
export function alike(a, b) {
  return (
    length(sub(a.target, b.target)) < 2e-4 * b.distance &&
    Math.abs(wrap(a.azimuth - b.azimuth)) < 0.01 &&
    Math.abs(a.elevation - b.elevation) < 0.01 &&
    Math.abs(wrap(a.roll - b.roll)) < 0.01 &&
    Math.abs(Math.log(a.distance / b.distance)) < 2e-4 &&
    Math.abs(a.fov - b.fov) < 0.01
  );
}
