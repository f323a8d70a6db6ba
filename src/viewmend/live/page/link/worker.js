// The socket, and the decoders of its messages. They run in a worker, because on the page's thread every step
// of a decoder would wait for a repaint.

import { decodeDepth, parseFrame } from "./frames.js";
import { PictureDecoder } from "./pictures.js";
import { buildSurface } from "../draw/surface.js";

/**
 * @typedef {{open: string} | {send: string} | {close: string} | {taken: true}} Command open a socket to a URL
 *   in place of the last one, send a text, close the socket with a reason, or note that the page has taken a
 *   frame
 * @typedef {import("../draw/stage.js").Shown & {bytes: number}} Picture
 * @typedef {{opened: true} | {closed: {code: number, reason: string}} | {text: string} | {picture: Picture}
 *   | {undecodable: string}} Report
 */

/** The server is asked for a sign of life at this interval, in milliseconds. */
const PING_MS = 5000;
/** After this many requests without any message of the server, the connection counts as broken. */
const MAX_UNANSWERED = 3;
/** WebSocket's close code of a connection that broke. */
const ABNORMAL_CLOSURE = 1006;

/** @type {WebSocket | null} */
let socket = null;
let decoder = new PictureDecoder();
/** Resolves when all frames so far were delivered. */
let queue = Promise.resolve();
/** Frames that the page has not taken yet. They must not accumulate if the page repaints slowly. */
let untaken = 0;
/** Acknowledges the second of them, after the page has taken the first. @type {(() => void) | null} */
let acknowledgeNext = null;

/** @param {Report} report @param {Transferable[]} [transfer] */
const post = (report, transfer = []) => postMessage(report, /** @type {any} */ (transfer));

/** @param {string} url */
function open(url) {
  socket?.close(1000, "another one");
  const own = new WebSocket(url);
  own.binaryType = "arraybuffer";
  socket = own;
  decoder.close();
  decoder = new PictureDecoder();
  untaken = 0;
  acknowledgeNext = null;
  let unanswered = 0;
  let timer = 0;
  const end = (/** @type {{code: number, reason: string}} */ { code, reason }) => {
    clearInterval(timer);
    if (socket !== own) return;
    socket = null;
    post({ closed: { code, reason } });
  };
  // without a close, the browser notices a broken connection after many minutes
  const ping = () => {
    if (unanswered === MAX_UNANSWERED) {
      end({ code: ABNORMAL_CLOSURE, reason: "" });
      own.close();
    } else if (own.readyState === WebSocket.OPEN) {
      unanswered += 1;
      own.send(JSON.stringify({ type: "ping", sent_ms: performance.now() }));
    }
  };
  own.onopen = () => post({ opened: true });
  own.onclose = end;
  own.onmessage = ({ data }) => {
    if (socket !== own) return;
    unanswered = 0;
    timer ||= setInterval(ping, PING_MS); // not before the page's hello
    if (typeof data === "string") post({ text: data });
    else receiveFrame(own, data);
  };
}

/**
 * Decode a frame; frames are decoded in parallel and delivered in order.
 * @param {WebSocket} from
 * @param {ArrayBuffer} message
 */
function receiveFrame(from, message) {
  const frame = parseFrame(message);

  // acknowledge it now if the page has taken all others, else later
  const acknowledge = () => {
    if (from.readyState !== WebSocket.OPEN) return;
    from.send(JSON.stringify({ type: "ack", frame: frame.header.frame }));
  };
  untaken += 1;
  if (untaken === 1) acknowledge();
  else acknowledgeNext = acknowledge;

  // decode and deliver it
  const decoded = decode(frame);
  decoded.catch(() => {});
  queue = queue
    .then(async () => {
      const { eyes, transfer } = await decoded;
      post({ picture: { header: frame.header, eyes, bytes: frame.bytes } }, transfer);
    })
    .catch((error) => {
      if (socket !== from) return;
      countTaken();
      post({ undecodable: String(error.message ?? error) });
    });
}

/** Note that the page has taken a frame, or that there is none to take: the server may send the next one. */
function countTaken() {
  untaken = Math.max(0, untaken - 1);
  acknowledgeNext?.();
  acknowledgeNext = null;
}

/** @param {ReturnType<typeof parseFrame>} frame */
async function decode({ header, parts }) {
  const eyes = header.cameras.map(() => {
    return { modes: /** @type {any} */ ({}), surface: /** @type {any} */ (null) };
  });
  /** @type {Transferable[]} */
  const transfer = [];
  const decodePart = async (/** @type {import("./frames.js").Part} */ part) => {
    const eye = eyes[part.about.eye ?? 0];
    if (part.about.kind === "image") {
      const image = await decoder.decode(part, header.frame);
      eye.modes[part.about.mode] = image;
      transfer.push(image);
    } else if (part.about.kind === "depth") {
      const surface = buildSurface(await decodeDepth(part), header.width, header.height);
      eye.surface = surface;
      transfer.push(surface.vertices.buffer, surface.solid.buffer, surface.stretched.buffer);
    }
  };
  await Promise.all(parts.map(decodePart));
  return { eyes, transfer };
}

onmessage = ({ data: command }) => {
  if ("open" in command) open(command.open);
  else if ("send" in command) socket?.send(command.send);
  else if ("taken" in command) countTaken();
  else socket?.close(1000, command.close);
};
