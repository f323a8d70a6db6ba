// The socket, and the decoders of its messages. They run in a thread of their own: on the page's thread, every step of a
// decoder would wait for a repaint.

import { decodeDepth, parseFrame } from "./frames.js";
import { PictureDecoder } from "./pictures.js";
import { surfaceOf } from "../draw/surface.js";

/**
 * @typedef {{open: string} | {send: string} | {close: string} | {taken: true}} Order what the page wants: a socket to this
 *   address in place of the last, a text to be sent, an end with this reason; or that it has taken a picture
 * @typedef {import("../draw/stage.js").Shown & {bytes: number}} Picture
 * @typedef {{opened: true} | {closed: {code: number, reason: string}} | {text: string} | {picture: Picture} | {trouble: string}} News
 */

/** @type {WebSocket | null} */
let socket = null;
let decoder = new PictureDecoder();
let queue = Promise.resolve();
/** Pictures that came and that the page has not taken: a page that repaints slowly must not pile them up. */
let untaken = 0;
/** The acknowledgement of the second of them waits until the page has taken the first. @type {(() => void) | null} */
let heldBack = null;

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
  untaken = 0;
  heldBack = null;
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
  const acknowledge = () => {
    if (from.readyState === WebSocket.OPEN) from.send(JSON.stringify({ type: "ack", frame: frame.header.frame }));
  };
  untaken += 1;
  if (untaken === 1) acknowledge();
  else heldBack = acknowledge;
  const decoded = decode(frame);
  decoded.catch(() => {});
  queue = queue
    .then(async () => {
      const { eyes, transfer } = await decoded;
      post({ picture: { header: frame.header, eyes, bytes: frame.bytes } }, transfer);
    })
    .catch((error) => {
      if (socket !== from) return;
      letGo();
      post({ trouble: String(error.message ?? error) });
    });
}

/** The page has taken a picture, or there is none to take: the server may send the next. */
function letGo() {
  untaken = Math.max(0, untaken - 1);
  heldBack?.();
  heldBack = null;
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
  else if ("taken" in order) letGo();
  else socket?.close(1000, order.close);
};
