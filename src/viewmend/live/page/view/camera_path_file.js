// A camera path as a file, which `viewmend mend --path` reads, with the views that the path was made of.

import { degrees, transpose } from "./matrix.js";
import { formatPose, parsePose } from "./url_state.js";
import { poseFromCamera } from "./pose.js";
import { FPS, MAX_POSES } from "./camera_path.js";

/** @typedef {import("./camera_path.js").Point} Point */

/**
 * Build the content of the file.
 * @param {import("./camera_path.js").Track} track
 * @param {{poses: any[], times: number[], width: number, height: number}} film as it would be exported
 */
export function buildPathFile(track, { poses, times, width, height }) {
  const { fx, fy, cx, cy } = poses[0];
  return {
    world_from_camera: poses.map(invertExtrinsics),
    K: [
      [fx, 0, cx],
      [0, fy, cy],
      [0, 0, 1],
    ],
    width,
    height,
    fps: FPS,
    times,
    recorded: track.recordingSince >= 0,
    points: track.points.map(({ pose, seconds, time }) => ({ pose: formatPose(pose), seconds, time })),
  };
}

/** @param {{R: number[], T: number[]}} extrinsics @returns {number[][]} the 4 x 4 matrix world_from_camera */
function invertExtrinsics({ R, T }) {
  const rotation = transpose(R);
  const buildRow = (/** @type {number} */ i) => {
    const axes = rotation.slice(3 * i, 3 * i + 3);
    return [...axes, -axes.reduce((sum, value, k) => sum + value * T[k], 0)];
  };
  return [buildRow(0), buildRow(1), buildRow(2), [0, 0, 0, 1]];
}

/**
 * Read the views of such a file, or of any list of 4 x 4 matrices world_from_camera, which are 1 / FPS apart.
 * @param {any} content parsed JSON
 * @param {any} rig
 * @param {number} fov degrees, used if the file has no K
 * @param {number} time index of the frame, used if the file has none
 * @returns {{points: Point[], recorded: boolean}}
 */
export function readPoints(content, rig, fov, time) {
  // prefer the views that the path was made of
  const views = Array.isArray(content?.points) ? content.points.map(readPoint) : [];
  const recorded = views.length ? content.recorded === true : true;

  // otherwise, take its matrices
  const matrices = Array.isArray(content) ? content : content?.world_from_camera;
  if (!views.length && !(Array.isArray(matrices) && matrices.length)) {
    throw new Error(
      "expected a list of 4 x 4 matrices, or an object whose world_from_camera is one, got neither; " +
        "export it again",
    );
  }
  const { K, height } = content;
  const pathFov = Array.isArray(K) && height > 0 ? degrees(2 * Math.atan(height / 2 / K[1][1])) : fov;
  const readMatrix = (/** @type {any} */ matrix, /** @type {number} */ i) => ({
    pose: poseFromCamera(rig, readCamera(matrix, i), rig.center, pathFov),
    seconds: i / FPS,
    time: content.times?.[i] ?? time,
  });
  const points = views.length ? views : matrices.map(readMatrix);

  // check the length
  const { seconds } = points.at(-1);
  if (points.length > MAX_POSES || seconds * FPS >= MAX_POSES) {
    throw new Error(
      `expected at most ${MAX_POSES} views within ${MAX_POSES / FPS} s, ` +
        `got ${points.length} views and ${seconds.toFixed(1)} s; shorten the path`,
    );
  }
  return { points, recorded };
}

/**
 * Check and read one of the views that a path was made of.
 * @param {any} view
 * @param {number} i its number
 * @param {any[]} views
 * @returns {Point}
 */
function readPoint(view, i, views) {
  const pose = parsePose(view?.pose ?? null);
  const later = i === 0 ? Number.isFinite(view?.seconds) : view?.seconds > views[i - 1].seconds;
  if (!pose || !later || !(view.time >= 0)) {
    throw new Error(
      `view ${i + 1}: expected a pose, later seconds than the view before, and a time; correct the file`,
    );
  }
  return { pose, seconds: view.seconds - views[0].seconds, time: view.time };
}

/**
 * Check and convert a matrix.
 * @param {any} matrix 4 x 4 world_from_camera
 * @param {number} i its number
 */
function readCamera(matrix, i) {
  const rows = Array.isArray(matrix) && matrix.length === 4 ? matrix.slice(0, 3) : [];
  const valid = rows.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite));
  if (!rows.length || !valid) {
    throw new Error(`pose ${i + 1}: expected a 4 x 4 matrix of finite numbers; correct the file`);
  }
  const R = transpose(rows.flatMap((row) => row.slice(0, 3)));
  const T = [0, 1, 2].map((k) => -rows.reduce((sum, row) => sum + row[k] * row[3], 0));
  return { R, T };
}
