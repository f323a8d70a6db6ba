// From a field of view of the free part of the page to a camera of the whole picture.

import { degrees, radians } from "./matrix.js";

/** @typedef {{left: number, top: number, width: number, height: number}} Box CSS pixels */

/**
 * @typedef {object} Lens pixels of `width` x `height`
 * @property {number} fx
 * @property {number} fy
 * @property {number} cx
 * @property {number} cy
 * @property {number} width
 * @property {number} height
 */

/** What a field of view is measured along. @param {{width: number, height: number}} free */
const sideOf = ({ width, height }) => Math.min(height, 1.45 * width);

/** The field of view of a focal length in pixels, degrees. @param {{width: number, height: number}} free @param {number} f */
export const fovOf = (free, f) => degrees(2 * Math.atan(sideOf(free) / 2 / f));

/**
 * The lens in CSS pixels of the picture's box: its axis passes through the middle of what nothing covers.
 * In a box that is higher than wide the field of view is that of a square, as far as it goes.
 * @param {Box} box where the picture is @param {Box} free the part that no panel covers @param {number} fov degrees
 * @returns {Lens}
 */
export function lensOf(box, free, fov) {
  const f = sideOf(free) / 2 / Math.tan(radians(fov) / 2);
  return {
    fx: f,
    fy: f,
    cx: free.left + free.width / 2 - box.left,
    cy: free.top + free.height / 2 - box.top,
    width: box.width,
    height: box.height,
  };
}

/** The same view in another number of pixels. @param {Lens} lens @param {number} width @param {number} height @returns {Lens} */
export function resize(lens, width, height) {
  const [x, y] = [width / lens.width, height / lens.height];
  return { fx: lens.fx * x, fy: lens.fy * y, cx: lens.cx * x, cy: lens.cy * y, width, height };
}

/**
 * How many pixels to ask for: as many as a square of `side`, in the box's shape, within the server's limits.
 * @param {Box} box @param {number} side @param {{max_side_px: number, max_pixels: number}} limits
 */
export function sizeFor(box, side, limits) {
  const shape = Math.sqrt(box.width / box.height);
  const pixels = Math.min(1, Math.sqrt(limits.max_pixels) / side, limits.max_side_px / (side * Math.max(shape, 1 / shape)));
  const even = (/** @type {number} */ value) => Math.max(16, 4 * Math.floor((value * pixels) / 4 + 1e-6));
  return { width: even(side * shape), height: even(side / shape) };
}

/** The `side` of a picture that has a pixel for each of the display's. @param {Box} box @param {number} ratio of pixels to CSS pixels */
export const sharpSide = (box, ratio) => Math.sqrt(box.width * box.height) * ratio;

/** The largest box of a shape within another one. @param {Box} outer @param {number} aspect width by height @returns {Box} */
export function contained(outer, aspect) {
  const width = Math.min(outer.width, outer.height * aspect);
  const height = width / aspect;
  return {
    left: outer.left + (outer.width - width) / 2,
    top: outer.top + (outer.height - height) / 2,
    width,
    height,
  };
}
