// Matrices for WebGL, from an image's pixels and depth, or from the world, to a viewer's clip space.

import { add, apply, dot, invertIntrinsics, multiply, scale, transpose } from "../view/matrix.js";

/** @typedef {import("../view/pose.js").Extrinsics} Extrinsics */
/** @typedef {import("../view/lens.js").Lens} Lens */
/** @typedef {{R: number[], T: number[], lens: Lens}} Viewpoint */

/** The distance of the near plane, in metres. */
const NEAR = 0.02;
/** The distance of the far plane, in metres. */
const FAR = 200;
/** The third element of the last column of the projection matrix; its other elements are 0. */
const DEPTH_OFFSET = (-2 * FAR * NEAR) / (FAR - NEAR);
/** A view is the same as another one if no element of the intrinsics differs by more, in pixels. */
const SAME_INTRINSICS_PX = 0.05;
/** A view is the same as another one if no element of the rotation or translation differs by more. */
const SAME_EXTRINSICS = 1e-4;
/** A vertex belongs to a pixel if it is no farther from it than this, in pixels. */
const NEARBY_PX = 14;

/**
 * Compute the rows of P in clip = P x, for x in the viewer's axes, without the last column.
 * @param {Lens} lens
 */
function computeProjection({ fx, fy, cx, cy, width, height }) {
  return [
    [(2 * fx) / width, 0, (2 * cx) / width - 1],
    [0, (-2 * fy) / height, 1 - (2 * cy) / height],
    [0, 0, (FAR + NEAR) / (FAR - NEAR)],
    [0, 0, 1],
  ];
}

/**
 * Compute the column-major 4 x 4 matrix of clip = P (A x + b).
 * @param {Lens} lens
 * @param {number[]} A
 * @param {number[]} b
 */
function computeClip(lens, A, b) {
  const columns = transpose(A);
  const P = computeProjection(lens);
  const project = (/** @type {number[]} */ v) => P.map((row) => dot(row, v));
  const last = project(b);
  last[2] += DEPTH_OFFSET;
  return new Float32Array([
    ...project(columns.slice(0, 3)),
    ...project(columns.slice(3, 6)),
    ...project(columns.slice(6, 9)),
    ...last,
  ]);
}

/** @param {Viewpoint} viewer @returns {Float32Array} column-major: clip from (x, y, z, 1) of the world */
export const clipFromWorld = (viewer) => computeClip(viewer.lens, viewer.R, viewer.T);

/**
 * @param {{K: number[]} & Extrinsics} source
 * @param {Viewpoint} viewer
 * @returns {Float32Array} column-major: clip from (u z, v z, z, 1) of the source's image
 */
export function clipFromImage(source, viewer) {
  const rotation = multiply(viewer.R, transpose(source.R));
  const offset = add(viewer.T, scale(apply(rotation, source.T), -1));
  return computeClip(viewer.lens, multiply(rotation, invertIntrinsics(source.K)), offset);
}

/**
 * Fill the viewport with an image, behind everything else.
 * @param {number} width
 * @param {number} height
 */
export function clipFromPixels(width, height) {
  return new Float32Array([
    2 / width, 0, 0, 0,
    0, -2 / height, 0, 0,
    -1, 1, 0.99999, 1,
    0, 0, 0, 0,
  ]);
}

/**
 * Whether the viewer sees an image exactly as it was taken, with the difference far below a pixel.
 * @param {{K: number[]} & Extrinsics} source
 * @param {number} width of the image, pixels
 * @param {number} height
 * @param {Viewpoint} viewer
 */
export function isSameView(source, width, height, viewer) {
  const { lens } = viewer;
  const scaleX = width / lens.width;
  const scaleY = height / lens.height;
  const K = [lens.fx * scaleX, 0, lens.cx * scaleX, 0, lens.fy * scaleY, lens.cy * scaleY];
  return (
    computeMaxDifference(K, source.K) < SAME_INTRINSICS_PX &&
    computeMaxDifference(viewer.R, source.R) < SAME_EXTRINSICS &&
    computeMaxDifference(viewer.T, source.T) < SAME_EXTRINSICS
  );
}

/** @param {number[]} a @param {number[]} b */
function computeMaxDifference(a, b) {
  return Math.max(...a.map((value, i) => Math.abs(value - b[i])));
}

/**
 * Find the vertex nearest to the viewer among those close to a pixel; null if there is none.
 * @param {Float32Array} positions
 * @param {Viewpoint} viewer
 * @param {number} u pixels of its lens
 * @param {number} v
 */
export function findSurfacePoint(positions, viewer, u, v) {
  /** @type {number[] | null} */
  let nearest = null;
  let nearestDepth = Infinity;
  for (let at = 0; at < positions.length; at += 3) {
    const point = [positions[at], positions[at + 1], positions[at + 2]];
    const pixel = project(viewer, point);
    if (!pixel || Math.hypot(pixel[0] - u, pixel[1] - v) > NEARBY_PX) continue;
    const depth = apply(viewer.R, point)[2];
    if (depth < nearestDepth) {
      nearest = point;
      nearestDepth = depth;
    }
  }
  return nearest;
}

/**
 * Project a point of the world to pixels of the viewer's lens; null if it is behind the viewer.
 * @param {Viewpoint} viewer
 * @param {number[]} point metres
 */
export function project({ R, T, lens }, point) {
  const [x, y, z] = add(apply(R, point), T);
  if (z < NEAR) return null;
  return [(lens.fx * x) / z + lens.cx, (lens.fy * y) / z + lens.cy];
}
