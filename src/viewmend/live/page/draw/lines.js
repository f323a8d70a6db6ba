// Lines of a width in pixels between points of the world, hidden behind what is nearer.

import { buildProgram } from "./program.js";

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
  if (a.w < NEAR && b.w < NEAR) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.w < NEAR) a = mix(a, b, (NEAR - a.w) / (b.w - a.w));
  if (b.w < NEAR) b = mix(b, a, (NEAR - b.w) / (a.w - b.w));
  vec2 along = (b.xy / b.w - a.xy / a.w) * size;
  vec2 normal = normalize(vec2(-along.y, along.x) + vec2(1e-9, 0.0));
  vec4 place = corner.x < 0.5 ? a : b;
  place.xy += normal * corner.y * thickness / size * place.w;
  gl_Position = place;
  colour = paint;
}`;
const FRAGMENT = `#version 300 es
precision mediump float;
in vec4 colour;
out vec4 pixel;
void main() { pixel = colour; }`;
const FLOATS = 11;

export class LinePainter {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    this.count = 0;
    this.painter = buildProgram(gl, VERTEX, FRAGMENT, ["clip", "size"]);
    this.array = gl.createVertexArray();
    this.buffer = gl.createBuffer();
    gl.bindVertexArray(this.array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([0, -1, 1, -1, 0, 1, 1, 1]), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    [[1, 3, 0], [2, 3, 3], [3, 4, 6], [4, 1, 10]].forEach(([place, floats, offset]) => {
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, floats, gl.FLOAT, false, 4 * FLOATS, 4 * offset);
      gl.vertexAttribDivisor(place, 1);
    });
    gl.bindVertexArray(null);
  }

  /** @param {import("./rig.js").Line[]} lines */
  set(lines) {
    const { gl } = this;
    const values = lines.flatMap(({ from, to, colour, thickness }) => [...from, ...to, ...colour, thickness]);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.DYNAMIC_DRAW);
    this.count = lines.length;
  }

  /** @param {Float32Array} clip from the world @param {number} width of the viewport, pixels @param {number} height */
  draw(clip, width, height) {
    if (!this.count) return;
    const { gl } = this;
    gl.useProgram(this.painter.program);
    gl.uniformMatrix4fv(this.painter.at.clip, false, clip);
    gl.uniform2f(this.painter.at.size, width, height);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE); // the canvas stays opaque
    gl.bindVertexArray(this.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
    gl.bindVertexArray(null);
    gl.disable(gl.BLEND);
  }
}
