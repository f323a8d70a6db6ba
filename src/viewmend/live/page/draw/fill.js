// Fills the holes of a drawn view: pixels whose alpha is 0 get the mean colour of what is drawn around them.

import { QUAD, buildProgram } from "./program.js";
import { project } from "./projection.js";

/** The mean is taken of this many samples to each side of a pixel. */
const TAPS = 4;
/** Samples are this many pixels apart in a view of up to `TALL_PX` rows, and farther apart in larger ones. */
const STEP_PX = 2;
/** Views of up to this many rows are sampled with the smallest step. */
const TALL_PX = 768;
/** The weight of the hole's own colour in the mean. */
const OWN_WEIGHT = 0.5;
/**
 * The weight of the background is limited to this multiple of all other weights, so that holes are not black.
 */
const MAX_BACKGROUND = 3;

const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D drawn;
uniform ivec2 corner;   // of the copy, in the framebuffer
uniform ivec2 size;
uniform int stride;
uniform vec3 background;
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy) - corner;
  vec4 own = texelFetch(drawn, at, 0);
  vec4 seen = vec4(0.0);   // sum of colours, and of their weights
  float empty = 0.0;   // weight of the background
  if (own.a < 1.0) {
    for (int y = -${TAPS}; y <= ${TAPS}; y++) {
      for (int x = -${TAPS}; x <= ${TAPS}; x++) {
        ivec2 tap = at + stride * ivec2(x, y);
        if (any(lessThan(tap, ivec2(0))) || any(greaterThanEqual(tap, size))) continue;
        vec4 there = texelFetch(drawn, tap, 0);
        float weight = there.a * exp(float(x * x + y * y) / ${(-0.5 * TAPS * TAPS).toFixed(1)});
        if (all(lessThan(abs(there.rgb - background), vec3(0.002)))) empty += weight;
        else seen += vec4(there.rgb, 1.0) * weight;
      }
    }
  } else discard;
  seen += vec4(own.rgb, 1.0) * ${OWN_WEIGHT.toFixed(2)};
  float maxEmpty = ${MAX_BACKGROUND.toFixed(1)} * seen.a;
  vec4 sum = seen + vec4(background, 1.0) * (empty * maxEmpty / (empty + maxEmpty));
  colour = vec4(sum.rgb / sum.a, 1.0);
}`;

/**
 * Smooths holes into their surroundings. These include the background, which is half of them at an outline.
 */
export class HoleFill {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.shader = buildProgram(gl, QUAD, FRAGMENT, ["drawn", "corner", "size", "stride", "background"]);
    this.copy = gl.createTexture();
    this.array = gl.createVertexArray();
    /** Width and height of the copy. */
    this.size = [0, 0];
  }

  /**
   * Fill the holes within the current scissor.
   * @param {number[][]} bounds lowest and highest corner of the subject, metres
   * @param {import("./projection.js").Viewpoint} viewer
   * @param {number[]} viewport x, y, width, height in pixels, y up
   * @param {number[]} background colour
   */
  draw(bounds, viewer, viewport, background) {
    const { gl } = this;
    const stride = Math.max(STEP_PX, Math.round((STEP_PX * viewport[3]) / TALL_PX));
    const [x, y, width, height] = computeRectangle(bounds, viewer, viewport, stride * TAPS);
    const isEmpty = !(width >= 1 && height >= 1); // NaN where the page has no height, as in a folded iframe
    if (isEmpty) return;

    // copy what is drawn
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.copy);
    if (width > this.size[0] || height > this.size[1]) this.#enlargeCopy(width, height);
    gl.copyTexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, x, y, width, height);

    // draw over the holes
    const { program, at } = this.shader;
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(program);
    gl.uniform1i(at.drawn, 0);
    gl.uniform2i(at.corner, x, y);
    gl.uniform2i(at.size, width, height);
    gl.uniform1i(at.stride, stride);
    gl.uniform3fv(at.background, background);
    gl.viewport(x, y, width, height);
    gl.bindVertexArray(this.array);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
    gl.viewport(viewport[0], viewport[1], viewport[2], viewport[3]);
    gl.enable(gl.DEPTH_TEST);
  }

  /** @param {number} width @param {number} height */
  #enlargeCopy(width, height) {
    const { gl } = this;
    this.size = [Math.max(width, this.size[0]), Math.max(height, this.size[1])];
    const [copyWidth, copyHeight] = this.size;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, copyWidth, copyHeight, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }
}

/**
 * Find the part of the viewport that shows a box, with a margin; all of it if a corner is behind the viewer.
 * @param {number[][]} bounds lowest and highest corner, metres
 * @param {import("./projection.js").Viewpoint} viewer
 * @param {number[]} viewport x, y, width, height in pixels, y up
 * @param {number} margin pixels
 */
function computeRectangle(bounds, viewer, [x, y, width, height], margin) {
  const { lens } = viewer;
  const low = [Infinity, Infinity];
  const high = [-Infinity, -Infinity];
  for (let n = 0; n < 8; n++) {
    const corner = [0, 1, 2].map((axis) => bounds[(n >> axis) & 1][axis]);
    const pixel = project(viewer, corner);
    if (!pixel) return [x, y, width, height];
    const position = [(pixel[0] * width) / lens.width, height - (pixel[1] * height) / lens.height];
    for (const axis of [0, 1]) {
      low[axis] = Math.min(low[axis], position[axis]);
      high[axis] = Math.max(high[axis], position[axis]);
    }
  }
  const left = Math.max(0, Math.floor(low[0]) - margin);
  const bottom = Math.max(0, Math.floor(low[1]) - margin);
  const right = Math.min(width, Math.ceil(high[0]) + margin);
  const top = Math.min(height, Math.ceil(high[1]) + margin);
  return [x + left, y + bottom, right - left, top - bottom];
}
