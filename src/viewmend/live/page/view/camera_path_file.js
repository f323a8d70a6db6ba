// A camera path as a file: what `viewmend mend --path` takes, and the views that it was made of.

import { degrees, transpose } from "./matrix.js";
import { poseOf, poseText } from "./url_state.js";
import { poseOfCamera } from "./pose.js";
import { FPS, MOST_POSES } from "./camera_path.js";

/** @typedef {import("./camera_path.js").Point} Point */

/**
 * @param {import("./camera_path.js").Track} track
 * @param {{poses: any[], times: number[], width: number, height: number}} film as it would be exported
 */
export function pathFile(track, { poses, times, width, height }) {
  const rows = (/** @type {{R: number[], T: number[]}} */ { R, T }) => {
    const turn = transpose(R);
    const row = (/** @type {number} */ i) => {
      const axes = turn.slice(3 * i, 3 * i + 3);
      return [...axes, -axes.reduce((sum, value, k) => sum + value * T[k], 0)];
    };
    return [row(0), row(1), row(2), [0, 0, 0, 1]];
  };
  const { fx, fy, cx, cy } = poses[0];
  const points = track.points.map(({ pose, seconds, time }) => ({ pose: poseText(pose), seconds, time }));
  const K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]];
  return { world_from_camera: poses.map(rows), K, width, height, fps: FPS, times, recorded: track.recordingSince >= 0, points };
}

/**
 * The views of such a file, or of any list of 4 x 4 matrices world_from_camera (then 30 a second).
 * @param {any} content parsed JSON @param {any} rig @param {number} fov degrees where the file has no K @param {number} time the frame where it has none
 * @returns {{points: Point[], recorded: boolean}}
 */
export function pointsOf(content, rig, fov, time) {
  const ours = Array.isArray(content?.points) ? content.points.map(pointOf) : [];
  const recorded = ours.length ? content.recorded === true : true;
  const matrices = Array.isArray(content) ? content : content?.world_from_camera;
  if (!ours.length && !(Array.isArray(matrices) && matrices.length)) {
    throw new Error("expected a list of 4 x 4 matrices, or an object whose world_from_camera is one, got neither; export it again");
  }
  const { K, height } = content;
  const lens = Array.isArray(K) && height > 0 ? degrees(2 * Math.atan(height / 2 / K[1][1])) : fov;
  const points = ours.length
    ? ours
    : matrices.map((/** @type {any} */ matrix, /** @type {number} */ i) => ({
        pose: poseOfCamera(rig, cameraOf(matrix, i), rig.center, lens), seconds: i / FPS, time: content.times?.[i] ?? time,
      }));
  if (points.length > MOST_POSES || points.at(-1).seconds * FPS >= MOST_POSES) throw new Error(`expected at most ${MOST_POSES} views within ${MOST_POSES / FPS} s, got ${points.length} views and ${points.at(-1).seconds.toFixed(1)} s; shorten the path`);
  return { points, recorded };
}

/** @param {any} given @param {number} i @returns {Point} */
function pointOf(given, i, /** @type {any[]} */ all) {
  const pose = poseOf(given?.pose ?? null);
  const after = i === 0 ? given?.seconds === 0 : given?.seconds > all[i - 1].seconds;
  if (!pose || !after || !(given.time >= 0)) throw new Error(`view ${i + 1}: expected a pose, later seconds than the view before (0 for the first), and a time; correct the file`);
  return { pose, seconds: given.seconds, time: given.time };
}

/** @param {any} matrix 4 x 4 world_from_camera @param {number} i */
function cameraOf(matrix, i) {
  const rows = Array.isArray(matrix) && matrix.length === 4 ? matrix.slice(0, 3) : [];
  const whole = rows.every((row) => Array.isArray(row) && row.length === 4 && row.every(Number.isFinite));
  if (!rows.length || !whole) throw new Error(`pose ${i + 1}: expected a 4 x 4 matrix of finite numbers; correct the file`);
  const axes = rows.flatMap((row) => row.slice(0, 3));
  const R = transpose(axes);
  const T = [0, 1, 2].map((k) => -rows.reduce((sum, row) => sum + row[k] * row[3], 0));
  return { R, T };
}
