// An MP4 file of one video track (ISO/IEC 14496-12): all samples in one chunk, after the tables.

const TIMESCALE = 90000;
/** The identity of a track's matrix: 16.16 fixed point, its last element 2.30. */
const MATRIX = [0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000];

/** @param {number[]} values @returns {Uint8Array} big-endian, four bytes each */
function words(...values) {
  const out = new DataView(new ArrayBuffer(4 * values.length));
  values.forEach((value, n) => out.setUint32(4 * n, value));
  return new Uint8Array(out.buffer);
}

/** @param {number[]} values @returns {Uint8Array} big-endian, two bytes each */
function halves(...values) {
  const out = new DataView(new ArrayBuffer(2 * values.length));
  values.forEach((value, n) => out.setUint16(2 * n, value));
  return new Uint8Array(out.buffer);
}

/** @param {string} text */
const ascii = (text) => Uint8Array.from(text, (sign) => sign.charCodeAt(0));

/** @param {Uint8Array[]} parts @returns {Uint8Array} */
function joined(parts) {
  const out = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    out.set(part, at);
    at += part.length;
  }
  return out;
}

/** @param {string} kind four letters @param {Uint8Array[]} parts */
function box(kind, ...parts) {
  const content = joined(parts);
  return joined([words(8 + content.length), ascii(kind), content]);
}

/** A box with version 0 and flags. @param {string} kind @param {number} flags @param {Uint8Array[]} parts */
const fullBox = (kind, flags, ...parts) => box(kind, words(flags), ...parts);

/** How the samples are coded. @param {string} codec @param {Uint8Array | null} description @param {number} width @param {number} height */
function sampleEntry(codec, description, width, height) {
  const isAvc = codec.startsWith("avc1");
  const compressor = new Uint8Array(32);
  const visual = [words(0, 1), halves(0, 0), words(0, 0, 0), halves(width, height), words(0x480000, 0x480000, 0), halves(1), compressor, halves(24, 0xffff)];
  const settings = isAvc
    ? box("avcC", description ?? new Uint8Array(0))
    : box("vpcC", words(0x01000000), Uint8Array.of(0, 40, 0x82, 2, 2, 2, 0, 0)); // profile 0, level 4, 8 bits, 4:2:0, limited range
  return box(isAvc ? "avc1" : "vp09", ...visual, settings);
}

/**
 * @param {{bytes: Uint8Array, key: boolean}[]} samples in order, all of the same length
 * @param {{width: number, height: number, fps: number, codec: string, description: Uint8Array | null}} about
 * @returns {Uint8Array}
 */
export function mp4(samples, { width, height, fps, codec, description }) {
  const step = Math.round(TIMESCALE / fps);
  const duration = step * samples.length;
  const keys = samples.flatMap(({ key }, n) => (key ? [n + 1] : []));
  const build = (/** @type {number} */ offset) => {
    const tables = box(
      "stbl",
      fullBox("stsd", 0, words(1), sampleEntry(codec, description, width, height)),
      fullBox("stts", 0, words(1, samples.length, step)),
      fullBox("stss", 0, words(keys.length, ...keys)),
      fullBox("stsc", 0, words(1, 1, samples.length, 1)),
      fullBox("stsz", 0, words(0, samples.length, ...samples.map(({ bytes }) => bytes.length))),
      fullBox("stco", 0, words(1, offset)),
    );
    const source = box("dinf", fullBox("dref", 0, words(1), fullBox("url ", 1)));
    const media = box(
      "mdia",
      fullBox("mdhd", 0, words(0, 0, TIMESCALE, duration), halves(0x55c4, 0)), // language "und"
      fullBox("hdlr", 0, words(0), ascii("vide"), words(0, 0, 0), Uint8Array.of(0)),
      box("minf", fullBox("vmhd", 1, words(0, 0)), source, tables),
    );
    const track = fullBox("tkhd", 3, words(0, 0, 1, 0, duration, 0, 0, 0, 0, ...MATRIX, width << 16, height << 16));
    const movie = fullBox("mvhd", 0, words(0, 0, TIMESCALE, duration, 0x10000, 0x1000000, 0, 0, ...MATRIX, 0, 0, 0, 0, 0, 0, 2));
    return joined([box("ftyp", ascii("isom"), words(512), ascii("isomiso2mp41")), box("moov", movie, box("trak", track, media))]);
  };
  const start = build(0).length + 8;
  return joined([build(start), box("mdat", ...samples.map(({ bytes }) => bytes))]);
}
