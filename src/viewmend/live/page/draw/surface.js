// A picture's depth as triangles in the picture's own pixels: (u, v, z), z in metres.

/** Neighbours whose depths differ by more than this share lie on two surfaces. */
const JUMP = 0.03;

/**
 * @typedef {object} Surface
 * @property {Float32Array} vertices u, v, z
 * @property {Uint32Array} solid triangles of what was seen
 * @property {Uint32Array} stretched triangles across jumps in depth: all that is known of what lies between
 */

/** Grows as it is written to. */
class Numbers {
  /** @param {Float32ArrayConstructor | Uint32ArrayConstructor} kind @param {number} capacity */
  constructor(kind, capacity) {
    this.kind = kind;
    this.values = new kind(capacity);
    this.length = 0;
  }

  /** @param {number[]} added */
  push(...added) {
    if (this.length + added.length > this.values.length) {
      const larger = new this.kind(2 * (this.length + added.length));
      larger.set(this.values);
      this.values = larger;
    }
    for (const value of added) this.values[this.length++] = value;
  }

  get taken() {
    return this.values.subarray(0, this.length);
  }
}

/** Where the depth's columns (or rows) lie in the picture; the outermost on its edge. */
function places(/** @type {number} */ count, /** @type {number} */ stride, /** @type {number} */ size) {
  const half = Math.floor(stride / 2);
  const out = Array.from({ length: count }, (_, i) => Math.min(stride * i + half, size - 1) + 0.5);
  out[0] = 0;
  out[count - 1] = size;
  return out;
}

/**
 * Cells of one surface share the grid's vertices. In a cell across a jump each of the two surfaces goes on to the
 * cell's edge with vertices of its own, so that nothing is missing until the view moves; cells at the silhouette alike.
 * @param {import("../link/frames.js").Depth} depth @param {number} width of the picture @param {number} height
 * @returns {Surface}
 */
export function surfaceOf(depth, width, height) {
  const { width: columns, height: rows, z } = depth;
  const us = places(columns, depth.stride, width);
  const vs = places(rows, depth.stride, height);
  const vertices = new Numbers(Float32Array, 3 * columns * rows + 12 * (columns + rows));
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) vertices.push(us[column], vs[row], z[row * columns + column]);
  }
  const solid = new Numbers(Uint32Array, 6 * columns * rows);
  const stretched = new Numbers(Uint32Array, 1024);
  for (let row = 0; row + 1 < rows; row++) {
    for (let column = 0; column + 1 < columns; column++) {
      const first = row * columns + column;
      const [a, b, c, d] = [z[first], z[first + 1], z[first + columns], z[first + columns + 1]];
      const high = Math.max(a, b, c, d);
      if (high === 0) continue;
      const corners = [first, first + 1, first + columns, first + columns + 1];
      const whole = a > 0 && b > 0 && c > 0 && d > 0;
      if (whole && high <= Math.min(a, b, c, d) * (1 + JUMP)) {
        twoTriangles(solid, corners);
        continue;
      }
      const seen = corners.filter((index) => z[index] > 0);
      const low = Math.min(...seen.map((index) => z[index]));
      const jump = high > low * (1 + JUMP);
      const near = seen.filter((index) => z[index] <= low * (1 + JUMP));
      extend(vertices, solid, z, corners, near);
      if (jump) extend(vertices, solid, z, corners, seen.filter((index) => !near.includes(index)));
      if (jump && whole) twoTriangles(stretched, corners);
    }
  }
  return {
    vertices: /** @type {Float32Array} */ (vertices.taken),
    solid: /** @type {Uint32Array} */ (solid.taken),
    stretched: /** @type {Uint32Array} */ (stretched.taken),
  };
}

/** @param {Numbers} indices @param {number[]} corners */
function twoTriangles(indices, [a, b, c, d]) {
  indices.push(a, c, b, b, c, d);
}

/**
 * A whole cell at the depth of those corners that are `members`.
 * @param {Numbers} vertices @param {Numbers} solid @param {Float32Array} z @param {number[]} corners @param {number[]} members
 */
function extend(vertices, solid, z, corners, members) {
  let mean = 0;
  for (const index of members) mean += z[index] / members.length;
  const start = vertices.length / 3;
  for (const index of corners) {
    const [u, v] = vertices.values.subarray(3 * index, 3 * index + 2);
    vertices.push(u, v, members.includes(index) ? z[index] : mean);
  }
  twoTriangles(solid, [start, start + 1, start + 2, start + 3]);
}

/** A picture without depth: a plane at `z`. @param {number} width @param {number} height @param {number} z @returns {Surface} */
export function planeOf(width, height, z) {
  return {
    vertices: new Float32Array([0, 0, z, width, 0, z, 0, height, z, width, height, z]),
    solid: new Uint32Array([0, 2, 1, 1, 2, 3]),
    stretched: new Uint32Array(0),
  };
}
