// Compiles shaders.

/** Covers the viewport with one triangle of three vertices without attributes. */
export const QUAD = `#version 300 es
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

/** @param {WebGL2RenderingContext} gl @param {number} kind @param {string} source */
function compile(gl, kind, source) {
  const shader = /** @type {WebGLShader} */ (gl.createShader(kind));
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getShaderInfoLog(shader) ?? "shader");
  }
  return shader;
}

/**
 * Compile and link a vertex and a fragment shader.
 * @param {WebGL2RenderingContext} gl
 * @param {string} vertex
 * @param {string} fragment
 * @param {string[]} uniforms
 * @returns {{program: WebGLProgram, at: Record<string, WebGLUniformLocation>}} the program, and the locations
 *   of
 *   its uniforms; those of attributes stand in the source
 */
export function buildProgram(gl, vertex, fragment, uniforms) {
  const program = /** @type {WebGLProgram} */ (gl.createProgram());
  gl.attachShader(program, compile(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(program, compile(gl, gl.FRAGMENT_SHADER, fragment));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getProgramInfoLog(program) ?? "program");
  }
  /** @type {any} */
  const at = {};
  for (const name of uniforms) {
    at[name] = gl.getUniformLocation(program, name);
  }
  return { program, at };
}
