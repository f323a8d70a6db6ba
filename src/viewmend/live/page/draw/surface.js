// The depth of an image as triangles. A vertex has a position (u, v, z), in pixels of the image and metres,
// and the pixel (s, t) that colours it.

/** Neighbours whose depths differ by more than this share lie on two surfaces. */
const JUMP = 0.03;
/** A vertex has this many numbers: u, v, z, s, t. */
const FLOATS = 5;

/**
 * @typedef {object} Surface
 * @property {Float32Array} vertices u, v, z, s, t of each
 * @property {Uint32Array} solid triangles of the surfaces that were seen
 * @property {Uint32Array} stretched triangles across jumps in depth, in the colours of the farther surface: a
 *   guess at what was hidden
 */

/** A typed array that grows as numbers are added. */
class GrowingArray {
  /** @param {Float32ArrayConstructor | Uint32ArrayConstructor} kind @param {number} capacity */
  constructor(kind, capacity) {
    this.kind = kind;
    this.values = new kind(capacity);
    this.length = 0;
  }

  /**
   * Make room for more numbers.
   * @param {number} count
   * @returns {number} the index of the first of them
   */
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

  /** The numbers that were added. */
  get content() {
    return this.values.subarray(0, this.length);
  }
}

/**
 * Compute the pixel positions of the columns or rows of a depth map; the outermost lie on the edge of the
 * image.
 * @param {number} count of columns or rows
 * @param {number} stride image pixels per depth pixel
 * @param {number} size of the image, pixels
 */
function computePositions(count, stride, size) {
  const half = Math.floor(stride / 2);
  const positions = Array.from({ length: count }, (_, i) => Math.min(stride * i + half, size - 1) + 0.5);
  positions[0] = 0;
  positions[count - 1] = size;
  return positions;
}

/**
 * Triangulate a depth map. Cells of one surface share the vertices of the grid. In a cell across a jump in
 * depth, each of the two surfaces continues to the edge of the cell with vertices of its own, the farther one
 * in its own colours. Cells at the silhouette are treated alike.
 * @param {import("../link/frames.js").Depth} depth
 * @param {number} width of the image, pixels
 * @param {number} height
 * @returns {Surface}
 */
export function buildSurface(depth, width, height) {
  const { width: columns, height: rows, z } = depth;

  // one vertex per depth pixel
  const us = computePositions(columns, depth.stride, width);
  const vs = computePositions(rows, depth.stride, height);
  const vertices = new GrowingArray(Float32Array, FLOATS * (columns * rows + 16 * (columns + rows)));
  for (let row = 0; row < rows; row++) {
    for (let column = 0; column < columns; column++) {
      addVertex(vertices, us[column], vs[row], z[row * columns + column], us[column], vs[row]);
    }
  }

  // two triangles per cell of one surface, and more per cell across a jump
  const solid = new GrowingArray(Uint32Array, 6 * columns * rows);
  const stretched = new GrowingArray(Uint32Array, 1024);
  for (let row = 0; row + 1 < rows; row++) {
    for (let column = 0; column + 1 < columns; column++) {
      const first = row * columns + column;
      const below = first + columns;
      const a = z[first];
      const b = z[first + 1];
      const c = z[below];
      const d = z[below + 1];
      const high = Math.max(a, b, c, d);
      if (high === 0) continue;
      const whole = a > 0 && b > 0 && c > 0 && d > 0;
      if (whole && high <= Math.min(a, b, c, d) * (1 + JUMP)) {
        addTriangles(solid, first, first + 1, below, below + 1);
        continue;
      }
      const corners = [first, first + 1, below, below + 1];
      const seen = corners.filter((index) => z[index] > 0);
      const low = Math.min(...seen.map((index) => z[index]));
      const jump = high > low * (1 + JUMP);
      const near = seen.filter((index) => z[index] <= low * (1 + JUMP));
      addExtendedCell(vertices, solid, z, corners, near, false);
      if (!jump) continue;
      const far = corners.filter((index) => z[index] > low * (1 + JUMP));
      addExtendedCell(vertices, solid, z, corners, far, true);
      if (whole) addStretchedCell(vertices, stretched, z, corners, far);
    }
  }
  return {
    vertices: /** @type {Float32Array} */ (vertices.content),
    solid: /** @type {Uint32Array} */ (solid.content),
    stretched: /** @type {Uint32Array} */ (stretched.content),
  };
}

