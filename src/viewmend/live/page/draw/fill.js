// Holes of a drawn view: pixels whose alpha is 0 get the mean of what is drawn around them.

import { QUAD, buildProgram } from "./program.js";
import { project } from "./projection.js";

/** Taps to each side, and pixels between taps in a view of up to `TALL_PX` rows. */
const [TAPS, STEP_PX, TALL_PX] = [4, 2, 768];
/** Weight of a hole's own colour, and the background's limit as a multiple of the rest, lest holes be black. */
const [OWN, MOST_EMPTY] = [0.5, 3];

const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D drawn;
uniform ivec2 corner;   // of the copy, in the framebuffer
uniform ivec2 size;
uniform int stride;
uniform vec3 ground;
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
        if (all(lessThan(abs(there.rgb - ground), vec3(0.002)))) empty += weight;
        else seen += vec4(there.rgb, 1.0) * weight;
      }
    }
  } else discard;
  seen += vec4(own.rgb, 1.0) * ${OWN.toFixed(2)};
  float maxEmpty = ${MOST_EMPTY.toFixed(1)} * seen.a;
  vec4 sum = seen + vec4(ground, 1.0) * (empty * maxEmpty / (empty + maxEmpty));
  colour = vec4(sum.rgb / sum.a, 1.0);
}`;

/** Smooths holes into their surroundings, the background included: at an outline they are half background. */
export class HoleFill {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.painter = buildProgram(gl, QUAD, FRAGMENT, ["drawn", "corner", "size", "stride", "ground"]);
    this.copy = gl.createTexture();
    this.array = gl.createVertexArray();
    this.size = [0, 0];
  }

  /** Fill the holes within the current scissor. @param {number[][]} box of the subject: its lowest and highest corner, metres @param {import("./projection.js").Viewpoint} viewer @param {number[]} viewport x, y, width, height in pixels, y up @param {number[]} ground colour of the background */
  draw(box, viewer, viewport, ground) {
    const { gl } = this;
    const stride = Math.max(STEP_PX, Math.round((STEP_PX * viewport[3]) / TALL_PX));
    const [x, y, width, height] = rectangle(box, viewer, viewport, stride * TAPS);
    if (width < 1 || height < 1) return;
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.copy);
    if (width > this.size[0] || height > this.size[1]) {
      this.size = [Math.max(width, this.size[0]), Math.max(height, this.size[1])];
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, this.size[0], this.size[1], 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
      gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    }
    gl.copyTexSubImage2D(gl.TEXTURE_2D, 0, 0, 0, x, y, width, height);
    gl.disable(gl.DEPTH_TEST);
    gl.useProgram(this.painter.program);
    gl.uniform1i(this.painter.at.drawn, 0);
    gl.uniform2i(this.painter.at.corner, x, y);
    gl.uniform2i(this.painter.at.size, width, height);
    gl.uniform1i(this.painter.at.stride, stride);
    gl.uniform3fv(this.painter.at.ground, ground);
    gl.viewport(x, y, width, height);
    gl.bindVertexArray(this.array);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindVertexArray(null);
    gl.viewport(viewport[0], viewport[1], viewport[2], viewport[3]);
    gl.enable(gl.DEPTH_TEST);
  }
}

/** The part of the viewport that shows a box, with a margin; all of it if a corner is behind the viewer. @param {number[][]} box @param {import("./projection.js").Viewpoint} viewer @param {number[]} viewport @param {number} margin pixels */
export function rectangle(box, viewer, [x, y, width, height], margin) {
  const { lens } = viewer;
  const [low, high] = [[Infinity, Infinity], [-Infinity, -Infinity]];
  for (let n = 0; n < 8; n++) {
    const seen = project(viewer, [0, 1, 2].map((axis) => box[(n >> axis) & 1][axis]));
    if (!seen) return [x, y, width, height];
    const place = [(seen[0] * width) / lens.width, height - (seen[1] * height) / lens.height];
    for (const axis of [0, 1]) {
      low[axis] = Math.min(low[axis], place[axis]);
      high[axis] = Math.max(high[axis], place[axis]);
    }
  }
  const [left, bottom] = [Math.max(0, Math.floor(low[0]) - margin), Math.max(0, Math.floor(low[1]) - margin)];
  const [right, top] = [Math.min(width, Math.ceil(high[0]) + margin), Math.min(height, Math.ceil(high[1]) + margin)];
  return [x + left, y + bottom, right - left, top - bottom];
}
