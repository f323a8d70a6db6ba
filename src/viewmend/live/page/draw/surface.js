// A picture's depth as triangles in the picture's own pixels: where they are (u, v, z), z in metres, and what colours them (s, t).

/** Neighbours whose depths differ by more than this share lie on two surfaces. */
const JUMP = 0.03;

/**
 * @typedef {object} Surface
 * @property {Float32Array} vertices u, v, z, s, t
 * @property {Uint32Array} solid triangles of what was seen
 * @property {Uint32Array} stretched triangles across jumps in depth, in the farther one's colours: a guess at what was hidden
 */

/** Grows as it is written to. */
class Numbers {
  /** @param {Float32ArrayConstructor | Uint32ArrayConstructor} kind @param {number} capacity */
  constructor(kind, capacity) {
    this.kind = kind;
    this.values = new kind(capacity);
    this.length = 0;
  }

  /** @param {number} count of numbers that are to be written @returns {number} where the first of them goes */
  add(count) {
    const first = this.length;
    this.length += count;
    if (this.length > this.values.length) {
      const larger = new this.kind(2 * this.length);
      larger.set(this.values);
      this.values = larger;
    }
    return first;
  }

  get taken() {
    return this.values.subarray(0, this.length);
  }
}

const FLOATS = 5;

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
 * cell's edge with vertices of its own, the farther one in its own colours; cells at the silhouette alike.
 * @param {import("../link/frames.js").Depth} depth @param {number} width of the picture @param {number} height
 * @returns {Surface}
 */
export function surfaceOf(depth, width, height) {
  const { width: columns, height: rows, z } = depth;
  const us = places(columns, depth.stride, width);
  const vs = places(rows, depth.stride, height);
  const vertices = new Numbers(Float32Array, FLOATS * (columns * rows + 16 * (columns + rows)));
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      vertex(vertices, us[column], vs[row], z[row * columns + column], us[column], vs[row]);
    }
  }
  const solid = new Numbers(Uint32Array, 6 * columns * rows);
  const stretched = new Numbers(Uint32Array, 1024);
  for (let row = 0; row + 1 < rows; row++) {
    for (let column = 0; column + 1 < columns; column++) {
      const first = row * columns + column;
      const below = first + columns;
      const [a, b, c, d] = [z[first], z[first + 1], z[below], z[below + 1]];
      const high = Math.max(a, b, c, d);
      if (high === 0) continue;
      const whole = a > 0 && b > 0 && c > 0 && d > 0;
      if (whole && high <= Math.min(a, b, c, d) * (1 + JUMP)) {
        twoTriangles(solid, first, first + 1, below, below + 1);
        continue;
      }
      const corners = [first, first + 1, below, below + 1];
      const seen = corners.filter((index) => z[index] > 0);
      const low = Math.min(...seen.map((index) => z[index]));
      const jump = high > low * (1 + JUMP);
      const near = seen.filter((index) => z[index] <= low * (1 + JUMP));
      extend(vertices, solid, z, corners, near, false);
      if (!jump) continue;
      const far = corners.filter((index) => z[index] > low * (1 + JUMP));
      extend(vertices, solid, z, corners, far, true);
      if (whole) stretch(vertices, stretched, z, corners, far);
    }
  }
  return {
    vertices: /** @type {Float32Array} */ (vertices.taken),
    solid: /** @type {Uint32Array} */ (solid.taken),
    stretched: /** @type {Uint32Array} */ (stretched.taken),
  };
}

/** @param {Numbers} vertices @param {number} u @param {number} v @param {number} z @param {number} s @param {number} t */
function vertex(vertices, u, v, z, s, t) {
  const at = vertices.add(FLOATS);
  const { values } = vertices;
  values[at] = u;
  values[at + 1] = v;
  values[at + 2] = z;
  values[at + 3] = s;
  values[at + 4] = t;
}

/** @param {Numbers} indices @param {number} a @param {number} b @param {number} c @param {number} d its corners, by rows */
function twoTriangles(indices, a, b, c, d) {
  const at = indices.add(6);
  const { values } = indices;
  values[at] = a;
  values[at + 1] = values[at + 4] = c;
  values[at + 2] = values[at + 3] = b;
  values[at + 5] = d;
}

/**
 * A whole cell at the depth of those corners that are `members`.
 * @param {Numbers} vertices @param {Numbers} solid @param {Float32Array} z @param {number[]} corners @param {number[]} members
 * @param {boolean} own whether it is in the members' colours everywhere
 */
function extend(vertices, solid, z, corners, members, own) {
  let mean = 0;
  for (const index of members) mean += z[index] / members.length;
  const depths = corners.map((index) => (members.includes(index) ? z[index] : mean));
  cell(vertices, solid, corners, depths, own ? members : corners);
}

/**
 * A cell from the near corners to the far ones.
 * @param {Numbers} vertices @param {Numbers} stretched @param {Float32Array} z @param {number[]} corners @param {number[]} far
 */
function stretch(vertices, stretched, z, corners, far) {
  cell(vertices, stretched, corners, corners.map((index) => z[index]), far);
}

/**
 * Four vertices and two triangles; a corner that does not colour itself takes its neighbour's colour.
 * @param {Numbers} vertices @param {Numbers} indices @param {number[]} corners @param {number[]} depths @param {number[]} colouring
 */
function cell(vertices, indices, corners, depths, colouring) {
  const start = vertices.length / FLOATS;
  corners.forEach((index, place) => {
    const [u, v] = vertices.values.subarray(FLOATS * index, FLOATS * index + 2);
    const from = [place, place ^ 1, place ^ 2, place ^ 3].find((other) => colouring.includes(corners[other])) ?? place;
    const [s, t] = vertices.values.subarray(FLOATS * corners[from], FLOATS * corners[from] + 2);
    vertex(vertices, u, v, depths[place], s, t);
  });
  twoTriangles(indices, start, start + 1, start + 2, start + 3);
}

/** A picture without depth: a plane at `z`. @param {number} width @param {number} height @param {number} z @returns {Surface} */
export function planeOf(width, height, z) {
  return {
    vertices: new Float32Array([
      ...[0, 0, z, 0, 0], ...[width, 0, z, width, 0], ...[0, height, z, 0, height], ...[width, height, z, width, height],
    ]),
    solid: new Uint32Array([0, 2, 1, 1, 2, 3]),
    stretched: new Uint32Array(0),
  };
}
