// Writes an MP4 file with one video track (ISO/IEC 14496-12): all samples are in one chunk, after the tables.

/** Times in the file have this many units per second. */
const TIMESCALE = 90000;
/** The identity as a track's matrix, in 16.16 fixed point; its last element is in 2.30. */
const MATRIX = [0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000];

/**
 * Pack values in four bytes each, big-endian.
 * @param {number[]} values
 * @returns {Uint8Array}
 */
function packWords(...values) {
  const out = new DataView(new ArrayBuffer(4 * values.length));
  values.forEach((value, n) => out.setUint32(4 * n, value));
  return new Uint8Array(out.buffer);
}

/**
 * Pack values in two bytes each, big-endian.
 * @param {number[]} values
 * @returns {Uint8Array}
 */
function packHalves(...values) {
  const out = new DataView(new ArrayBuffer(2 * values.length));
  values.forEach((value, n) => out.setUint16(2 * n, value));
  return new Uint8Array(out.buffer);
}

/** @param {string} text */
const encodeAscii = (text) => Uint8Array.from(text, (character) => character.charCodeAt(0));

/** @param {Uint8Array[]} parts @returns {Uint8Array} */
function concatenate(parts) {
  const out = new Uint8Array(parts.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of parts) {
    out.set(part, at);
    at += part.length;
  }
  return out;
}

/**
 * Build a box.
 * @param {string} kind four letters
 * @param {Uint8Array[]} parts
 */
function buildBox(kind, ...parts) {
  const content = concatenate(parts);
  return concatenate([packWords(8 + content.length), encodeAscii(kind), content]);
}

/**
 * Build a box with version 0 and flags.
 * @param {string} kind
 * @param {number} flags
 * @param {Uint8Array[]} parts
 */
const buildFullBox = (kind, flags, ...parts) => buildBox(kind, packWords(flags), ...parts);

/**
 * Build the description of the coding.
 * @param {string} codec
 * @param {Uint8Array | null} description
 * @param {number} width
 * @param {number} height
 */
function buildSampleEntry(codec, description, width, height) {
  const isAvc = codec.startsWith("avc1");
  const compressor = new Uint8Array(32);
  const visual = [
    packWords(0, 1),
    packHalves(0, 0),
    packWords(0, 0, 0),
    packHalves(width, height),
    packWords(0x480000, 0x480000, 0),
    packHalves(1),
    compressor,
    packHalves(24, 0xffff),
  ];
  // VP9: profile 0, level 4, 8 bits, 4:2:0, limited range
  const settings = isAvc
    ? buildBox("avcC", description ?? new Uint8Array(0))
    : buildBox("vpcC", packWords(0x01000000), Uint8Array.of(0, 40, 0x82, 2, 2, 2, 0, 0));
  return buildBox(isAvc ? "avc1" : "vp09", ...visual, settings);
}

/**
 * Write the file.
 * @param {{bytes: Uint8Array, key: boolean}[]} samples in order, all of the same length
 * @param {{width: number, height: number, fps: number, codec: string, description: Uint8Array | null}} about
 * @returns {Uint8Array}
 */
export function writeMp4(samples, { width, height, fps, codec, description }) {
  const step = Math.round(TIMESCALE / fps);
  const duration = step * samples.length;
  const keys = samples.flatMap(({ key }, n) => (key ? [n + 1] : []));
  const buildTables = (/** @type {number} */ offset) => {
    const tables = buildBox(
      "stbl",
      buildFullBox("stsd", 0, packWords(1), buildSampleEntry(codec, description, width, height)),
      buildFullBox("stts", 0, packWords(1, samples.length, step)),
      buildFullBox("stss", 0, packWords(keys.length, ...keys)),
      buildFullBox("stsc", 0, packWords(1, 1, samples.length, 1)),
      buildFullBox("stsz", 0, packWords(0, samples.length, ...samples.map(({ bytes }) => bytes.length))),
      buildFullBox("stco", 0, packWords(1, offset)),
    );
    const source = buildBox("dinf", buildFullBox("dref", 0, packWords(1), buildFullBox("url ", 1)));
    const media = buildBox(
      "mdia",
      buildFullBox("mdhd", 0, packWords(0, 0, TIMESCALE, duration), packHalves(0x55c4, 0)), // language "und"
      buildFullBox("hdlr", 0, packWords(0), encodeAscii("vide"), packWords(0, 0, 0), Uint8Array.of(0)),
      buildBox("minf", buildFullBox("vmhd", 1, packWords(0, 0)), source, tables),
    );
    const size = [width << 16, height << 16];
    const track = buildFullBox("tkhd", 3, packWords(0, 0, 1, 0, duration, 0, 0, 0, 0, ...MATRIX, ...size));
    const rateAndVolume = [0x10000, 0x1000000];
    const movie = buildFullBox(
      "mvhd",
      0,
      packWords(0, 0, TIMESCALE, duration, ...rateAndVolume, 0, 0, ...MATRIX, 0, 0, 0, 0, 0, 0, 2),
    );
    const fileType = buildBox("ftyp", encodeAscii("isom"), packWords(512), encodeAscii("isomiso2mp41"));
    return concatenate([fileType, buildBox("moov", movie, buildBox("trak", track, media))]);
  };

  // the samples begin after the tables and the head of their box
  const start = buildTables(0).length + 8;
  return concatenate([buildTables(start), buildBox("mdat", ...samples.map(({ bytes }) => bytes))]);
}
