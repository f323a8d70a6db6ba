// The rig as lines: a pyramid for each camera, brighter where it colours the view, and the box that holds the subject.

import { add, apply, invertIntrinsics, length, scale, sub, transpose } from "../view/matrix.js";

/** @typedef {{from: number[], to: number[], colour: number[], thickness: number}} Line */

const IDLE = [0.62, 0.67, 0.74, 0.6];
const USED = [0.95, 0.76, 0.3, 1];
const BOX = [0.62, 0.67, 0.74, 0.35];
/** A pyramid's height as a share of the distance between camera and subject. */
const PYRAMID = 0.11;

/** Depth of the picture at the foot of a camera's pyramid, metres. @param {any} camera @param {number[]} center */
export const pyramidDepth = (camera, center) => PYRAMID * length(sub(center, camera.center));

/** @param {any} camera @param {number[]} center @returns {number[][]} apex, then the corners of its picture */
function pyramid(camera, center) {
  const size = pyramidDepth(camera, center);
  const world = transpose(camera.R);
  const inverse = invertIntrinsics(camera.K);
  const { width, height } = camera;
  const corners = [[0, 0], [width, 0], [width, height], [0, height], [width / 2, -0.22 * height]];
  return [
    camera.center,
    ...corners.map(([u, v]) => add(camera.center, apply(world, scale(apply(inverse, [u, v, 1]), size)))),
  ];
}

/** @param {number[]} low @param {number[]} high @returns {Line[]} */
function box(low, high) {
  const corner = (/** @type {number} */ bits) => [0, 1, 2].map((axis) => (bits & (1 << axis) ? high : low)[axis]);
  const lines = [];
  for (let bits = 0; bits < 8; bits++) {
    for (const axis of [1, 2, 4]) {
      if (!(bits & axis)) lines.push({ from: corner(bits), to: corner(bits | axis), colour: BOX, thickness: 1 });
    }
  }
  return lines;
}

/**
 * @param {any} rig @param {string[]} sources names of the cameras in use @param {number[][]} [colours] theirs in "coverage"
 * @returns {Line[]}
 */
export function rigLines(rig, sources, colours) {
  const lines = box(rig.bounds.low, rig.bounds.high);
  for (const camera of rig.cameras) {
    const place = sources.indexOf(camera.name);
    const own = colours?.[place]?.map((value) => value / 255);
    const colour = place < 0 ? IDLE : own ? [...own, 1] : USED;
    const thickness = place < 0 ? 1.25 : 2.25;
    const [apex, a, b, c, d, top] = pyramid(camera, rig.center);
    const edges = [[apex, a], [apex, b], [apex, c], [apex, d], [a, b], [b, c], [c, d], [d, a], [a, top], [b, top]];
    for (const [from, to] of edges) lines.push({ from, to, colour, thickness });
  }
  return lines;
}
