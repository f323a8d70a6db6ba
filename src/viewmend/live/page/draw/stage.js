// The canvas: the last frame as seen from the newest pose, and the rig on top.

import { buildProgram } from "./program.js";
import { LinePainter } from "./lines.js";
import { pyramidDepth } from "./rig.js";
import { clipFromPicture, clipFromPixels, clipFromWorld, samePlace } from "./projection.js";
import { Scene, filling } from "./scene.js";
import { planeOf } from "./surface.js";
import { length, sub } from "../view/matrix.js";
import { eyeOfCamera } from "../view/pose.js";

/** @typedef {import("./projection.js").Viewpoint} Viewpoint */
/** @typedef {import("./surface.js").Surface} Surface */
/** @typedef {import("../link/frames.js").Header} Header */

/**
 * @typedef {object} Shown what is known of the last frame
 * @property {Header} header
 * @property {{modes: Record<string, import("../link/pictures.js").Picture>, surface: Surface | null}[]} eyes
 */

/**
 * @typedef {object} DrawOptions what to draw
 * @property {{mode: string, until: number}[]} parts modes from left to right, each until a share of the viewport's width
 * @property {boolean} reproject
 * @property {any} rig the cameras to show; null to show none
 * @property {import("../link/assets.js").Frame | null} [frame] drawn here, under the server's picture of the same view
 */

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in vec2 shade;
uniform mat4 clip;
out vec3 pixel;
void main() {
  pixel = vec3(shade * place.z, place.z);
  gl_Position = clip * vec4(place.xy * place.z, place.z, 1.0);
}`;
const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D picture;
uniform vec2 size;
uniform float tone;
uniform vec3 ground;
uniform float opacity;
in vec3 pixel;
out vec4 colour;
void main() {
  vec3 seen = texture(picture, pixel.xy / pixel.z / size).rgb;
  // The background is of one colour, but compression leaves traces in it.
  vec3 off = abs(seen - ground);
  float something = smoothstep(0.015, 0.055, max(off.r, max(off.g, off.b)));
  colour = vec4(mix(ground, seen * tone, something), opacity);
}`;
/** Brightness of disoccluded areas, which show the colours next to them. */
const STRETCHED_TONE = 0.6;
/** Time in which the server's picture appears over the drawn one. */
const FADE_MS = 250;
/** A view is at a camera if it is no further from it than this share of its distance. */
const AT_CAMERA = 0.01;

