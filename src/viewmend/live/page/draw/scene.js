// Draws views of a frame from its mesh and the images of the cameras, by the rule of rendering/blending.py.

import { HoleFill } from "./fill.js";
import { QUAD, buildProgram } from "./program.js";
import { clipFromWorld } from "./projection.js";
import { chooseCameras, computeAlignment } from "../link/assets.js";
import { add, apply, multiply } from "../view/matrix.js";

/** @typedef {import("../link/assets.js").Frame} Frame */
/** @typedef {import("./projection.js").Viewpoint} Viewpoint */

/**
 * A pass blends at most this many images. Each takes two texture units, for its colours and depths, of the
 * sixteen that WebGL 2 guarantees.
 */
const MAX_SOURCES = 8;
/** The stencil value of pixels that have their colour. */
const DONE = 1;
/** Meshes and textures are kept for this many frames. */
const MAX_CACHED_FRAMES = 2;
/** A near plane is at least this far from the camera, in metres. */
const MIN_NEAR_M = 0.02;
/** This many cameras beyond those of the blending rule fill its holes where a GPU draws. */
const GPU_FILLERS = 3;
/** The colour of holes by mode, as RGB and opacity; where opacity is 0, holes are filled. */
const HOLE_COLOURS = {
  rendered: [0, 0, 0, 1],
  holes: [1, 0.15, 0.55, 1],
  completed: [0, 0, 0, 0],
  compared: [0, 0, 0, 0],
};
/** The modes that the page can draw. */
export const DRAWN_MODES = Object.keys(HOLE_COLOURS);
/** The uniforms of the blending shader that do not depend on a camera. */
const BLEND_UNIFORMS = [
  "clip",
  "eye",
  "bias",
  "slope",
  "grazing",
  "minWeight",
  "closest",
  "powers",
  "leaveHoles",
  "cuts",
  "background",
  "hole",
];

/** Passes position, normal and colour of the vertices on. */
const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec3 direction;
layout(location = 2) in vec4 paint;
uniform mat4 clip;
centroid out vec3 point;
centroid out vec3 normal;
centroid out vec3 tint;
invariant gl_Position;
void main() {
  point = position;
  normal = direction;
  tint = paint.rgb;
  gl_Position = clip * vec4(position, 1.0);
}`;

/** Writes depth only. */
const DEPTH_ONLY = `#version 300 es
precision mediump float;
void main() {}`;

/** Multiplies an image by its mask, so that bilinear samples weigh each pixel by its mask. */
const CUT_OUT = `#version 300 es
precision highp float;
uniform sampler2D image, mask;
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  float inside = texelFetch(mask, at, 0).r;
  colour = vec4(texelFetch(image, at, 0).rgb * inside, inside);
}`;

/**
 * Write the shader that blends the images of cameras. GLSL requires constant sampler indices, so each number
 * of images has a shader of its own.
 * @param {number} count of images
 */
const writeBlendShader = (count) => `#version 300 es
precision highp float;
precision highp sampler2D;
centroid in vec3 point;
centroid in vec3 normal;
centroid in vec3 tint;
out vec4 colour;
uniform vec3 eye;
uniform float bias, slope, grazing, minWeight;
// cosine between the directions to the viewer and to the closest camera; 1 where weights are absolute
uniform float closest;
uniform vec2 powers;
uniform bool leaveHoles;   // whether another pass fills the holes
// whether the mean of the masks is the view's alpha: masks of completed views fit the outline better than the
// mesh
uniform bool cuts;
uniform vec3 background;
// colour of holes; holes have the colour of the vertices where its alpha is 0, and their alpha is 0, too
uniform vec4 hole;
uniform mat4 pixels[${count}];   // (u z, v z, z) from a point of the world
uniform vec3 centers[${count}];
uniform vec3 lenses[${count}];   // x: focal length; depth buffer = y (1 - z / metres)
${Array.from({ length: count }, (_, n) => `uniform sampler2D image${n}, depth${n};`).join("\n")}