/**
 * @param {GrowingArray} vertices
 * @param {number} u
 * @param {number} v
 * @param {number} z
 * @param {number} s
 * @param {number} t
 */
function addVertex(vertices, u, v, z, s, t) {
  const at = vertices.add(FLOATS);
  const { values } = vertices;
  values[at] = u;
  values[at + 1] = v;
  values[at + 2] = z;
  values[at + 3] = s;
  values[at + 4] = t;
}

/**
 * @param {GrowingArray} indices
 * @param {number} a
 * @param {number} b
 * @param {number} c
 * @param {number} d its corners, by rows
 */
function addTriangles(indices, a, b, c, d) {
  const at = indices.add(6);
  const { values } = indices;
  values[at] = a;
  values[at + 1] = c;
  values[at + 2] = b;
  values[at + 3] = b;
  values[at + 4] = c;
  values[at + 5] = d;
}

/**
 * Add a whole cell of the surface that only some of its corners belong to; the others get its mean depth.
 * @param {GrowingArray} vertices
 * @param {GrowingArray} solid
 * @param {Float32Array} z
 * @param {number[]} corners
 * @param {number[]} members corners that belong to the surface
 * @param {boolean} own whether all corners get the colours of the members
 */
function addExtendedCell(vertices, solid, z, corners, members, own) {
  let mean = 0;
  for (const index of members) {
    mean += z[index] / members.length;
  }
  const depths = corners.map((index) => (members.includes(index) ? z[index] : mean));
  addCell(vertices, solid, corners, depths, own ? members : corners);
}

/**
 * Add a cell between the near corners and the far ones.
 * @param {GrowingArray} vertices
 * @param {GrowingArray} stretched
 * @param {Float32Array} z
 * @param {number[]} corners
 * @param {number[]} far
 */
function addStretchedCell(vertices, stretched, z, corners, far) {
  const depths = corners.map((index) => z[index]);
  addCell(vertices, stretched, corners, depths, far);
}

/**
 * Add four vertices and two triangles; a corner outside `colouring` gets the colour of a neighbour.
 * @param {GrowingArray} vertices
 * @param {GrowingArray} indices
 * @param {number[]} corners
 * @param {number[]} depths
 * @param {number[]} colouring
 */
function addCell(vertices, indices, corners, depths, colouring) {
  const start = vertices.length / FLOATS;
  corners.forEach((index, corner) => {
    const [u, v] = vertices.values.subarray(FLOATS * index, FLOATS * index + 2);
    const neighbours = [corner, corner ^ 1, corner ^ 2, corner ^ 3];
    const from = neighbours.find((other) => colouring.includes(corners[other])) ?? corner;
    const [s, t] = vertices.values.subarray(FLOATS * corners[from], FLOATS * corners[from] + 2);
    addVertex(vertices, u, v, depths[corner], s, t);
  });
  addTriangles(indices, start, start + 1, start + 2, start + 3);
}

/**
 * Build the surface of an image without depth: a plane at `z`.
 * @param {number} width
 * @param {number} height
 * @param {number} z
 * @returns {Surface}
 */
export function buildPlane(width, height, z) {
  return {
    vertices: new Float32Array([
      0, 0, z, 0, 0,
      width, 0, z, width, 0,
      0, height, z, 0, height,
      width, height, z, width, height,
    ]),
    solid: new Uint32Array([0, 2, 1, 1, 2, 3]),
    stretched: new Uint32Array(0),
  };
}
