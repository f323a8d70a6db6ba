// Stereo in a headset through WebXR: the server renders two eyes from one state, each is turned to where the eye is now.

import { add, cross, dot, multiply, scale, sub, transpose } from "./view/matrix.js";
import { axes, eyeOf } from "./view/pose.js";

/** Pixels of an eye's picture, and how far a walker's floor lies below the subject's box. */
const EYE_SIDE = 512;

/** Whether there is a headset. @returns {Promise<boolean>} */
export async function headsetThere() {
  const xr = /** @type {any} */ (navigator).xr;
  return Boolean(await xr?.isSessionSupported?.("immersive-vr").catch(() => false));
}

/** @param {Float32Array | number[]} m column-major 4 x 4 @returns {number[]} its rotation, row by row */
const rotation = (m) => [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]];

/** A walker's axes (x right, y up, -z ahead, floor at 0) in the world, where the page's view is now. @param {any} rig @param {any} pose */
export function floorOf(rig, pose) {
  const { right } = axes(rig, { ...pose, elevation: 0, roll: 0 });
  const eye = eyeOf(rig, pose);
  const corners = [rig.bounds.low, rig.bounds.high].map((corner) => dot(corner, rig.up));
  const origin = add(eye, scale(rig.up, Math.min(...corners) - dot(eye, rig.up)));
  const back = cross(right, rig.up);
  return { R: transpose([...right, ...rig.up, ...back]), T: origin };
}

/**
 * One eye of WebXR as a camera of ours.
 * @param {any} view an XRView @param {{R: number[], T: number[]}} floor @param {number} width @param {number} height
 */
export function eyeCamera(view, floor, width, height) {
  const flip = [1, 0, 0, 0, -1, 0, 0, 0, -1];
  const m = view.transform.matrix;
  const world = multiply(multiply(floor.R, rotation(m)), flip);
  const R = transpose(world);
  const place = [m[12], m[13], m[14]];
  const eye = [0, 1, 2].map((row) => dot(floor.R.slice(3 * row, 3 * row + 3), place) + floor.T[row]);
  const T = [0, 1, 2].map((row) => -dot(R.slice(3 * row, 3 * row + 3), eye));
  const p = view.projectionMatrix;
  const lens = {
    fx: (p[0] * width) / 2, fy: (p[5] * height) / 2, cx: ((1 - p[8]) * width) / 2, cy: ((1 + p[9]) * height) / 2, width, height,
  };
  return { R, T, lens, distance: Math.hypot(...sub(eye, floor.T)) };
}

export class Headset {
  /**
   * @param {import("./draw/stage.js").Stage} stage
   * @param {{look: (eyes: any[], side: number) => void, drawOptions: () => import("./draw/stage.js").DrawOptions, ended: () => void}} page
   */
  constructor(stage, page) {
    this.stage = stage;
    this.page = page;
    /** @type {any} */
    this.session = null;
  }

  /** @param {any} rig @param {any} pose of the page's view: the walker begins there */
  async enter(rig, pose) {
    const xr = /** @type {any} */ (navigator).xr;
    const { gl } = this.stage;
    const session = await xr.requestSession("immersive-vr", { optionalFeatures: ["local-floor"] });
    await /** @type {any} */ (gl).makeXRCompatible();
    const layer = new /** @type {any} */ (window).XRWebGLLayer(session, gl);
    await session.updateRenderState({ baseLayer: layer, depthNear: 0.05, depthFar: 200 });
    const space = await session.requestReferenceSpace("local-floor").catch(() => session.requestReferenceSpace("local"));
    const floor = floorOf(rig, pose);
    this.session = session;
    session.addEventListener("end", () => {
      this.session = null;
      this.page.ended();
    });
    const paint = (/** @type {number} */ _now, /** @type {any} */ frame) => {
      if (this.session !== session) return;
      session.requestAnimationFrame(paint);
      const seen = frame.getViewerPose(space);
      if (seen) this.#paint(seen.views, layer, floor);
    };
    session.requestAnimationFrame(paint);
  }

  /** @param {any[]} views @param {any} layer @param {{R: number[], T: number[]}} floor */
  #paint(views, layer, floor) {
    const { gl } = this.stage;
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    const asked = views.slice(0, 2).map((view) => eyeCamera(view, floor, EYE_SIDE, EYE_SIDE));
    this.page.look(asked.map(({ R, T, lens: { fx, fy, cx, cy } }) => ({ R, T, fx, fy, cx, cy })), EYE_SIDE);
    views.forEach((view, eye) => {
      const { x, y, width, height } = layer.getViewport(view);
      this.stage.draw(eyeCamera(view, floor, width, height), [x, y, width, height], { ...this.page.drawOptions(), reproject: true }, eye);
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
}
