// Fetches the assets of frames and makes them ready for WebGL, in a thread of its own.

import { parseFrame } from "./frames.js";
import { decodeJpeg } from "./pictures.js";

const RETRY_MS = 100;

/**
 * @typedef {object} Shape
 * @property {any} header
 * @property {Float32Array} positions metres, three per vertex
 * @property {Float32Array} normals unit, outward
 * @property {Uint8Array} colours RGB and 255
 * @property {Uint32Array} faces
 */
/** @typedef {{picture: ImageBitmap, mask: Uint8Array}} CameraImage */
/** @typedef {{key: string, url: string, camera?: any, keeps?: boolean}} Order `camera`: its entry in the shape, for an image; `keeps`: files are kept as they came */
/** @typedef {{key: string, shape?: Shape, image?: CameraImage, bytes?: number, failed?: string}} News */

/** Files that were fetched, by address, and their bytes in all: a performance that is played again needs no network. @type {Map<string, ArrayBuffer>} */
const kept = new Map();
const MOST_KEPT_BYTES = 2 ** 27;
let keptBytes = 0;

/** @param {Uint8Array} bytes @returns {Promise<Uint8Array>} */
async function inflate(bytes) {
  const stream = new Blob([/** @type {any} */ (bytes)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Integers of a part, row by row. @param {import("./frames.js").Part} part @returns {Promise<Int32Array>} */
export async function readDifferences({ about: { rows, columns }, bytes }) {
  const planes = await inflate(bytes);
  const [count, values] = [rows * columns, new Int32Array(rows * columns)];
  for (let column = 0, from = 0; column < columns; column++) {
    for (let row = 0, last = 0, at = column; row < rows; row++, from++, at += columns) {
      const folded = planes[from] | (planes[from + count] << 8) | (planes[from + 2 * count] << 16) | (planes[from + 3 * count] << 24);
      last += (folded >>> 1) ^ -(folded & 1);
      values[at] = last;
    }
  }
  return values;
}

/** Area-weighted means of the faces around each vertex. @param {Float32Array} positions @param {Uint32Array} faces */
export function vertexNormals(positions, faces) {
  const normals = new Float32Array(positions.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]];
    const [ux, uy, uz] = [positions[b] - positions[a], positions[b + 1] - positions[a + 1], positions[b + 2] - positions[a + 2]];
    const [vx, vy, vz] = [positions[c] - positions[a], positions[c + 1] - positions[a + 1], positions[c + 2] - positions[a + 2]];
    const [x, y, z] = [uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx];
    for (const corner of [a, b, c]) {
      normals[corner] += x;
      normals[corner + 1] += y;
      normals[corner + 2] += z;
    }
  }
  for (let v = 0; v < normals.length; v += 3) {
    const long = Math.hypot(normals[v], normals[v + 1], normals[v + 2]) || 1;
    for (let axis = 0; axis < 3; axis++) normals[v + axis] /= long;
  }
  return normals;
}

/** @param {ArrayBuffer} content @returns {Promise<Shape>} */
async function readShape(content) {
  const { header, parts } = parseFrame(content);
  const named = Object.fromEntries(parts.map((part) => [part.about.kind, part]));
  const [whole, faces, rgb] = await Promise.all(["positions", "faces", "colours"].map((kind) => readDifferences(named[kind])));
  const { low, step } = named.positions.about;
  const positions = Float32Array.from(whole, (value, at) => low[at % 3] + value * step[at % 3]);
  const colours = new Uint8Array((4 * rgb.length) / 3).fill(255);
  for (let at = 0; at < rgb.length; at++) colours[at + Math.floor(at / 3)] = rgb[at];
  const indices = new Uint32Array(faces.buffer);
  return { header, positions, normals: vertexNormals(positions, indices), colours, faces: indices };
}

/** @param {ArrayBuffer} content @param {any} camera @returns {Promise<CameraImage>} */
async function readImage(content, camera) {
  const [jpeg, packed] = [new Uint8Array(content, 0, camera.jpeg_bytes), new Uint8Array(content, camera.jpeg_bytes)];
  const [picture, mask] = await Promise.all([decodeJpeg(jpeg), inflate(packed)]);
  return { picture, mask };
}

/** Tries again a little later where the server is too busy to answer. @param {string} url @returns {Promise<Response>} */
async function fetchPatiently(url) {
  for (let retries = 3; ; retries--) {
    const answer = await fetch(url).catch((error) => (retries > 0 ? null : Promise.reject(error)));
    if (answer?.ok) return answer;
    if (answer && (![429, 503].includes(answer.status) || retries === 0)) throw new Error(`the server answered ${answer.status}`);
    await new Promise((resolve) => setTimeout(resolve, (1 + Math.random()) * RETRY_MS * 2 ** (3 - retries)));
  }
}

/** @param {Order} order @returns {Promise<{news: News, transfer: Transferable[]}>} */
async function carryOut({ key, url, camera, keeps }) {
  const content = kept.get(url) ?? (await (await fetchPatiently(url)).arrayBuffer());
  if (keeps && !kept.has(url) && keptBytes + content.byteLength <= MOST_KEPT_BYTES) {
    kept.set(url, content);
    keptBytes += content.byteLength;
  }
  const bytes = content.byteLength;
  if (camera) {
    const image = await readImage(content, camera);
    return { news: { key, image, bytes }, transfer: [image.picture, image.mask.buffer] };
  }
  const shape = await readShape(content);
  const { positions, normals, colours, faces } = shape;
  return { news: { key, shape, bytes }, transfer: [positions.buffer, normals.buffer, colours.buffer, faces.buffer] };
}

onmessage = async ({ data: order }) => {
  try {
    const { news, transfer } = await carryOut(order);
    postMessage(news, /** @type {any} */ (transfer));
  } catch (error) {
    postMessage({ key: order.key, failed: String(/** @type {Error} */ (error).message ?? error) });
  }
};
