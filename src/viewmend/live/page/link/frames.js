// Parses binary messages: "VMF1", the length of the header, the header in JSON, and the parts that it lists.

/**
 * @typedef {object} Header docs/live-protocol.md explains the fields
 * @property {number} frame
 * @property {number} look
 * @property {number} sent_ms
 * @property {number} time
 * @property {number} width
 * @property {number} height
 * @property {boolean} full
 * @property {{K: number[], R: number[], T: number[]}[]} cameras
 * @property {string[]} source_views
 * @property {string[]} input_views
 * @property {number[][]} [colours]
 * @property {number} holes
 * @property {Record<string, number>} stage_ms
 * @property {number} dropped
 * @property {any[]} parts
 */

/** The bytes of a message's mark, and of the length after it. */
const PREFIX_BYTES = 8;
/** The largest quantised inverse depth; 0 stands for no surface. */
const DEPTH_STEPS = 65534;

/** @typedef {{about: any, bytes: Uint8Array}} Part `about`: its entry in the header */

/** @param {ArrayBuffer} message @returns {{header: Header, parts: Part[], bytes: number}} */
export function parseFrame(message) {
  const mark = new TextDecoder().decode(new Uint8Array(message, 0, Math.min(4, message.byteLength)));
  if (mark !== "VMF1") throw new Error(`expected a frame that begins with VMF1, got ${JSON.stringify(mark)}`);
  const length = new DataView(message).getUint32(4, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(message, PREFIX_BYTES, length)));
  let offset = PREFIX_BYTES + length;
  const parts = header.parts.map((/** @type {any} */ about) => {
    const bytes = new Uint8Array(message, offset, about.bytes);
    offset += about.bytes;
    return { about, bytes };
  });
  return { header, parts, bytes: message.byteLength };
}

/**
 * @typedef {object} Depth
 * @property {number} width
 * @property {number} height
 * @property {number} stride image pixels per depth pixel
 * @property {Float32Array} z metres, 0 where there is no surface
 */

/**
 * Decode a depth map. It is stored as differences along each row of the quantised inverse depth.
 * @param {Part} part
 * @returns {Promise<Depth>}
 */
export async function decodeDepth({ about, bytes }) {
  const blob = new Blob([/** @type {any} */ (bytes)]);
  const stream = blob.stream().pipeThrough(new DecompressionStream("deflate"));
  const deltas = new DataView(await new Response(stream).arrayBuffer());
  const { width, height, stride, near_m: near, far_m: far } = about;
  const z = new Float32Array(width * height);
  const start = 1 / far;
  const step = (1 / near - 1 / far) / DEPTH_STEPS;
  let index = 0;
  for (let row = 0; row < height; row++) {
    let q = 0;
    for (let column = 0; column < width; column++, index++) {
      q = (q + deltas.getUint16(2 * index, true)) & 0xffff;
      z[index] = q === 0 ? 0 : 1 / (start + (q - 1) * step);
    }
  }
  return { width, height, stride, z };
}
