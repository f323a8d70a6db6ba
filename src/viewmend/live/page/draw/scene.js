// Views of a frame, drawn from its mesh and the cameras' images by the rule of the server's rendering/blending.py.

import { HoleFill } from "./fill.js";
import { QUAD, buildProgram } from "./program.js";
import { clipFromWorld } from "./projection.js";
import { nearness, sourcesOf } from "../link/assets.js";
import { add, apply, multiply } from "../view/matrix.js";

/** @typedef {import("../link/assets.js").Frame} Frame */
/** @typedef {import("./projection.js").Viewpoint} Viewpoint */

/** Source images and their depths take two texture units each, of the sixteen that WebGL 2 guarantees. */
const MOST_SOURCES = 8;
/** Mark of the pixels that have their colour. */
const DONE = 1;
/** Frames whose textures are kept. */
const KEPT = 2;
/** Cameras beyond the blending rule's that fill its holes; none where the processor draws, which would take twice as long. */
export const filling = (/** @type {boolean} */ software) => (software ? 0 : 3);

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 direction;
layout(location = 2) in vec4 paint;
uniform mat4 clip;
centroid out vec3 point;
centroid out vec3 normal;
centroid out vec3 tint;
invariant gl_Position;
void main() {
  point = place;
  normal = direction;
  tint = paint.rgb;
  gl_Position = clip * vec4(place, 1.0);
}`;

const NOTHING = `#version 300 es
precision mediump float;
void main() {}`;

/** @param {number} count of source images: a sampler's index must be constant */
const blending = (count) => `#version 300 es
precision highp float;
precision highp sampler2D;
centroid in vec3 point;
centroid in vec3 normal;
centroid in vec3 tint;
out vec4 colour;
uniform vec3 eye;
uniform float bias, slope, grazing, minWeight;
uniform float closest;   // cosine between the directions to the viewer and to the closest camera; 1 where weights are absolute
uniform vec2 powers;
uniform bool leaveHoles;   // holes to the next pass
uniform bool cuts;   // the masks' mean is the view's alpha: those of completed views are closer to the outline than the mesh
uniform vec3 ground;   // colour of the background
uniform vec4 hole;    // colour of holes; that of the vertices where its alpha is 0, which then stays 0
uniform mat4 pixels[${count}];   // (u z, v z, z) of a point
uniform vec3 centers[${count}];
uniform vec3 lenses[${count}];   // focal length, and depth = y (1 - z / metres)
${Array.from({ length: count }, (_, n) => `uniform sampler2D picture${n}, depth${n};`).join("\n")}

float most = 0.0;   // sum of the weights that there would be if all were foreground

vec4 weigh(sampler2D picture, sampler2D depth, mat4 pixel, vec3 center, vec3 lens, vec3 outward, vec3 toViewer) {
  vec3 toCamera = normalize(center - point);
  float facing = min(dot(outward, toCamera), 1.0);
  float agreeing = min(dot(toViewer, toCamera), 1.0) / closest;
  vec3 h = (pixel * vec4(point, 1.0)).xyz;
  if (facing <= 0.0 || agreeing <= 0.0 || h.z <= 0.0) return vec4(0.0);
  vec2 uv = h.xy / h.z;
  ivec2 size = textureSize(picture, 0);
  if (any(lessThan(uv, vec2(0.0))) || any(greaterThanEqual(uv, vec2(size)))) return vec4(0.0);
  float perPixel = h.z / lens.x * sqrt(1.0 - facing * facing) / max(facing, grazing);
  float nearest = lens.y * (1.0 - lens.z / max(h.z - bias - slope * perPixel, 1e-4));
  vec2 low = floor(uv - 0.5);
  vec2 part = uv - 0.5 - low;
  ivec2 a = clamp(ivec2(low), ivec2(0), size - 1);
  ivec2 d = clamp(ivec2(low) + 1, ivec2(0), size - 1);
  ivec2 b = ivec2(d.x, a.y), c = ivec2(a.x, d.y);
  vec4 there = vec4(texelFetch(depth, a, 0).r, texelFetch(depth, b, 0).r, texelFetch(depth, c, 0).r, texelFetch(depth, d, 0).r);
  bvec4 visible = greaterThanEqual(there, vec4(nearest));
  vec4 seen;   // colour times mask, and mask
  float usable = 1.0;
  if (all(visible)) {
    seen = textureLod(picture, uv / vec2(size), 0.0);
  } else {
    vec4 share = vec4((1.0 - part.x) * (1.0 - part.y), part.x * (1.0 - part.y), (1.0 - part.x) * part.y, part.x * part.y);
    share *= vec4(visible);
    usable = dot(share, vec4(1.0));
    seen = share.x * texelFetch(picture, a, 0) + share.y * texelFetch(picture, b, 0)
      + share.z * texelFetch(picture, c, 0) + share.w * texelFetch(picture, d, 0);
  }
  float direct = pow(facing, powers.x) * pow(agreeing, powers.y);
  most += usable * direct;
  return seen * direct;
}