float total = 0.0;   // sum of the weights if all pixels were foreground

// The colour of a point in an image, and its weight.
vec4 weigh(
  sampler2D image, sampler2D depth, mat4 pixel, vec3 center, vec3 lens, vec3 outward, vec3 toViewer
) {
  vec3 toCamera = normalize(center - point);
  float facing = min(dot(outward, toCamera), 1.0);
  float agreeing = min(dot(toViewer, toCamera), 1.0) / closest;
  vec3 h = (pixel * vec4(point, 1.0)).xyz;
  if (facing <= 0.0 || agreeing <= 0.0 || h.z <= 0.0) return vec4(0.0);
  vec2 uv = h.xy / h.z;
  ivec2 size = textureSize(image, 0);
  if (any(lessThan(uv, vec2(0.0))) || any(greaterThanEqual(uv, vec2(size)))) return vec4(0.0);
  float perPixel = h.z / lens.x * sqrt(1.0 - facing * facing) / max(facing, grazing);
  float nearest = lens.y * (1.0 - lens.z / max(h.z - bias - slope * perPixel, 1e-4));
  vec2 low = floor(uv - 0.5);
  vec2 part = uv - 0.5 - low;
  ivec2 a = clamp(ivec2(low), ivec2(0), size - 1);
  ivec2 d = clamp(ivec2(low) + 1, ivec2(0), size - 1);
  ivec2 b = ivec2(d.x, a.y), c = ivec2(a.x, d.y);
  vec4 depths = vec4(
    texelFetch(depth, a, 0).r, texelFetch(depth, b, 0).r, texelFetch(depth, c, 0).r, texelFetch(depth, d, 0).r
  );
  bvec4 visible = greaterThanEqual(depths, vec4(nearest));
  vec4 seen;   // colour times mask, and mask
  float usable = 1.0;
  if (all(visible)) {
    seen = textureLod(image, uv / vec2(size), 0.0);
  } else {
    vec4 share = vec4(
      (1.0 - part.x) * (1.0 - part.y), part.x * (1.0 - part.y), (1.0 - part.x) * part.y, part.x * part.y
    );
    share *= vec4(visible);
    usable = dot(share, vec4(1.0));
    seen = share.x * texelFetch(image, a, 0) + share.y * texelFetch(image, b, 0)
      + share.z * texelFetch(image, c, 0) + share.w * texelFetch(image, d, 0);
  }
  float direct = pow(facing, powers.x) * pow(agreeing, powers.y);
  total += usable * direct;
  return seen * direct;
}

