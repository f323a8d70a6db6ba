// Fetches the assets of frames and prepares them for WebGL, in a worker.

import { parseFrame } from "./frames.js";
import { decodeJpeg } from "./pictures.js";

/**
 * A request that failed is repeated after about this long, in milliseconds; each further wait is twice as
 * long.
 */
const RETRY_MS = 100;
/** A request is repeated at most this often. */
const MAX_RETRIES = 3;
/** Status codes of a server that is too busy to answer. */
const BUSY = [429, 503];
/** The cached files have at most this many bytes. */
const MAX_CACHED_BYTES = 2 ** 27;

/**
 * @typedef {object} Shape
 * @property {any} header
 * @property {Float32Array} positions metres, three per vertex
 * @property {Float32Array} normals unit vectors that point outward
 * @property {Uint8Array} colours RGB and 255
 * @property {Uint32Array} faces
 */

/** @typedef {{picture: ImageBitmap, mask: Uint8Array}} CameraImage */

/**
 * @typedef {object} Order a request of the page
 * @property {string} key
 * @property {string} url
 * @property {any} [camera] of an image: its entry in the shape
 * @property {boolean} [keep] whether the file is cached as it was received
 */

/**
 * @typedef {object} Result what the worker answers
 * @property {string} key of the order
 * @property {Shape} [shape]
 * @property {CameraImage} [image]
 * @property {number} [bytes] that were received
 * @property {string} [failed] the error
 */

/**
 * The fetched files by URL, so that a performance can be played again without the network.
 * @type {Map<string, ArrayBuffer>}
 */
const cache = new Map();
let cachedBytes = 0;

/** @param {Uint8Array} bytes @returns {Promise<Uint8Array>} */
async function inflate(bytes) {
  const blob = new Blob([/** @type {any} */ (bytes)]);
  const stream = blob.stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/**
 * Decode the integers of a part, row by row. They are stored as differences within each column, with the sign
 * in the lowest bit, in four planes of bytes.
 * @param {import("./frames.js").Part} part
 * @returns {Promise<Int32Array>}
 */
async function decodeDifferences({ about: { rows, columns }, bytes }) {
  const planes = await inflate(bytes);
  const count = rows * columns;
  const values = new Int32Array(count);
  let from = 0;
  for (let column = 0; column < columns; column++) {
    let last = 0;
    let at = column;
    for (let row = 0; row < rows; row++, from++, at += columns) {
      const low = planes[from] | (planes[from + count] << 8);
      const folded = low | (planes[from + 2 * count] << 16) | (planes[from + 3 * count] << 24);
      last += (folded >>> 1) ^ -(folded & 1);
      values[at] = last;
    }
  }
  return values;
}

/**
 * Compute the normals of the vertices: area-weighted means of the faces around each.
 * @param {Float32Array} positions
 * @param {Uint32Array} faces
 */
function computeNormals(positions, faces) {
  const normals = new Float32Array(positions.length);

  // add the cross product of two edges of each face to its corners
  for (let f = 0; f < faces.length; f += 3) {
    const a = 3 * faces[f];
    const b = 3 * faces[f + 1];
    const c = 3 * faces[f + 2];
    const ux = positions[b] - positions[a];
    const uy = positions[b + 1] - positions[a + 1];
    const uz = positions[b + 2] - positions[a + 2];
    const vx = positions[c] - positions[a];
    const vy = positions[c + 1] - positions[a + 1];
    const vz = positions[c + 2] - positions[a + 2];
    const x = uy * vz - uz * vy;
    const y = uz * vx - ux * vz;
    const z = ux * vy - uy * vx;
    for (const corner of [a, b, c]) {
      normals[corner] += x;
      normals[corner + 1] += y;
      normals[corner + 2] += z;
    }
  }

  // normalise
  for (let v = 0; v < normals.length; v += 3) {
    const length = Math.hypot(normals[v], normals[v + 1], normals[v + 2]) || 1;
    for (let axis = 0; axis < 3; axis++) normals[v + axis] /= length;
  }
  return normals;
}

/** @param {ArrayBuffer} content @returns {Promise<Shape>} */
async function decodeShape(content) {
  const { header, parts } = parseFrame(content);
  const byKind = Object.fromEntries(parts.map((part) => [part.about.kind, part]));
  const [steps, faces, rgb] = await Promise.all([
    decodeDifferences(byKind.positions),
    decodeDifferences(byKind.faces),
    decodeDifferences(byKind.colours),
  ]);
  const { low, step } = byKind.positions.about;
  const positions = Float32Array.from(steps, (value, at) => low[at % 3] + value * step[at % 3]);
  const colours = new Uint8Array((4 * rgb.length) / 3).fill(255);
  for (let at = 0; at < rgb.length; at++) colours[at + Math.floor(at / 3)] = rgb[at];
  const indices = new Uint32Array(faces.buffer);
  return { header, positions, normals: computeNormals(positions, indices), colours, faces: indices };
}

/**
 * @param {ArrayBuffer} content a JPEG, and after it the compressed mask
 * @param {any} camera
 * @returns {Promise<CameraImage>}
 */
async function decodeImage(content, camera) {
  const jpeg = new Uint8Array(content, 0, camera.jpeg_bytes);
  const compressedMask = new Uint8Array(content, camera.jpeg_bytes);
  const [picture, mask] = await Promise.all([decodeJpeg(jpeg), inflate(compressedMask)]);
  return { picture, mask };
}

/**
 * Fetch a file, and try again if the server is too busy.
 * @param {string} url
 * @returns {Promise<Response>}
 */
async function fetchWithRetries(url) {
  for (let retries = MAX_RETRIES; ; retries--) {
    const response = await fetch(url).catch((error) => (retries > 0 ? null : Promise.reject(error)));
    if (response?.ok) return response;
    if (response && (!BUSY.includes(response.status) || retries === 0)) {
      throw new Error(`the server answered ${response.status}`);
    }
    const wait = (1 + Math.random()) * RETRY_MS * 2 ** (MAX_RETRIES - retries);
    await new Promise((resolve) => setTimeout(resolve, wait));
  }
}

/**
 * Fetch and decode an asset.
 * @param {Order} order
 * @returns {Promise<{result: Result, transfer: Transferable[]}>}
 */
async function fetchAsset({ key, url, camera, keep }) {
  const content = cache.get(url) ?? (await (await fetchWithRetries(url)).arrayBuffer());
  const bytes = content.byteLength;
  if (keep && !cache.has(url) && cachedBytes + bytes <= MAX_CACHED_BYTES) {
    cache.set(url, content);
    cachedBytes += bytes;
  }
  if (camera) {
    const image = await decodeImage(content, camera);
    return { result: { key, image, bytes }, transfer: [image.picture, image.mask.buffer] };
  }
  const shape = await decodeShape(content);
  const arrays = [shape.positions, shape.normals, shape.colours, shape.faces];
  return { result: { key, shape, bytes }, transfer: arrays.map((array) => array.buffer) };
}

onmessage = async ({ data: order }) => {
  try {
    const { result, transfer } = await fetchAsset(order);
    postMessage(result, /** @type {any} */ (transfer));
  } catch (error) {
    postMessage({ key: order.key, failed: String(/** @type {Error} */ (error).message ?? error) });
  }
};