void main() {
  vec3 outward = normalize(normal);
  vec3 toViewer = normalize(eye - point);
  vec4 sum = vec4(0.0);
${Array.from(
  { length: count },
  (_, n) => `  sum += weigh(picture${n}, depth${n}, pixels[${n}], centers[${n}], lenses[${n}], outward, toViewer);`,
).join("\n")}
  float known = cuts ? most : sum.a;
  if (leaveHoles && known < minWeight) discard;
  vec3 seen = sum.rgb / max(sum.a, 1e-6);
  if (known < minWeight) colour = vec4(mix(tint, hole.rgb, hole.a), hole.a);
  else colour = vec4(cuts ? mix(ground, seen, min(1.0, sum.a / most)) : seen, 1.0);
}`;

/** Multiplied by the mask, so that bilinear samples weigh each pixel by it. */
const CUT_OUT = `#version 300 es
precision highp float;
uniform sampler2D picture, mask;
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float inside = texelFetch(mask, at, 0).r;
  colour = vec4(texelFetch(picture, at, 0).rgb * inside, inside);
}`;

const HOLES = { rendered: [0, 0, 0, 1], holes: [1, 0.15, 0.55, 1], completed: [0, 0, 0, 0], compared: [0, 0, 0, 0] };
/** Modes that are drawn here. */
export const DRAWN_MODES = Object.keys(HOLES);

export class Scene {
  /** @param {WebGL2RenderingContext} gl @param {number} fillers cameras that fill holes */
  constructor(gl, fillers) {
    this.gl = gl;
    this.fillers = fillers;
    this.depthOnly = buildProgram(gl, VERTEX, NOTHING, ["clip"]);
    this.cutOut = buildProgram(gl, QUAD, CUT_OUT, ["picture", "mask"]);
    /** @type {Map<number, ReturnType<typeof buildProgram>>} by number of sources */
    this.blends = new Map();
    /** @type {Map<Frame, any>} meshes and textures, the ones used last at the end */
    this.kept = new Map();
    this.fill = new HoleFill(gl);
    this.empty = gl.createVertexArray();
    /** Of the last view. */
    this.cost = { draws: 0, triangles: 0, textureBytes: 0 };
  }

  /** Let go of a frame's textures. @param {Frame} frame */
  drop(frame) {
    if (frame.refined) this.#release(frame.refined);
    this.#release(frame);
  }

  /** @param {Frame} frame with one of its meshes */
  #release(frame) {
    const { gl } = this;
    const own = this.kept.get(frame);
    if (!own) return;
    this.kept.delete(frame);
    gl.deleteVertexArray(own.array);
    for (const buffer of own.buffers) gl.deleteBuffer(buffer);
    for (const source of own.sources.values()) {
      gl.deleteTexture(source.picture);
      gl.deleteTexture(source.depth);
    }
  }

  /**
   * Make what a view needs; call it before anything is drawn, as it changes the framebuffer.
   * @param {Frame} frame @param {number[]} eye @param {string[]} modes that will be drawn
   */
  prepare(frame, eye, modes) {
    for (const mode of modes) {
      const drawn = this.#meshFor(frame, eye, mode);
      const own = this.kept.get(drawn) ?? this.#upload(drawn);
      this.kept.delete(drawn);
      this.kept.set(drawn, own);
      const { first, fill } = this.#sources(drawn, eye, mode);
      for (const n of [...first, ...fill]) if (!own.sources.has(n)) own.sources.set(n, this.#source(drawn, own, n));
    }
    for (const old of this.kept.keys()) if (this.kept.size > KEPT) this.#release(old);
  }

  /**
   * The frame as it is drawn: with its fused mesh if it has one, except where the view is shown as rendered. Completed views cut
   * off what the hull has too much, but cannot show what the fused mesh lacks, so they are drawn on the hull.
   * @param {Frame} frame @param {number[]} eye @param {string} mode @returns {Frame}
   */
  #meshFor(frame, eye, mode) {
    if (!frame.refined || mode === "rendered" || mode === "holes") return frame;
    const { cameras } = /** @type {any} */ (frame.shape).header;
    return this.#sources(frame, eye, mode).first.some((n) => cameras[n].completed) ? frame : frame.refined;
  }

  /** The numbers of the cameras that colour a view, of those whose images are there. @param {Frame} frame @param {number[]} eye @param {string} mode */
  #sources(frame, eye, mode) {
    const shape = /** @type {import("../link/assets.js").Shape} */ (frame.shape);
    return sourcesOf(shape, eye, mode, this.fillers, (n) => frame.images.has(n));
  }

  /** The cut-outs of all cameras' images that are there; as `prepare`. @param {Frame} frame */
  cutOuts(frame) {
    const own = this.kept.get(frame) ?? this.kept.get(/** @type {Frame} */ (frame.refined));
    const { cameras } = /** @type {any} */ (frame.shape).header;
    const real = [...frame.images.keys()].filter((n) => !cameras[n].completed);
    for (const n of real) if (!own.sources.has(n)) own.sources.set(n, this.#source(frame, own, n));
    return real.map((n) => ({ camera: cameras[n], picture: own.sources.get(n).picture }));
  }

  /** Draw into a viewport, within the current scissor. @param {Frame} wholeFrame @param {Viewpoint} viewer @param {number[]} eye @param {string} mode @param {number[]} viewport x, y, width, height in pixels, y up @param {number[]} ground colour of the background */
  draw(wholeFrame, viewer, eye, mode, viewport, ground) {
    const { gl } = this;
    const frame = this.#meshFor(wholeFrame, eye, mode);
    const own = this.kept.get(frame);
    const shape = /** @type {import("../link/assets.js").Shape} */ (frame.shape);
    const { blend, cameras } = shape.header;
    const { first, fill } = this.#sources(frame, eye, mode);
    const cuts = first.some((n) => cameras[n].completed);
    const matrix = clipFromWorld(viewer);
    gl.bindVertexArray(own.array);
    gl.enable(gl.CULL_FACE); // the mesh is closed
    const hole = /** @type {any} */ (HOLES)[mode];
    const passes = [first, fill].map((numbers) => numbers.slice(0, MOST_SOURCES).map((n) => own.sources.get(n))).filter((pass) => pass.length);
    const sources = passes.flat();
    if (passes.length > 1) {
      gl.useProgram(this.depthOnly.program);
      gl.uniformMatrix4fv(this.depthOnly.at.clip, false, matrix);
      gl.colorMask(false, false, false, false);
      gl.drawElements(gl.TRIANGLES, own.count, gl.UNSIGNED_INT, 0);
      gl.colorMask(true, true, true, true);
      gl.depthFunc(gl.EQUAL);
      gl.enable(gl.STENCIL_TEST); // other cameras fill the holes of the first pass
      gl.stencilFunc(gl.NOTEQUAL, DONE, 0xff);
      gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
    }
    passes.forEach((pass, n) => {
      const viewPower = cuts && n === 0 ? blend.completed.view_power : blend.view_power;
      const closest = cuts && n === 0 ? nearness(shape.header, eye, first[0]) : 1;
      this.#pass(own, pass, { matrix, eye, blend, viewPower, closest, hole, ground, cuts: cuts && n === 0, leaveHoles: n + 1 < passes.length });
    });
    gl.disable(gl.STENCIL_TEST);
    gl.disable(gl.CULL_FACE);
    gl.depthFunc(gl.LEQUAL);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindVertexArray(null);
    if (!hole[3]) this.fill.draw(own.box, viewer, viewport, ground);
    const textureBytes = sources.reduce((sum, { size }) => sum + 8 * size[0] * size[1], 0);
    const draws = passes.length > 1 ? 1 + passes.length : 1;
    this.cost = { draws: draws + Number(!hole[3]), triangles: (draws * own.count) / 3, textureBytes };
  }

  /** @param {any} own @param {any[]} sources @param {{matrix: Float32Array, eye: number[], blend: any, viewPower: number, closest: number, hole: number[], ground: number[], cuts: boolean, leaveHoles: boolean}} view */
  #pass(own, sources, { matrix, eye, blend, viewPower, closest, hole, ground, cuts, leaveHoles }) {
    const { gl } = this;
    const { program, at } = this.#blend(sources.length);
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.clip, false, matrix);
    gl.uniform3fv(at.eye, eye);
    gl.uniform1f(at.bias, blend.bias_m);
    gl.uniform1f(at.slope, blend.slope_px);
    gl.uniform1f(at.grazing, blend.grazing);
    gl.uniform1f(at.minWeight, blend.min_weight);
    gl.uniform1f(at.closest, closest);
    gl.uniform2f(at.powers, blend.normal_power, viewPower);
    gl.uniform3fv(at.ground, ground);
    gl.uniform1i(at.cuts, Number(cuts));
    gl.uniform1i(at.leaveHoles, Number(leaveHoles));
    gl.uniform4fv(at.hole, hole);
    sources.forEach((source, n) => {
      gl.uniformMatrix4fv(at[`pixels[${n}]`], false, source.pixels);
      gl.uniform3fv(at[`centers[${n}]`], source.center);
      gl.uniform3fv(at[`lenses[${n}]`], source.lens);
      this.#bind(2 * n, source.picture, at[`picture${n}`]);
      this.#bind(2 * n + 1, source.depth, at[`depth${n}`]);
    });
    gl.drawElements(gl.TRIANGLES, own.count, gl.UNSIGNED_INT, 0);
  }

  /** @param {number} unit @param {WebGLTexture} texture @param {WebGLUniformLocation} at */
  #bind(unit, texture, at) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(at, unit);
  }

  /** @param {number} count */
  #blend(count) {
    const known = this.blends.get(count);
    if (known) return known;
    const each = (/** @type {(n: number) => string[]} */ names) => Array.from({ length: count }, (_, n) => names(n)).flat();
    const uniforms = ["clip", "eye", "bias", "slope", "grazing", "minWeight", "closest", "powers", "leaveHoles", "cuts", "ground", "hole"];
    const perSource = each((n) => [`pixels[${n}]`, `centers[${n}]`, `lenses[${n}]`, `picture${n}`, `depth${n}`]);
    const made = buildProgram(this.gl, VERTEX, blending(count), [...uniforms, ...perSource]);
    this.blends.set(count, made);
    return made;
  }

  /** @param {Frame} frame */
  #upload(frame) {
    const { gl } = this;
    const { positions, normals, colours, faces } = /** @type {any} */ (frame.shape);
    const array = gl.createVertexArray();
    const buffers = [gl.createBuffer(), gl.createBuffer(), gl.createBuffer(), gl.createBuffer()];
    gl.bindVertexArray(array);
    /** @type {[any, number, number, boolean][]} */
    const attributes = [[positions, 3, gl.FLOAT, false], [normals, 3, gl.FLOAT, false], [colours, 4, gl.UNSIGNED_BYTE, true]];
    attributes.forEach(([values, size, kind, normalised], place) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[place]);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, kind, normalised, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[3]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, buffers, count: faces.length, box: boxOf(positions), sources: new Map() };
  }

  /** One camera's image, cut out by its mask, and the mesh's depth in it. @param {Frame} frame @param {any} own @param {number} n */
  #source(frame, own, n) {
    const { gl } = this;
    const camera = /** @type {any} */ (frame.shape).header.cameras[n];
    const { picture, mask } = /** @type {import("../link/assets.js").CameraImage} */ (frame.images.get(n));
    const { width, height, K } = camera;
    const pixels = [multiply(K, camera.R), apply(K, camera.T)];
    const [near, far] = depthRange(own.box, camera);
    const made = {
      name: camera.name,
      size: [width, height],
      center: camera.center,
      pixels: columns([0, 1, 2].map((row) => [...pixels[0].slice(3 * row, 3 * row + 3), pixels[1][row]])),
      lens: [K[0], far / (far - near), near],
      picture: texture(gl, gl.LINEAR),
      depth: /** @type {any} */ (null),
    };
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    made.depth = texture(gl, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.DEPTH_COMPONENT24, width, height, 0, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    const rgb = texture(gl, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, picture);
    const inside = texture(gl, gl.NEAREST);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, width, height, 0, gl.RED, gl.UNSIGNED_BYTE, mask);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);

    const target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, made.picture, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, made.depth, 0);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.cutOut.program);
    this.#bind(0, rgb, this.cutOut.at.picture);
    this.#bind(1, inside, this.cutOut.at.mask);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 3);

    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LESS);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.colorMask(false, false, false, false);
    gl.enable(gl.CULL_FACE);
    gl.frontFace(gl.CW); // rows run downwards here
    gl.useProgram(this.depthOnly.program);
    gl.uniformMatrix4fv(this.depthOnly.at.clip, false, clipFromCrop(made.pixels, width, height, near, far));
    gl.bindVertexArray(own.array);
    gl.drawElements(gl.TRIANGLES, own.count, gl.UNSIGNED_INT, 0);
    gl.frontFace(gl.CCW);
    gl.disable(gl.CULL_FACE);
    gl.colorMask(true, true, true, true);
    gl.bindVertexArray(null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(target);
    gl.activeTexture(gl.TEXTURE0);
    for (const used of [rgb, inside]) gl.deleteTexture(used);
    return made;
  }
}

/** A column-major 4 x 4 of three rows of four. @param {number[][]} rows */
const columns = (rows) => new Float32Array([0, 1, 2, 3].flatMap((c) => [...rows.map((row) => row[c]), 0]));

/** Clip space whose rows run downwards, of (u z, v z, z). @param {Float32Array} pixels @param {number} width @param {number} height @param {number} near @param {number} far */
function clipFromCrop(pixels, width, height, near, far) {
  const clip = new Float32Array(16);
  for (let c = 0; c < 16; c += 4) {
    const [u, v, z] = pixels.subarray(c, c + 3);
    clip[c] = (2 * u) / width - z;
    clip[c + 1] = (2 * v) / height - z;
    clip[c + 2] = ((far + near) / (far - near)) * z;
    clip[c + 3] = z;
  }
  clip[14] -= (2 * far * near) / (far - near);
  return clip;
}

/** @param {Float32Array} positions */
function boxOf(positions) {
  const [low, high] = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
  for (let at = 0; at < positions.length; at++) {
    const axis = at % 3;
    if (positions[at] < low[axis]) low[axis] = positions[at];
    if (positions[at] > high[axis]) high[axis] = positions[at];
  }
  return [low, high];
}

/** Near and far plane around a box, metres. @param {number[][]} box @param {any} camera */
function depthRange(box, camera) {
  const corners = Array.from({ length: 8 }, (_, n) => [0, 1, 2].map((axis) => box[(n >> axis) & 1][axis]));
  const depths = corners.map((corner) => add(apply(camera.R, corner), camera.T)[2]);
  const near = Math.max(0.02, 0.99 * Math.min(...depths));
  return [near, Math.max(1.01 * near, 1.01 * Math.max(...depths))];
}

/** @param {WebGL2RenderingContext} gl @param {number} filter */
function texture(gl, filter) {
  const made = /** @type {WebGLTexture} */ (gl.createTexture());
  gl.bindTexture(gl.TEXTURE_2D, made);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return made;
}
