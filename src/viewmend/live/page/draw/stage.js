// The canvas, which shows the last frame as seen from the newest pose, with the rig on top.

import { buildProgram } from "./program.js";
import { LinePainter } from "./lines.js";
import { computePyramidDepth } from "./rig.js";
import { clipFromImage, clipFromPixels, clipFromWorld, isSameView } from "./projection.js";
import { Scene, countFillers } from "./scene.js";
import { buildPlane } from "./surface.js";
import { length, sub } from "../view/matrix.js";
import { eyeFromExtrinsics } from "../view/pose.js";

/** @typedef {import("./projection.js").Viewpoint} Viewpoint */
/** @typedef {Viewpoint & {distance?: number}} TargetViewpoint with the distance of its target, metres */
/** @typedef {import("./surface.js").Surface} Surface */
/** @typedef {import("../link/frames.js").Header} Header */

/**
 * @typedef {object} Shown a decoded frame of the server
 * @property {Header} header
 * @property {{modes: Record<string, import("../link/pictures.js").Picture>, surface: Surface | null}[]} eyes
 */

/**
 * @typedef {object} DrawOptions
 * @property {{mode: string, until: number}[]} parts modes from left to right, each until a share of the width
 * @property {boolean} reproject whether the server's image is reprojected to the newest pose
 * @property {any} rig the rig to show; null for none
 *   image of the same view; null or undefined to show the server's image only
 */

