// Matrices for WebGL: from a picture's pixels and depth, or from the world, to a viewer's clip space.

import { add, apply, invertIntrinsics, multiply, scale, transpose } from "../view/matrix.js";

/** @typedef {import("../view/pose.js").Extrinsics} Extrinsics */
/** @typedef {import("../view/lens.js").Lens} Lens */
/** @typedef {{R: number[], T: number[], lens: Lens}} Viewpoint */

const [NEAR, FAR] = [0.02, 200];

/** Rows of clip = P x for x in the viewer's axes; the last column (of ones) apart. @param {Lens} lens */
function rows({ fx, fy, cx, cy, width, height }) {
  return [
    [(2 * fx) / width, 0, (2 * cx) / width - 1],
    [0, (-2 * fy) / height, 1 - (2 * cy) / height],
    [0, 0, (FAR + NEAR) / (FAR - NEAR)],
    [0, 0, 1],
  ];
}

const DEPTH_OFFSET = (-2 * FAR * NEAR) / (FAR - NEAR);

/** Column-major 4 x 4 of clip = P (A x + b). @param {Lens} lens @param {number[]} A @param {number[]} b */
function clip(lens, A, b) {
  const columns = transpose(A);
  const P = rows(lens);
  const column = (/** @type {number[]} */ v) => P.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
  const last = column(b);
  last[2] += DEPTH_OFFSET;
  return new Float32Array([
    ...column(columns.slice(0, 3)),
    ...column(columns.slice(3, 6)),
    ...column(columns.slice(6, 9)),
    ...last,
  ]);
}

/** @param {Viewpoint} viewer @returns {Float32Array} column-major: clip from (x, y, z, 1) of the world */
export const clipFromWorld = (viewer) => clip(viewer.lens, viewer.R, viewer.T);

/**
 * @param {{K: number[]} & Extrinsics} source @param {Viewpoint} viewer
 * @returns {Float32Array} column-major: clip from (u z, v z, z, 1) of the source's picture
 */
export function clipFromPicture(source, viewer) {
  const turn = multiply(viewer.R, transpose(source.R));
  const offset = add(viewer.T, scale(apply(turn, source.T), -1));
  return clip(viewer.lens, multiply(turn, invertIntrinsics(source.K)), offset);
}

/** The picture as it is, filling the viewport behind everything. @param {number} width @param {number} height */
export function clipFromPixels(width, height) {
  return new Float32Array([2 / width, 0, 0, 0, 0, -2 / height, 0, 0, -1, 1, 0.99999, 1, 0, 0, 0, 0]);
}

/**
 * Whether the viewer stands where the picture was taken, within a twentieth of its pixels.
 * @param {{K: number[]} & Extrinsics} source @param {number} width of the picture @param {number} height @param {Viewpoint} viewer
 */
export function samePlace(source, width, height, viewer) {
  const { lens } = viewer;
  const [x, y] = [width / lens.width, height / lens.height];
  const K = [lens.fx * x, 0, lens.cx * x, 0, lens.fy * y, lens.cy * y];
  const largestDifference = (/** @type {number[]} */ a, /** @type {number[]} */ b) => Math.max(...a.map((value, i) => Math.abs(value - b[i])));
  return largestDifference(K, source.K) < 0.05 && largestDifference(viewer.R, source.R) < 1e-4 && largestDifference(viewer.T, source.T) < 1e-4;
}

/** How far a vertex may be from where the surface is looked for, pixels. */
const NEAR_PX = 14;

/** The nearest vertex that is seen about there; null for none. @param {Float32Array} positions @param {Viewpoint} viewer @param {number} u pixels of its lens @param {number} v */
export function surfaceAt(positions, viewer, u, v) {
  let [best, nearest] = [/** @type {number[] | null} */ (null), Infinity];
  for (let at = 0; at < positions.length; at += 3) {
    const point = [positions[at], positions[at + 1], positions[at + 2]];
    const seen = project(viewer, point);
    if (!seen || Math.hypot(seen[0] - u, seen[1] - v) > NEAR_PX) continue;
    const z = apply(viewer.R, point)[2];
    if (z < nearest) [best, nearest] = [point, z];
  }
  return best;
}

/** Where a point of the world lands in the viewer's picture, in its lens's pixels; null behind it. */
export function project(/** @type {Viewpoint} */ { R, T, lens }, /** @type {number[]} */ point) {
  const [x, y, z] = add(apply(R, point), T);
  if (z < NEAR) return null;
  return [(lens.fx * x) / z + lens.cx, (lens.fy * y) / z + lens.cy];
}