export class Stage {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.software = software();
    // Smooth outlines of drawn views, where that is cheap and pixels are large enough to see.
    const antialias = !this.software && window.devicePixelRatio < 2;
    const options = { antialias, stencil: true, powerPreference: "high-performance" };
    const gl = /** @type {WebGL2RenderingContext | null} */ (canvas.getContext("webgl2", options));
    if (!gl) throw new Error("This page needs WebGL 2, which this browser does not offer.");
    this.gl = gl;
    /** @type {Header | null} */
    this.header = null;
    /** @type {any[]} */
    this.eyes = [];
    /** Images of cameras, by mode: "original" and "error". @type {Record<string, {camera: any, picture: WebGLTexture, quad: any} | null>} */
    this.photos = { original: null, error: null };
    this.ground = [0, 0, 0];
    this.prepare();
  }

  /** (Re)create all that lives on the GPU. */
  prepare() {
    this.header = null;
    this.eyes = [];
    this.photos = { original: null, error: null };
    /** Plane of the image that is drawn. @type {any} */
    this.quad = null;
    this.painter = buildProgram(this.gl, VERTEX, FRAGMENT, ["clip", "size", "tone", "ground", "opacity"]);
    this.scene = new Scene(this.gl, filling(this.software));
    /** When the last picture came, and the share of it that was drawn last. */
    this.taken = { at: -Infinity, shown: 0 };
    this.lines = new LinePainter(this.gl);
  }

  /** Take a frame: its pictures become textures and are closed. @param {Shown} shown */
  take(shown) {
    const { gl } = this;
    const { width, height } = shown.header;
    shown.eyes.forEach((eye, index) => {
      const kept = (this.eyes[index] ??= { textures: {}, mesh: null });
      kept.modes = Object.keys(eye.modes);
      for (const [mode, picture] of Object.entries(eye.modes)) {
        kept.textures[mode] ??= texture(gl);
        gl.bindTexture(gl.TEXTURE_2D, kept.textures[mode]);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, picture);
        picture.close();
      }
      kept.mesh = upload(gl, kept.mesh, eye.surface);
      kept.quad = upload(gl, kept.quad, planeOf(width, height, 1));
    });
    this.eyes.length = shown.eyes.length;
    this.header = shown.header;
    this.taken = { at: performance.now(), shown: 0 };
  }

  /** Show an image in the place of the camera that took it. @param {string} mode @param {any} camera of the rig @param {TexImageSource | null} image null to show none */
  photo(mode, camera, image) {
    const { gl } = this;
    const kept = this.photos[mode];
    if (!image) {
      if (kept) gl.deleteTexture(kept.picture);
      this.photos[mode] = null;
      return;
    }
    const picture = kept?.picture ?? texture(gl);
    gl.bindTexture(gl.TEXTURE_2D, picture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    const quad = upload(gl, kept?.quad ?? null, planeOf(camera.width, camera.height, 1));
    this.photos[mode] = { camera, picture, quad };
  }

  /** Whether the server's picture is still appearing over the drawn one. */
  get fading() {
    return this.taken.shown > 0 && this.taken.shown < 1;
  }

  /** Empty the whole canvas. @param {string} ground background colour, hexadecimal RGB */
  clear(ground) {
    const { gl } = this;
    this.ground = [0, 2, 4].map((place) => parseInt(ground.slice(place, place + 2), 16) / 255);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(this.ground[0], this.ground[1], this.ground[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /** Draw into a part of the current framebuffer, which it clears. @param {Viewpoint} viewer @param {number[]} viewport x, y, width, height in pixels, y up @param {DrawOptions} options @param {number} [eye] */
  draw(viewer, viewport, options, eye = 0) {
    const { gl } = this;
    const [x, y, width, height] = viewport;
    if (options.frame) {
      this.#scene(viewer, viewport, options, options.frame, eye);
      return;
    }
    gl.viewport(x, y, width, height);
    gl.scissor(x, y, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const kept = this.eyes[Math.min(eye, this.eyes.length - 1)];
    if (this.header && kept) {
      let start = 0;
      for (const { mode, until } of options.parts) {
        const [from, to] = [Math.round(start * width), Math.round(until * width)];
        gl.scissor(x + from, y, Math.max(0, to - from), height);
        const shown = this.shownMode(viewer, mode);
        if (shown in this.photos) this.#photo(viewer, shown);
        else this.#picture(viewer, kept, kept.textures[kept.modes.includes(shown) ? shown : kept.modes[0]], options, eye);
        start = until;
      }
      gl.scissor(x, y, width, height);
    }
    if (options.rig) this.lines?.draw(clipFromWorld(viewer), width, height);
  }

  /** The frame as drawn here, and over it the server's picture of the same view. @param {Viewpoint} viewer @param {number[]} viewport @param {DrawOptions} options @param {import("../link/assets.js").Frame} frame @param {number} eye */
  #scene(viewer, [x, y, width, height], options, frame, eye) {
    const { gl, header } = this;
    const place = eyeOfCamera(viewer);
    this.scene.prepare(frame, place, options.parts.map(({ mode }) => this.shownMode(viewer, mode)));
    const cutOuts = options.rig ? this.scene.cutOuts(frame) : [];
    const kept = this.eyes[Math.min(eye, this.eyes.length - 1)];
    const source = header?.cameras[Math.min(eye, header.cameras.length - 1)];
    const same = header && kept && header.time === frame.time && samePlace(source, header.width, header.height, viewer);
    const opacity = same ? Math.min(1, Math.max(0.01, (performance.now() - this.taken.at) / FADE_MS)) : 0;
    this.taken.shown = opacity;
    gl.viewport(x, y, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.scissor(x, y, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    let start = 0;
    for (const { mode: wanted, until } of options.parts) {
      const mode = this.shownMode(viewer, wanted);
      const [from, to] = [Math.round(start * width), Math.round(until * width)];
      gl.scissor(x + from, y, Math.max(0, to - from), height);
      const over = kept?.modes.includes(mode) ? opacity : 0;
      start = until;
      if (mode in this.photos) {
        this.#photo(viewer, mode);
        continue;
      }
      if (over < 1 || options.rig) this.scene.draw(frame, viewer, place, mode, [x, y, width, height], this.ground);
      if (over > 0) this.#overlay(kept, kept.textures[mode], over);
    }
    gl.scissor(x, y, width, height);
    if (!options.rig) return;
    for (const { camera, picture } of cutOuts) {
      const depth = pyramidDepth(camera, options.rig.center);
      if (length(sub(place, camera.center)) < 1.5 * depth) continue; // it would hide the view
      this.quad = upload(gl, this.quad, planeOf(camera.width, camera.height, depth));
      this.#image(camera, picture, this.quad, clipFromPicture(camera, viewer));
    }
    this.lines?.draw(clipFromWorld(viewer), width, height);
  }

  /** An image on a plane. @param {any} size @param {WebGLTexture} picture @param {any} quad @param {Float32Array} clip */
  #image(size, picture, quad, clip, opacity = 1) {
    const { gl } = this;
    const { program, at } = /** @type {any} */ (this.painter);
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, picture);
    gl.uniform2f(at.size, size.width, size.height);
    gl.uniform1f(at.tone, 1);
    gl.uniform1f(at.opacity, opacity);
    gl.uniform3fv(at.ground, this.ground);
    gl.uniformMatrix4fv(at.clip, false, clip);
    gl.bindVertexArray(quad.array);
    gl.drawElements(gl.TRIANGLES, quad.solid, gl.UNSIGNED_INT, 0);
  }

  /** What is drawn for a mode: the completed view in place of an image that does not exist at this pose. @param {Viewpoint & {distance?: number}} viewer @param {string} mode @returns {string} */
  shownMode(viewer, mode) {
    if (!(mode in this.photos)) return mode;
    const photo = this.photos[mode];
    if (!photo) return "completed";
    const offset = length(sub(eyeOfCamera(viewer), photo.camera.center));
    return offset > AT_CAMERA * (viewer.distance ?? 1) ? "completed" : mode;
  }

  /** A camera's image. @param {Viewpoint & {distance?: number}} viewer @param {string} mode */
  #photo(viewer, mode) {
    const { gl } = this;
    const photo = this.photos[mode];
    if (!photo) return;
    const { camera, picture, quad } = photo;
    gl.disable(gl.DEPTH_TEST);
    this.#image(camera, picture, quad, this.#clip(camera, viewer, {}));
    gl.enable(gl.DEPTH_TEST);
  }

  /** @param {any} kept @param {WebGLTexture} picture @param {number} opacity */
  #overlay(kept, picture, opacity) {
    const { gl } = this;
    const header = /** @type {Header} */ (this.header);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    this.#image(header, picture, kept.quad, clipFromPixels(header.width, header.height), opacity);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
  }

  /** @param {Viewpoint} viewer @param {any} kept @param {WebGLTexture} picture @param {DrawOptions} options @param {number} eye */
  #picture(viewer, kept, picture, options, eye) {
    const { gl } = this;
    const header = /** @type {Header} */ (this.header);
    const { program, at } = /** @type {any} */ (this.painter);
    const source = header.cameras[Math.min(eye, header.cameras.length - 1)];
    const still = !options.reproject || samePlace(source, header.width, header.height, viewer);
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, picture);
    gl.uniform2f(at.size, header.width, header.height);
    gl.uniform1f(at.tone, 1);
    gl.uniform1f(at.opacity, 1);
    gl.uniform3fv(at.ground, this.ground);
    if (still) {
      gl.uniformMatrix4fv(at.clip, false, clipFromPixels(header.width, header.height));
      gl.bindVertexArray(kept.quad.array);
      gl.drawElements(gl.TRIANGLES, kept.quad.solid, gl.UNSIGNED_INT, 0);
      if (!options.rig || !kept.mesh) return;
      gl.colorMask(false, false, false, false);
    }
    const mesh = kept.mesh ?? kept.quad;
    gl.uniformMatrix4fv(at.clip, false, this.#clip(source, viewer, kept));
    gl.bindVertexArray(mesh.array);
    gl.depthMask(false); // whatever was seen is drawn over it
    gl.uniform1f(at.tone, STRETCHED_TONE);
    gl.drawElements(gl.TRIANGLES, mesh.stretched, gl.UNSIGNED_INT, 4 * mesh.solid);
    gl.depthMask(true);
    gl.uniform1f(at.tone, 1);
    gl.drawElements(gl.TRIANGLES, mesh.solid, gl.UNSIGNED_INT, 0);
    gl.colorMask(true, true, true, true);
  }

  /** Without depth the picture is a plane as far away as the viewer's target. @param {any} source @param {Viewpoint & {distance?: number}} viewer @param {any} kept */
  #clip(source, viewer, kept) {
    const clip = clipFromPicture(source, viewer);
    if (!kept.mesh) for (let i = 0; i < 12; i++) clip[i] *= viewer.distance ?? 1;
    return clip;
  }
}

