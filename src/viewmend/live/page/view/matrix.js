// Vectors of three numbers, and 3 x 3 matrices of nine, row by row.

/** @typedef {number[]} Vec3 */
/** @typedef {number[]} Mat3 */

/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];

/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];

/** @param {Vec3} a @param {number} s @returns {Vec3} */
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];

/** @param {Vec3} a @param {Vec3} b */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];

/** @param {Vec3} a */
export const length = (a) => Math.hypot(a[0], a[1], a[2]);

/** @param {Vec3} a @returns {Vec3} */
export const unit = (a) => scale(a, 1 / (length(a) || 1));

/** @param {Mat3} m @param {Vec3} v @returns {Vec3} */
export const apply = (m, v) => [dot(m.slice(0, 3), v), dot(m.slice(3, 6), v), dot(m.slice(6, 9), v)];

/** @param {Mat3} m @returns {Mat3} */
export const transpose = (m) => [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];

/** @param {Mat3} a @param {Mat3} b @returns {Mat3} */
export function multiply(a, b) {
  const columns = transpose(b);
  const out = [];
  for (let row = 0; row < 3; row++) {
    for (let column = 0; column < 3; column++) {
      out.push(dot(a.slice(3 * row, 3 * row + 3), columns.slice(3 * column, 3 * column + 3)));
    }
  }
  return out;
}

/**
 * Invert [fx s cx; 0 fy cy; 0 0 1].
 * @param {Mat3} K
 * @returns {Mat3}
 */
export function invertIntrinsics(K) {
  const [fx, s, cx, , fy, cy] = K;
  return [1 / fx, -s / (fx * fy), (s * cy - cx * fy) / (fx * fy), 0, 1 / fy, -cy / fy, 0, 0, 1];
}

/** @param {number} value @param {number} low @param {number} high */
export const clamp = (value, low, high) => Math.min(high, Math.max(low, value));

/** @param {number} degrees */
export const radians = (degrees) => (degrees * Math.PI) / 180;

/** @param {number} angle */
export const degrees = (angle) => (angle * 180) / Math.PI;

/** Bring an angle within half a turn of zero. @param {number} angle degrees */
export const wrap = (angle) => angle - 360 * Math.round(angle / 360);
