// Draws lines between points of the world, with a width in pixels; nearer surfaces hide them.

import { buildProgram } from "./program.js";

/** Each line has this many numbers: start, end, RGB and opacity, and thickness. */
const FLOATS = 11;
/** Location of each attribute in the shader, its numbers, and the first of them in a line. */
const ATTRIBUTES = [
  { location: 1, size: 3, offset: 0 },
  { location: 2, size: 3, offset: 3 },
  { location: 3, size: 4, offset: 6 },
  { location: 4, size: 1, offset: 10 },
];
/** Corners of the rectangle that becomes a line: which end, and which side. */
const CORNERS = [0, -1, 1, -1, 0, 1, 1, 1];

/** Spans each line with a rectangle, and cuts it at the near plane. */
const VERTEX = `#version 300 es
layout(location = 0) in vec2 corner;
layout(location = 1) in vec3 start;
layout(location = 2) in vec3 end;
layout(location = 3) in vec4 paint;
layout(location = 4) in float thickness;
uniform mat4 clip;
uniform vec2 size;
out vec4 colour;
const float NEAR = 0.02;
void main() {
  vec4 a = clip * vec4(start, 1.0);
  vec4 b = clip * vec4(end, 1.0);
  if (a.w < NEAR && b.w < NEAR) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);   // out of view
    return;
  }
  if (a.w < NEAR) a = mix(a, b, (NEAR - a.w) / (b.w - a.w));
  if (b.w < NEAR) b = mix(b, a, (NEAR - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * size;
  vec2 normal = normalize(vec2(-along.y, along.x) + vec2(1e-9, 0.0));
  vec4 position = corner.x < 0.5 ? a : b;
  position.xy += normal * corner.y * thickness / size * position.w;
  gl_Position = position;
  colour = paint;
}`;

/** Colours each line. */
const FRAGMENT = `#version 300 es
precision mediump float;
in vec4 colour;
out vec4 pixel;
void main() { pixel = colour; }`;

/** Draws the lines that were set last. */
export class LinePainter {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.count = 0;
    this.shader = buildProgram(gl, VERTEX, FRAGMENT, ["clip", "size"]);
    this.array = gl.createVertexArray();
    this.buffer = gl.createBuffer();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(CORNERS), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    for (const { location, size, offset } of ATTRIBUTES) {
      gl.enableVertexAttribArray(location);
      gl.vertexAttribPointer(location, size, gl.FLOAT, false, 4 * FLOATS, 4 * offset);
      gl.vertexAttribDivisor(location, 1);
    }
    gl.bindVertexArray(null);
  }

  /** Replace the lines. @param {import("./rig.js").Line[]} lines */
  set(lines) {
    const { gl } = this;
    const values = lines.flatMap((line) => [...line.from, ...line.to, ...line.colour, line.thickness]);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.DYNAMIC_DRAW);
    this.count = lines.length;
  }

  /**
   * Draw the lines.
   * @param {Float32Array} clip clip from world, column-major 4 x 4
   * @param {number} width of the viewport, pixels
   * @param {number} height
   */
  draw(clip, width, height) {
    if (!this.count) return;
    const { gl } = this;
    const { program, at } = this.shader;
    gl.useProgram(program);
    gl.uniformMatrix4fv(at.clip, false, clip);
    gl.uniform2f(at.size, width, height);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE); // the canvas stays opaque
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }
}