/** Whether the processor does what a GPU should. */
function software() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

/** @param {WebGL2RenderingContext} gl */
function texture(gl) {
  const made = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, made);
  for (const [name, value] of [
    [gl.TEXTURE_MIN_FILTER, gl.LINEAR],
    [gl.TEXTURE_MAG_FILTER, gl.LINEAR],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE],
    [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
  ]) {
    gl.texParameteri(gl.TEXTURE_2D, name, value);
  }
  return made;
}

/** @param {WebGL2RenderingContext} gl @param {any} kept buffers to use again @param {Surface | null} surface */
function upload(gl, kept, surface) {
  if (!surface) return null;
  const mesh = kept ?? { array: gl.createVertexArray(), vertices: gl.createBuffer(), indices: gl.createBuffer() };
  gl.bindVertexArray(mesh.array);
  gl.bindBuffer(gl.ARRAY_BUFFER, mesh.vertices);
  gl.bufferData(gl.ARRAY_BUFFER, surface.vertices, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 20, 0);
  gl.enableVertexAttribArray(1);
  gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 20, 12);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.indices);
  const [solid, stretched] = [surface.solid.length, surface.stretched.length];
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, 4 * (solid + stretched), gl.DYNAMIC_DRAW);
  gl.bufferSubData(gl.ELEMENT_ARRAY_BUFFER, 0, surface.solid);
  if (stretched) gl.bufferSubData(gl.ELEMENT_ARRAY_BUFFER, 4 * solid, surface.stretched);
  gl.bindVertexArray(null);
  return Object.assign(mesh, { solid, stretched });
}