void main() {
  vec3 outward = normalize(normal);
  vec3 toViewer = normalize(eye - point);
  vec4 sum = vec4(0.0);
${Array.from(
  { length: count },
  (_, n) =>
    `  sum += weigh(image${n}, depth${n}, pixels[${n}], centers[${n}], lenses[${n}], outward, toViewer);`,
).join("\n")}
  float known = cuts ? total : sum.a;
  if (leaveHoles && known < minWeight) discard;
  vec3 seen = sum.rgb / max(sum.a, 1e-6);
  if (known < minWeight) colour = vec4(mix(tint, hole.rgb, hole.a), hole.a);
  else colour = vec4(cuts ? mix(background, seen, min(1.0, sum.a / total)) : seen, 1.0);
}`;

/**
 * Count the cameras beyond those of the blending rule that fill its holes; none where the processor draws,
 * which would take twice as long.
 * @param {boolean} software whether the processor draws
 */
export const countFillers = (software) => (software ? 0 : GPU_FILLERS);

export class Scene {
  /** @param {WebGL2RenderingContext} gl @param {number} fillers cameras that fill holes */
  constructor(gl, fillers) {
    this.gl = gl;
    this.fillers = fillers;
    this.depthOnly = buildProgram(gl, VERTEX, DEPTH_ONLY, ["clip"]);
    this.cutOut = buildProgram(gl, QUAD, CUT_OUT, ["image", "mask"]);
    /** The blending shaders by number of images. @type {Map<number, ReturnType<typeof buildProgram>>} */
    this.blendPrograms = new Map();
    /** Meshes and textures; those used last are at the end. @type {Map<Frame, any>} */
    this.cache = new Map();
    this.holeFill = new HoleFill(gl);
    this.emptyArray = gl.createVertexArray();
    /** The cost of the last view. */
    this.cost = { draws: 0, triangles: 0, textureBytes: 0 };
  }

  /** Delete a frame's meshes and textures. @param {Frame} frame */
  drop(frame) {
    if (frame.fused) this.#release(frame.fused);
    this.#release(frame);
  }

  /** @param {Frame} frame with one of its meshes */
  #release(frame) {
    const { gl } = this;
    const cached = this.cache.get(frame);
    if (!cached) return;
    this.cache.delete(frame);
    gl.deleteVertexArray(cached.array);
    for (const buffer of cached.buffers) gl.deleteBuffer(buffer);
    for (const source of cached.sources.values()) {
      gl.deleteTexture(source.image);
      gl.deleteTexture(source.depth);
    }
  }

  /**
   * Upload what a view needs. Call it before anything is drawn, because it changes the framebuffer.
   * @param {Frame} frame
   * @param {number[]} eye
   * @param {string[]} modes that will be drawn
   */
  prepare(frame, eye, modes) {
    for (const mode of modes) {
      const drawn = this.#chooseMesh(frame, mode);
      const cached = this.cache.get(drawn) ?? this.#uploadMesh(drawn);
      this.cache.delete(drawn);
      this.cache.set(drawn, cached);
      const { first, fill } = this.#chooseCameras(drawn, eye, mode);
      for (const n of [...first, ...fill]) {
        if (!cached.sources.has(n)) cached.sources.set(n, this.#createSource(drawn, cached, n));
      }
    }
    for (const oldest of this.cache.keys()) {
      if (this.cache.size > MAX_CACHED_FRAMES) this.#release(oldest);
    }
  }

  /**
   * Choose between the mesh of the hull and the mesh fused from predicted depth. The fused mesh is used if
   * there is one, except where the view is shown as rendered.
   * @param {Frame} frame
   * @param {string} mode
   * @returns {Frame}
   */
  #chooseMesh(frame, mode) {
    const isRendered = mode === "rendered" || mode === "holes";
    return frame.fused && !isRendered ? frame.fused : frame;
  }

  /**
   * Choose the cameras that colour a view from those whose images have arrived.
   * @param {Frame} frame
   * @param {number[]} eye
   * @param {string} mode
   */
  #chooseCameras(frame, eye, mode) {
    const shape = /** @type {import("../link/assets.js").Shape} */ (frame.shape);
    return chooseCameras(shape, eye, mode, this.fillers, (n) => frame.images.has(n));
  }

  /**
   * Cut out the images of all real cameras that have arrived. Call it before anything is drawn, as `prepare`.
   * @param {Frame} frame
   */
  buildCutOuts(frame) {
    const cached = this.cache.get(frame) ?? this.cache.get(/** @type {Frame} */ (frame.fused));
    const { cameras } = /** @type {any} */ (frame.shape).header;
    const real = [...frame.images.keys()].filter((n) => !cameras[n].completed);
    for (const n of real) {
      if (!cached.sources.has(n)) cached.sources.set(n, this.#createSource(frame, cached, n));
    }
    return real.map((n) => ({ camera: cameras[n], image: cached.sources.get(n).image }));
  }

  /**
   * Draw into a viewport, within the current scissor.
   * @param {Frame} wholeFrame
   * @param {Viewpoint} viewer
   * @param {number[]} eye
   * @param {string} mode
   * @param {number[]} viewport x, y, width, height in pixels, y up
   * @param {number[]} background colour
   */
  draw(wholeFrame, viewer, eye, mode, viewport, background) {
    const { gl } = this;
    const frame = this.#chooseMesh(wholeFrame, mode);
    const cached = this.cache.get(frame);
    const { header } = /** @type {import("../link/assets.js").Shape} */ (frame.shape);
    const { first, fill } = this.#chooseCameras(frame, eye, mode);
    const completed = first.some((n) => header.cameras[n].completed);
    const matrix = clipFromWorld(viewer);
    gl.bindVertexArray(cached.array);
    gl.enable(gl.CULL_FACE); // the mesh is closed
    const hole = /** @type {any} */ (HOLE_COLOURS)[mode];
    const passes = [first, fill]
      .map((numbers) => numbers.slice(0, MAX_SOURCES).map((n) => cached.sources.get(n)))
      .filter((pass) => pass.length);
    const sources = passes.flat();
    if (passes.length > 1) this.#beginPasses(cached, matrix);

    // blend the cameras of the rule, then fill the remaining holes from others
    const { blend } = header;
    passes.forEach((pass, n) => {
      const cuts = completed && n === 0;
      const viewPower = cuts ? blend.completed.view_power : blend.view_power;
      const closest = cuts ? computeAlignment(header, eye, first[0]) : 1;
      const leaveHoles = n + 1 < passes.length;
      const options = { matrix, eye, blend, viewPower, closest, hole, background, cuts, leaveHoles };
      this.#drawPass(cached, pass, options);
    });
    gl.disable(gl.STENCIL_TEST);
    gl.disable(gl.CULL_FACE);
    gl.depthFunc(gl.LEQUAL);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindVertexArray(null);

    // fill the holes that no camera sees
    const fillsHoles = !hole[3];
    if (fillsHoles) this.holeFill.draw(cached.bounds, viewer, viewport, background);
    const textureBytes = sources.reduce((sum, { size }) => sum + 8 * size[0] * size[1], 0);
    const draws = passes.length > 1 ? 1 + passes.length : 1;
    this.cost = {
      draws: draws + Number(fillsHoles),
      triangles: (draws * cached.count) / 3,
      textureBytes,
    };
  }

  /**
   * Draw the depth, so that each pass colours only the nearest surface, and only pixels without a colour.
   * @param {any} cached
   * @param {Float32Array} matrix clip from world
   */
  #beginPasses(cached, matrix) {
    const { gl } = this;
    gl.useProgram(this.depthOnly.program);
    gl.uniformMatrix4fv(this.depthOnly.at.clip, false, matrix);
    gl.colorMask(false, false, false, false);
    gl.drawElements(gl.TRIANGLES, cached.count, gl.UNSIGNED_INT, 0);
    gl.colorMask(true, true, true, true);
    gl.depthFunc(gl.EQUAL);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.NOTEQUAL, DONE, 0xff);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.REPLACE);
  }

  /**
   * @typedef {object} PassOptions
   * @property {Float32Array} matrix clip from world
   * @property {number[]} eye
   * @property {any} blend parameters of the blending rule
   * @property {number} viewPower
   * @property {number} closest see the shader
   * @property {number[]} hole colour and opacity of holes
   * @property {number[]} background colour
   * @property {boolean} cuts whether the masks cut the view
   * @property {boolean} leaveHoles whether another pass fills the holes
   */

  /**
   * Blend the images of some cameras.
   * @param {any} cached
   * @param {any[]} sources
   * @param {PassOptions} options
   */
  #drawPass(cached, sources, options) {
    const { gl } = this;
    const { program, at } = this.#getBlendProgram(sources.length);
    const { blend } = options;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.clip, false, options.matrix);
    gl.uniform3fv(at.eye, options.eye);
    gl.uniform1f(at.bias, blend.bias_m);
    gl.uniform1f(at.slope, blend.slope_px);
    gl.uniform1f(at.grazing, blend.grazing);
    gl.uniform1f(at.minWeight, blend.min_weight);
    gl.uniform1f(at.closest, options.closest);
    gl.uniform2f(at.powers, blend.normal_power, options.viewPower);
    gl.uniform3fv(at.background, options.background);
    gl.uniform1i(at.cuts, Number(options.cuts));
    gl.uniform1i(at.leaveHoles, Number(options.leaveHoles));
    gl.uniform4fv(at.hole, options.hole);
    sources.forEach((source, n) => {
      gl.uniformMatrix4fv(at[`pixels[${n}]`], false, source.pixels);
      gl.uniform3fv(at[`centers[${n}]`], source.center);
      gl.uniform3fv(at[`lenses[${n}]`], source.lens);
      this.#bindTexture(2 * n, source.image, at[`image${n}`]);
      this.#bindTexture(2 * n + 1, source.depth, at[`depth${n}`]);
    });
    gl.drawElements(gl.TRIANGLES, cached.count, gl.UNSIGNED_INT, 0);
  }

  /** @param {number} unit @param {WebGLTexture} texture @param {WebGLUniformLocation} at */
  #bindTexture(unit, texture, at) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(at, unit);
  }

  /** Get the shader that blends a number of images; it is built at first use. @param {number} count */
  #getBlendProgram(count) {
    const known = this.blendPrograms.get(count);
    if (known) return known;
    const perSource = Array.from({ length: count }, (_, n) => {
      return [`pixels[${n}]`, `centers[${n}]`, `lenses[${n}]`, `image${n}`, `depth${n}`];
    });
    const uniforms = [...BLEND_UNIFORMS, ...perSource.flat()];
    const built = buildProgram(this.gl, VERTEX, writeBlendShader(count), uniforms);
    this.blendPrograms.set(count, built);
    return built;
  }

  /** Upload a frame's mesh. @param {Frame} frame */
  #uploadMesh(frame) {
    const { gl } = this;
    const { positions, normals, colours, faces } = /** @type {any} */ (frame.shape);
    const array = gl.createVertexArray();
    const buffers = [gl.createBuffer(), gl.createBuffer(), gl.createBuffer(), gl.createBuffer()];
    gl.bindVertexArray(array);
    /** @type {[any, number, number, boolean][]} */
    const attributes = [
      [positions, 3, gl.FLOAT, false],
      [normals, 3, gl.FLOAT, false],
      [colours, 4, gl.UNSIGNED_BYTE, true],
    ];
    attributes.forEach(([values, size, kind, normalised], location) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[location]);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, kind, normalised, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[3]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    return { array, buffers, count: faces.length, bounds: computeBounds(positions), sources: new Map() };
  }

  /**
   * Create the textures of one camera: its image, cut out by its mask, and the depth of the mesh in it.
   * @param {Frame} frame
   * @param {any} cached
   * @param {number} n the camera's number
   */
  #createSource(frame, cached, n) {
    const { gl } = this;
    const camera = /** @type {any} */ (frame.shape).header.cameras[n];
    const { picture, mask } = /** @type {import("../link/assets.js").CameraImage} */ (frame.images.get(n));
    const { width, height, K } = camera;

    // projection: (u z, v z, z) = K (R x + T)
    const KR = multiply(K, camera.R);
    const KT = apply(K, camera.T);
    const [near, far] = computeDepthRange(cached.bounds, camera);
    const source = {
      name: camera.name,
      size: [width, height],
      center: camera.center,
      pixels: packColumns([0, 1, 2].map((row) => [...KR.slice(3 * row, 3 * row + 3), KT[row]])),
      lens: [K[0], far / (far - near), near],
      image: createTexture(gl, gl.LINEAR),
      depth: /** @type {any} */ (null),
    };
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    source.depth = createTexture(gl, gl.NEAREST);
    gl.texImage2D(
      gl.TEXTURE_2D,
      0,
      gl.DEPTH_COMPONENT24,
      width,
      height,
      0,
      gl.DEPTH_COMPONENT,
      gl.UNSIGNED_INT,
      null,
    );

    const target = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, source.image, 0);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, source.depth, 0);
    gl.viewport(0, 0, width, height);
    gl.disable(gl.SCISSOR_TEST);
    this.#drawCutOut(picture, mask, width, height);
    this.#drawDepth(cached, clipFromCrop(source.pixels, width, height, near, far));
    gl.bindVertexArray(null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(target);
    gl.activeTexture(gl.TEXTURE0);
    return source;
  }

  /**
   * Draw an image, cut out by its mask, into the current framebuffer.
   * @param {TexImageSource} image
   * @param {Uint8Array} mask
   * @param {number} width
   * @param {number} height
   */
  #drawCutOut(image, mask, width, height) {
    const { gl } = this;
    const { program, at } = this.cutOut;
    const imageTexture = createTexture(gl, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
    const maskTexture = createTexture(gl, gl.NEAREST);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.R8, width, height, 0, gl.RED, gl.UNSIGNED_BYTE, mask);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 4);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(program);
    this.#bindTexture(0, imageTexture, at.image);
    this.#bindTexture(1, maskTexture, at.mask);
    gl.bindVertexArray(this.emptyArray);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.deleteTexture(imageTexture);
    gl.deleteTexture(maskTexture);
  }

  /**
   * Draw the depth of a mesh into the current framebuffer.
   * @param {any} cached
   * @param {Float32Array} matrix
   */
  #drawDepth(cached, matrix) {
    const { gl } = this;
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LESS);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.colorMask(false, false, false, false);
    gl.enable(gl.CULL_FACE);
    gl.frontFace(gl.CW); // rows run downwards here
    gl.useProgram(this.depthOnly.program);
    gl.uniformMatrix4fv(this.depthOnly.at.clip, false, matrix);
    gl.bindVertexArray(cached.array);
    gl.drawElements(gl.TRIANGLES, cached.count, gl.UNSIGNED_INT, 0);
    gl.frontFace(gl.CCW);
    gl.disable(gl.CULL_FACE);
    gl.colorMask(true, true, true, true);
  }
}

/** Pack three rows of four into a column-major 4 x 4. @param {number[][]} rows */
function packColumns(rows) {
  return new Float32Array([0, 1, 2, 3].flatMap((column) => [...rows.map((row) => row[column]), 0]));
}

/**
 * Compute the matrix from (u z, v z, z) to a clip space whose rows run downwards.
 * @param {Float32Array} pixels column-major 4 x 4: (u z, v z, z) from world
 * @param {number} width
 * @param {number} height
 * @param {number} near
 * @param {number} far
 */
function clipFromCrop(pixels, width, height, near, far) {
  const clip = new Float32Array(16);
  for (let column = 0; column < 16; column += 4) {
    const [u, v, z] = pixels.subarray(column, column + 3);
    clip[column] = (2 * u) / width - z;
    clip[column + 1] = (2 * v) / height - z;
    clip[column + 2] = ((far + near) / (far - near)) * z;
    clip[column + 3] = z;
  }
  clip[14] -= (2 * far * near) / (far - near);
  return clip;
}

/** Find the lowest and highest corner. @param {Float32Array} positions three per vertex */
function computeBounds(positions) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  for (let at = 0; at < positions.length; at++) {
    const axis = at % 3;
    if (positions[at] < low[axis]) low[axis] = positions[at];
    if (positions[at] > high[axis]) high[axis] = positions[at];
  }
  return [low, high];
}

/**
 * Compute the near and far plane around a box, in metres.
 * @param {number[][]} bounds
 * @param {any} camera
 */
function computeDepthRange(bounds, camera) {
  const corners = Array.from({ length: 8 }, (_, n) => [0, 1, 2].map((axis) => bounds[(n >> axis) & 1][axis]));
  const depths = corners.map((corner) => add(apply(camera.R, corner), camera.T)[2]);
  const near = Math.max(MIN_NEAR_M, 0.99 * Math.min(...depths));
  return [near, Math.max(1.01 * near, 1.01 * Math.max(...depths))];
}

/** @param {WebGL2RenderingContext} gl @param {number} filter */
function createTexture(gl, filter) {
  const texture = /** @type {WebGLTexture} */ (gl.createTexture());
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, filter);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return texture;
}