/** Places each pixel of an image by its depth. */
const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec2 shade;
uniform mat4 clip;
out vec3 pixel;
void main() {
  pixel = vec3(shade * position.z, position.z);
  gl_Position = clip * vec4(position.xy * position.z, position.z, 1.0);
}`;

/** Colours a surface by an image. */
const FRAGMENT = `#version 300 es
precision highp float;
uniform sampler2D image;
uniform vec2 size;
uniform float tone;
uniform vec3 background;
uniform float opacity;
in vec3 pixel;
out vec4 colour;
void main() {
  vec3 seen = texture(image, pixel.xy / pixel.z / size).rgb;
  // the background has one colour, but compression leaves traces in it
  vec3 off = abs(seen - background);
  float something = smoothstep(0.015, 0.055, max(off.r, max(off.g, off.b)));
  colour = vec4(mix(background, seen * tone, something), opacity);
}`;

/** The brightness of disoccluded areas, which show the colours next to them. */
const STRETCHED_TONE = 0.6;
/** The server's image appears over the drawn view within this time, in milliseconds. */
const FADE_MS = 250;
/** The server's image is at least this opaque while it appears. */
const MIN_OPACITY = 0.01;
/** A view is at a camera if it is no farther from it than this share of its distance to the target. */
const AT_CAMERA = 0.01;
/**
 * A camera's image is hidden if the view is closer to the camera than this multiple of its pyramid's depth.
 */
const NEAR_PYRAMID = 1.5;
/** A vertex has this many bytes: u, v, z, s, t. */
const VERTEX_BYTES = 20;
/** The offset of s and t in a vertex, in bytes. */
const SHADE_OFFSET = 12;

export class Stage {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.software = usesSoftwareRenderer();
    // smooth the outlines of drawn views where this is cheap and pixels are large enough to see
    const antialias = !this.software && window.devicePixelRatio < 2;
    const options = { antialias, stencil: true, powerPreference: "high-performance" };
    const gl = /** @type {WebGL2RenderingContext | null} */ (canvas.getContext("webgl2", options));
    if (!gl) throw new Error("This page needs WebGL 2, which this browser does not offer.");
    this.gl = gl;
    this.background = [0, 0, 0];
    /** The last requested result, and its first request: of the view, and of the one by another model. */
    this.expected = { view: "", since: 0, model: /** @type {string | null} */ (null), comparedSince: 0 };
    this.prepare();
  }

  /** Create everything that lives on the GPU, also after the context was lost. */
  prepare() {
    /** The header of the server's last frame. @type {Header | null} */
    this.header = null;
    /** Textures and meshes of the server's last frame. @type {any[]} */
    this.eyes = [];
    /**
     * Images of cameras by mode, "original" and "error".
     * @type {Record<string, {camera: any, image: WebGLTexture, quad: any} | null>}
     */
    this.photos = { original: null, error: null };
    /** Plane of the camera image that is drawn. @type {any} */
    this.cutOutQuad = null;
    this.shader = buildProgram(this.gl, VERTEX, FRAGMENT, ["clip", "size", "tone", "background", "opacity"]);
    this.scene = new Scene(this.gl, countFillers(this.software));
    /** When the server's last image arrived, in milliseconds, and the opacity that it was last drawn with. */
    this.lastImage = { arrivedAt: -Infinity, opacity: 0 };
    this.lines = new LinePainter(this.gl);
  }

  /**
   * Take note of a request: the image of another result than the requested one is not shown over a frame.
   * @param {number} id
   * @param {{without: string[], error_rule: string | null, background: string, model: string | null}} request
   */
  expect(id, { without, error_rule, background, model }) {
    const { expected } = this;
    const view = JSON.stringify([without, error_rule, background]);
    if (view !== expected.view) expected.since = id;
    if (model !== expected.model) expected.comparedSince = id;
    expected.view = view;
    expected.model = model;
  }

  /** Upload a frame of the server; its images are closed. @param {Shown} shown */
  take(shown) {
    const { gl } = this;
    const { width, height } = shown.header;
    shown.eyes.forEach((eye, index) => {
      const stored = (this.eyes[index] ??= { textures: {}, mesh: null });
      stored.modes = Object.keys(eye.modes);
      for (const [mode, image] of Object.entries(eye.modes)) {
        stored.textures[mode] ??= createTexture(gl);
        gl.bindTexture(gl.TEXTURE_2D, stored.textures[mode]);
        gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
        image.close();
      }
      stored.mesh = uploadSurface(gl, stored.mesh, eye.surface);
      stored.quad = uploadSurface(gl, stored.quad, buildPlane(width, height, 1));
    });
    this.eyes.length = shown.eyes.length;
    this.header = shown.header;
    this.lastImage = { arrivedAt: performance.now(), opacity: 0 };
  }

  /**
   * Set the image of a camera, which is shown at that camera.
   * @param {string} mode "original" or "error"
   * @param {any} camera of the rig
   * @param {TexImageSource | null} image null to show none
   */
  setPhoto(mode, camera, image) {
    const { gl } = this;
    const last = this.photos[mode];
    if (!image) {
      if (last) gl.deleteTexture(last.image);
      this.photos[mode] = null;
      return;
    }
    const texture = last?.image ?? createTexture(gl);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    const quad = uploadSurface(gl, last?.quad ?? null, buildPlane(camera.width, camera.height, 1));
    this.photos[mode] = { camera, image: texture, quad };
  }

  /** Whether the server's image is still appearing over the drawn view. */
  get fading() {
    return this.lastImage.opacity > 0 && this.lastImage.opacity < 1;
  }

  /** Clear the whole canvas. @param {string} background colour, hexadecimal RGB */
  clear(background) {
    const { gl } = this;
    this.background = [0, 2, 4].map((start) => parseInt(background.slice(start, start + 2), 16) / 255);
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(this.background[0], this.background[1], this.background[2], 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }

  /**
   * Clear a part of the current framebuffer and draw into it.
   * @param {TargetViewpoint} viewer
   * @param {number[]} viewport x, y, width, height in pixels, y up
   * @param {DrawOptions} options
   * @param {number} [eye] 0, or 1 for the second eye of a headset
   */
  draw(viewer, viewport, options, eye = 0) {
    if (options.frame) this.#drawScene(viewer, viewport, options, options.frame, eye);
    else this.#drawImages(viewer, viewport, options, eye);
  }

  /**
   * Draw the server's images.
   * @param {TargetViewpoint} viewer
   * @param {number[]} viewport
   * @param {DrawOptions} options
   * @param {number} eye
   */
  #drawImages(viewer, viewport, options, eye) {
    const { gl } = this;
    const [x, y, width, height] = viewport;
    gl.viewport(x, y, width, height);
    gl.scissor(x, y, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const eyeImages = this.eyes[Math.min(eye, this.eyes.length - 1)];
    if (this.header && eyeImages) {
      let start = 0;
      for (const { mode, until } of options.parts) {
        const left = Math.round(start * width);
        const right = Math.round(until * width);
        gl.scissor(x + left, y, Math.max(0, right - left), height);
        const shown = this.resolveMode(viewer, mode);
        if (shown in this.photos) {
          this.#drawPhoto(viewer, shown);
        } else {
          const available = eyeImages.modes.includes(shown) ? shown : eyeImages.modes[0];
          this.#drawReprojected(viewer, eyeImages, eyeImages.textures[available], options, eye);
        }
        start = until;
      }
      gl.scissor(x, y, width, height);
    }
    if (options.rig) this.lines?.draw(clipFromWorld(viewer), width, height);
  }

  /**
   * Draw a frame here, and the server's image of the same view over it.
   * @param {TargetViewpoint} viewer
   * @param {number[]} viewport
   * @param {DrawOptions} options
   * @param {import("../link/assets.js").Frame} frame
   * @param {number} eye
   */
  #drawScene(viewer, viewport, options, frame, eye) {
    const { gl } = this;
    const [x, y, width, height] = viewport;
    const position = eyeFromExtrinsics(viewer);
    const modes = options.parts.map(({ mode }) => this.resolveMode(viewer, mode));
    this.scene.prepare(frame, position, modes);
    const cutOuts = options.rig ? this.scene.buildCutOuts(frame) : [];
    const eyeImages = this.eyes[Math.min(eye, this.eyes.length - 1)];
    const opacities = modes.map((mode) => {
      return eyeImages?.modes.includes(mode) ? this.#computeOpacity(viewer, frame, eye, mode) : 0;
    });
    this.lastImage.opacity = Math.max(...opacities);
    gl.viewport(x, y, width, height);
    gl.enable(gl.SCISSOR_TEST);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    gl.scissor(x, y, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);

    // draw each mode in its part of the viewport
    let start = 0;
    options.parts.forEach(({ until }, index) => {
      const mode = modes[index];
      const left = Math.round(start * width);
      const right = Math.round(until * width);
      gl.scissor(x + left, y, Math.max(0, right - left), height);
      start = until;
      if (mode in this.photos) {
        this.#drawPhoto(viewer, mode);
        return;
      }
      const imageOpacity = opacities[index];
      if (imageOpacity < 1 || options.rig) {
        this.scene.draw(frame, viewer, position, mode, viewport, this.background);
      }
      if (imageOpacity > 0) this.#drawOverlay(eyeImages.quad, eyeImages.textures[mode], imageOpacity);
    });
    gl.scissor(x, y, width, height);
    if (!options.rig) return;

    // draw the images of the cameras, and the rig
    for (const { camera, image } of cutOuts) {
      const depth = computePyramidDepth(camera, options.rig.center);
      const hidesView = length(sub(position, camera.center)) < NEAR_PYRAMID * depth;
      if (hidesView) continue;
      const plane = buildPlane(camera.width, camera.height, depth);
      this.cutOutQuad = uploadSurface(gl, this.cutOutQuad, plane);
      this.#drawQuad(camera, image, this.cutOutQuad, clipFromImage(camera, viewer));
    }
    this.lines?.draw(clipFromWorld(viewer), width, height);
  }

  /**
   * Compute the opacity of the server's image over a drawn frame; 0 if it shows another view or result.
   * @param {Viewpoint} viewer
   * @param {import("../link/assets.js").Frame} frame
   * @param {number} eye
   * @param {string} mode
   */
  #computeOpacity(viewer, frame, eye, mode) {
    const { header, expected } = this;
    if (!header || header.time !== frame.time || header.look < expected.since) return 0;
    if (mode === "compared" && header.look < expected.comparedSince) return 0;
    const camera = header.cameras[Math.min(eye, header.cameras.length - 1)];
    if (!isSameView(camera, header.width, header.height, viewer)) return 0;
    return Math.min(1, Math.max(MIN_OPACITY, (performance.now() - this.lastImage.arrivedAt) / FADE_MS));
  }

  /**
   * Draw an image on a plane.
   * @param {{width: number, height: number}} size of the image, pixels
   * @param {WebGLTexture} image
   * @param {any} quad
   * @param {Float32Array} clip clip from the image's pixels and depth
   * @param {number} [opacity]
   */
  #drawQuad(size, image, quad, clip, opacity = 1) {
    const { gl } = this;
    const { at } = this.#useImage(size, image, opacity);
    gl.uniformMatrix4fv(at.clip, false, clip);
    gl.bindVertexArray(quad.array);
    gl.drawElements(gl.TRIANGLES, quad.solid, gl.UNSIGNED_INT, 0);
  }

  /**
   * Bind an image.
   * @param {{width: number, height: number}} size
   * @param {WebGLTexture} image
   * @param {number} opacity
   */
  #useImage(size, image, opacity) {
    const { gl } = this;
    const shader = /** @type {any} */ (this.shader);
    const { program, at } = shader;
    gl.useProgram(program);
    gl.bindTexture(gl.TEXTURE_2D, image);
    gl.uniform2f(at.size, size.width, size.height);
    gl.uniform1f(at.tone, 1);
    gl.uniform1f(at.opacity, opacity);
    gl.uniform3fv(at.background, this.background);
    return shader;
  }

  /**
   * Find the mode that is drawn: the completed view in place of an image that does not exist at this pose.
   * @param {TargetViewpoint} viewer
   * @param {string} mode
   * @returns {string}
   */
  resolveMode(viewer, mode) {
    if (!(mode in this.photos)) return mode;
    const photo = this.photos[mode];
    if (!photo) return "completed";
    const offset = length(sub(eyeFromExtrinsics(viewer), photo.camera.center));
    return offset > AT_CAMERA * (viewer.distance ?? 1) ? "completed" : mode;
  }

  /**
   * Draw the image of a camera.
   * @param {TargetViewpoint} viewer
   * @param {string} mode
   */
  #drawPhoto(viewer, mode) {
    const { gl } = this;
    const photo = this.photos[mode];
    if (!photo) return;
    const { camera, image, quad } = photo;
    gl.disable(gl.DEPTH_TEST);
    this.#drawQuad(camera, image, quad, this.#computeClip(camera, viewer, false));
    gl.enable(gl.DEPTH_TEST);
  }

  /**
   * Blend the server's image over the drawn view.
   * @param {any} quad
   * @param {WebGLTexture} image
   * @param {number} opacity
   */
  #drawOverlay(quad, image, opacity) {
    const { gl } = this;
    const header = /** @type {Header} */ (this.header);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ONE);
    this.#drawQuad(header, image, quad, clipFromPixels(header.width, header.height), opacity);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
  }

  /**
   * Draw the server's image, reprojected to the viewer's pose by its depth.
   * @param {TargetViewpoint} viewer
   * @param {any} geometry mesh and quad of the eye
   * @param {WebGLTexture} image
   * @param {DrawOptions} options
   * @param {number} eye
   */
  #drawReprojected(viewer, geometry, image, options, eye) {
    const { gl } = this;
    const header = /** @type {Header} */ (this.header);
    const source = header.cameras[Math.min(eye, header.cameras.length - 1)];
    const { at } = this.#useImage(header, image, 1);

    // an image that needs no reprojection is drawn as it is; for the rig, its depth is drawn, too
    const still = !options.reproject || isSameView(source, header.width, header.height, viewer);
    if (still) {
      gl.uniformMatrix4fv(at.clip, false, clipFromPixels(header.width, header.height));
      gl.bindVertexArray(geometry.quad.array);
      gl.drawElements(gl.TRIANGLES, geometry.quad.solid, gl.UNSIGNED_INT, 0);
      if (!options.rig || !geometry.mesh) return;
      gl.colorMask(false, false, false, false);
    }

    // draw the disoccluded areas, then the surfaces that were seen over them
    const mesh = geometry.mesh ?? geometry.quad;
    gl.uniformMatrix4fv(at.clip, false, this.#computeClip(source, viewer, Boolean(geometry.mesh)));
    gl.bindVertexArray(mesh.array);
    gl.depthMask(false);
    gl.uniform1f(at.tone, STRETCHED_TONE);
    gl.drawElements(gl.TRIANGLES, mesh.stretched, gl.UNSIGNED_INT, 4 * mesh.solid);
    gl.depthMask(true);
    gl.uniform1f(at.tone, 1);
    gl.drawElements(gl.TRIANGLES, mesh.solid, gl.UNSIGNED_INT, 0);
    gl.colorMask(true, true, true, true);
  }

  /**
   * Compute the matrix from an image to clip space. An image without depth is a plane at the viewer's target.
   * @param {any} source camera of the image
   * @param {TargetViewpoint} viewer
   * @param {boolean} hasDepth
   */
  #computeClip(source, viewer, hasDepth) {
    const clip = clipFromImage(source, viewer);
    if (hasDepth) return clip;
    for (let i = 0; i < 12; i++) {
      clip[i] *= viewer.distance ?? 1;
    }
    return clip;
  }
}

/** Whether the processor draws in place of a GPU. */
function usesSoftwareRenderer() {
  const gl = document.createElement("canvas").getContext("webgl2");
  if (!gl) return false;
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

/** @param {WebGL2RenderingContext} gl */
function createTexture(gl) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return texture;
}

/**
 * Upload a surface.
 * @param {WebGL2RenderingContext} gl
 * @param {any} existing buffers to use again; null to create new ones
 * @param {Surface | null} surface
 */
function uploadSurface(gl, existing, surface) {
  if (!surface) return null;
  const mesh = existing ?? {
    array: gl.createVertexArray(),
    vertices: gl.createBuffer(),
    indices: gl.createBuffer(),
  };
  gl.bindVertexArray(mesh.array);
  gl.bindBuffer(gl.ARRAY_BUFFER, mesh.vertices);
  gl.bufferData(gl.ARRAY_BUFFER, surface.vertices, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(0);
  gl.vertexAttribPointer(0, 3, gl.FLOAT, false, VERTEX_BYTES, 0);
  gl.enableVertexAttribArray(1);
  gl.vertexAttribPointer(1, 2, gl.FLOAT, false, VERTEX_BYTES, SHADE_OFFSET);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, mesh.indices);
  const solid = surface.solid.length;
  const stretched = surface.stretched.length;
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, 4 * (solid + stretched), gl.DYNAMIC_DRAW);
  gl.bufferSubData(gl.ELEMENT_ARRAY_BUFFER, 0, surface.solid);
  if (stretched) gl.bufferSubData(gl.ELEMENT_ARRAY_BUFFER, 4 * solid, surface.stretched);
  gl.bindVertexArray(null);
  return Object.assign(mesh, { solid, stretched });
}
