// The rig as lines: a pyramid for each camera, brighter if it colours the view, and the box around the
// subject.

import { add, apply, invertIntrinsics, length, scale, sub, transpose } from "../view/matrix.js";

/** @typedef {{from: number[], to: number[], colour: number[], thickness: number}} Line */

/** The colour of cameras that do not colour the view, RGB and opacity. */
const IDLE = [0.62, 0.67, 0.74, 0.6];
/** The colour of cameras that colour the view, RGB and opacity. */
const USED = [0.95, 0.76, 0.3, 1];
/** The colour of the box around the subject, RGB and opacity. */
const BOX = [0.62, 0.67, 0.74, 0.35];
/** The height of a pyramid as a share of the distance between camera and subject. */
const PYRAMID = 0.11;

/**
 * Compute the depth of the image at the foot of a camera's pyramid, in metres.
 * @param {any} camera
 * @param {number[]} center
 */
export const computePyramidDepth = (camera, center) => PYRAMID * length(sub(center, camera.center));

/**
 * @param {any} camera
 * @param {number[]} center
 * @returns {number[][]} apex, four corners of the image, and a mark above it
 */
function buildPyramid(camera, center) {
  const size = computePyramidDepth(camera, center);
  const world = transpose(camera.R);
  const inverse = invertIntrinsics(camera.K);
  const { width, height } = camera;
  const pixels = [
    [0, 0],
    [width, 0],
    [width, height],
    [0, height],
    [width / 2, -0.22 * height],
  ];
  const corners = pixels.map(([u, v]) => {
    return add(camera.center, apply(world, scale(apply(inverse, [u, v, 1]), size)));
  });
  return [camera.center, ...corners];
}

/** @param {number[]} low @param {number[]} high @returns {Line[]} */
function buildBox(low, high) {
  const corner = (/** @type {number} */ bits) => {
    return [0, 1, 2].map((axis) => (bits & (1 << axis) ? high : low)[axis]);
  };
  const lines = [];
  for (let bits = 0; bits < 8; bits++) {
    for (const axis of [1, 2, 4]) {
      if (bits & axis) continue;
      lines.push({ from: corner(bits), to: corner(bits | axis), colour: BOX, thickness: 1 });
    }
  }
  return lines;
}

/**
 * @param {any} rig
 * @param {string[]} sources names of the cameras in use
 * @param {number[][]} [colours] theirs in "coverage"
 * @returns {Line[]}
 */
export function buildRigLines(rig, sources, colours) {
  const lines = buildBox(rig.bounds.low, rig.bounds.high);
  for (const camera of rig.cameras) {
    const index = sources.indexOf(camera.name);
    const own = colours?.[index]?.map((value) => value / 255);
    const usedColour = own ? [...own, 1] : USED;
    const colour = index < 0 ? IDLE : usedColour;
    const thickness = index < 0 ? 1.25 : 2.25;
    const [apex, a, b, c, d, top] = buildPyramid(camera, rig.center);
    const edges = [
      [apex, a],
      [apex, b],
      [apex, c],
      [apex, d],
      [a, b],
      [b, c],
      [c, d],
      [d, a],
      [a, top],
      [b, top],
    ];
    for (const [from, to] of edges) {
      lines.push({ from, to, colour, thickness });
    }
  }
  return lines;
}
