// The socket, and the decoders of its messages. They run in a thread of their own: on the page's thread, every step of a
// decoder would wait for a repaint.

import { decodeDepth, parseFrame } from "./frames.js";
import { PictureDecoder } from "./pictures.js";
import { surfaceOf } from "../draw/surface.js";

/**
 * @typedef {{open: string} | {send: string} | {close: string}} Order what the page wants: a socket to this address in place
 *   of the last, a text to be sent, an end with this reason
 * @typedef {import("../draw/stage.js").Shown & {bytes: number}} Picture
 * @typedef {{opened: true} | {closed: {code: number, reason: string}} | {text: string} | {picture: Picture} | {trouble: string}} News
 */

/** @type {WebSocket | null} */
let socket = null;
let decoder = new PictureDecoder();
let queue = Promise.resolve();

/** @param {News} news @param {Transferable[]} [transfer] */
const post = (news, transfer = []) => postMessage(news, /** @type {any} */ (transfer));

/** @param {string} url */
function open(url) {
  socket?.close(1000, "another one");
  const own = new WebSocket(url);
  own.binaryType = "arraybuffer";
  socket = own;
  decoder.close();
  decoder = new PictureDecoder();
  own.onopen = () => post({ opened: true });
  own.onmessage = ({ data }) => {
    if (socket !== own) return;
    if (typeof data === "string") post({ text: data });
    else take(own, data);
  };
  own.onclose = ({ code, reason }) => {
    if (socket !== own) return;
    socket = null;
    post({ closed: { code, reason } });
  };
}

/** Images are decoded in parallel and delivered in order. @param {WebSocket} from @param {ArrayBuffer} message */
function take(from, message) {
  const frame = parseFrame(message);
  if (from.readyState === WebSocket.OPEN) from.send(JSON.stringify({ type: "ack", frame: frame.header.frame }));
  const decoded = decode(frame);
  decoded.catch(() => {});
  queue = queue
    .then(async () => {
      const { eyes, transfer } = await decoded;
      post({ picture: { header: frame.header, eyes, bytes: frame.bytes } }, transfer);
    })
    .catch((error) => {
      if (socket === from) post({ trouble: String(error.message ?? error) });
    });
}

/** @param {ReturnType<typeof parseFrame>} frame */
async function decode({ header, parts }) {
  const eyes = header.cameras.map(() => ({ modes: /** @type {any} */ ({}), surface: /** @type {any} */ (null) }));
  /** @type {Transferable[]} */
  const transfer = [];
  await Promise.all(
    parts.map(async (part) => {
      const eye = eyes[part.about.eye ?? 0];
      if (part.about.kind === "image") {
        const picture = await decoder.decode(part, header.frame);
        eye.modes[part.about.mode] = picture;
        transfer.push(picture);
      } else if (part.about.kind === "depth") {
        const surface = surfaceOf(await decodeDepth(part), header.width, header.height);
        eye.surface = surface;
        transfer.push(surface.vertices.buffer, surface.solid.buffer, surface.stretched.buffer);
      }
    }),
  );
  return { eyes, transfer };
}

onmessage = ({ data: order }) => {
  if ("open" in order) open(order.open);
  else if ("send" in order) socket?.send(order.send);
  else socket?.close(1000, order.close);
};
