// Conversion of the field of view of the free part of the page to the intrinsics of the whole image.

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

/** In a narrow box, the field of view is measured along its width times this factor. */
const NARROW_ASPECT = 1.45;
/** The width and height of a request are multiples of this, in pixels. */
const SIZE_STEP = 4;
/** The width and height of a request are at least this, in pixels. */
const MIN_SIZE = 16;

/**
 * Compute the length that a field of view is measured along.
 * @param {{width: number, height: number}} free
 */
const measureSide = ({ width, height }) => Math.min(height, NARROW_ASPECT * width);

/**
 * Compute the field of view of a focal length in pixels, in degrees.
 * @param {{width: number, height: number}} free
 * @param {number} f
 */
export const fovFromFocal = (free, f) => degrees(2 * Math.atan(measureSide(free) / 2 / f));

/**
 * Compute the lens in CSS pixels of the image's box. Its axis passes through the middle of the free part. In
 * a narrow box, the horizontal field of view is kept instead of the vertical one.
 * @param {Box} box of the image
 * @param {Box} free the part that no panel covers
 * @param {number} fov degrees
 * @returns {Lens}
 */
export function lensFromFov(box, free, fov) {
  const f = measureSide(free) / 2 / Math.tan(radians(fov) / 2);
  return {
    fx: f,
    fy: f,
    cx: free.left + free.width / 2 - box.left,
    cy: free.top + free.height / 2 - box.top,
    width: box.width,
    height: box.height,
  };
}

/**
 * Scale a lens to another image size.
 * @param {Lens} lens
 * @param {number} width
 * @param {number} height
 * @returns {Lens}
 */
export function resizeLens(lens, width, height) {
  const scaleX = width / lens.width;
  const scaleY = height / lens.height;
  return {
    fx: lens.fx * scaleX,
    fy: lens.fy * scaleY,
    cx: lens.cx * scaleX,
    cy: lens.cy * scaleY,
    width,
    height,
  };
}

/**
 * Choose the image size of a request: as many pixels as a square of `side`, in the box's shape, within the
 * limits.
 * @param {Box} box
 * @param {number} side
 * @param {{max_side_px: number, max_pixels: number}} limits of the server
 */
export function chooseSize(box, side, limits) {
  const shape = Math.sqrt(box.width / box.height);
  const longSide = side * Math.max(shape, 1 / shape);
  const shrink = Math.min(1, Math.sqrt(limits.max_pixels) / side, limits.max_side_px / longSide);
  const round = (/** @type {number} */ value) => {
    return Math.max(MIN_SIZE, SIZE_STEP * Math.floor((value * shrink) / SIZE_STEP + 1e-6));
  };
  return { width: round(side * shape), height: round(side / shape) };
}

/**
 * Compute the `side` of an image with one pixel for each pixel of the display.
 * @param {Box} box
 * @param {number} ratio of pixels to CSS pixels
 */
export const computeSharpSide = (box, ratio) => Math.sqrt(box.width * box.height) * ratio;

/**
 * Fit the largest box with an aspect ratio into another box.
 * @param {Box} outer
 * @param {number} aspect width by height
 * @returns {Box}
 */
export function fitBox(outer, aspect) {
  const width = Math.min(outer.width, outer.height * aspect);
  const height = width / aspect;
  return {
    left: outer.left + (outer.width - width) / 2,
    top: outer.top + (outer.height - height) / 2,
    width,
    height,
  };
}
