// Stereo in a headset through WebXR: the server renders both eyes, and each image is reprojected to where the
// eye is now.

import { add, cross, dot, multiply, scale, sub, transpose } from "./view/matrix.js";
import { cameraAxes, eyeFromPose } from "./view/pose.js";

/** An eye's image has this width and height, in pixels. */
const EYE_SIDE = 512;
/** Surfaces nearer than this distance, in metres, are not drawn. */
const NEAR_M = 0.05;
/** Surfaces farther than this distance, in metres, are not drawn. */
const FAR_M = 200;
/** The rotation between WebXR's camera axes (y up, -z ahead) and ours (y down, z ahead). */
const FLIP_YZ = [1, 0, 0, 0, -1, 0, 0, 0, -1];

/** Whether the browser supports a headset. @returns {Promise<boolean>} */
export async function isHeadsetSupported() {
  const xr = /** @type {any} */ (navigator).xr;
  return Boolean(await xr?.isSessionSupported?.("immersive-vr").catch(() => false));
}

/** @param {Float32Array | number[]} m column-major 4 x 4 @returns {number[]} its rotation, row by row */
const extractRotation = (m) => [m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]];

/**
 * The axes of a headset's floor (x right, y up, -z ahead, floor at 0) in the world, at the page's view. The
 * floor is at the foot of the subject's box.
 * @param {any} rig
 * @param {any} pose
 * @returns {{R: number[], T: number[]}} world from floor
 */
function computeFloor(rig, pose) {
  const { right } = cameraAxes(rig, { ...pose, elevation: 0, roll: 0 });
  const eye = eyeFromPose(rig, pose);
  const heights = [rig.bounds.low, rig.bounds.high].map((corner) => dot(corner, rig.up));
  const origin = add(eye, scale(rig.up, Math.min(...heights) - dot(eye, rig.up)));
  const back = cross(right, rig.up);
  return { R: transpose([...right, ...rig.up, ...back]), T: origin };
}

/**
 * Convert one eye of WebXR to a camera.
 * @param {any} view an XRView
 * @param {{R: number[], T: number[]}} floor world from floor
 * @param {number} width of the image, pixels
 * @param {number} height
 */
function cameraFromView(view, floor, width, height) {
  // position and axes in the world
  const m = view.transform.matrix;
  const worldFromCamera = multiply(multiply(floor.R, extractRotation(m)), FLIP_YZ);
  const R = transpose(worldFromCamera);
  const position = [m[12], m[13], m[14]];
  const eye = [0, 1, 2].map((row) => dot(floor.R.slice(3 * row, 3 * row + 3), position) + floor.T[row]);
  const T = [0, 1, 2].map((row) => -dot(R.slice(3 * row, 3 * row + 3), eye));

  // intrinsics in pixels
  const p = view.projectionMatrix;
  const lens = {
    fx: (p[0] * width) / 2,
    fy: (p[5] * height) / 2,
    cx: ((1 - p[8]) * width) / 2,
    cy: ((1 + p[9]) * height) / 2,
    width,
    height,
  };
  return { R, T, lens, distance: Math.hypot(...sub(eye, floor.T)) };
}

/**
 * @typedef {object} HeadsetPage what the headset needs of the page
 * @property {(eyes: any[], side: number) => void} requestEyes
 * @property {() => import("./draw/stage.js").DrawOptions} drawOptions
 * @property {() => void} ended
 */

export class Headset {
  /** @param {import("./draw/stage.js").Stage} stage @param {HeadsetPage} page */
  constructor(stage, page) {
    this.stage = stage;
    this.page = page;
    /** @type {any} */
    this.session = null;
  }

  /**
   * Start a session.
   * @param {any} rig
   * @param {any} pose of the page's view, where the session starts
   */
  async enter(rig, pose) {
    const xr = /** @type {any} */ (navigator).xr;
    if (!rig) throw new Error("there is no view yet");
    const session = await xr.requestSession("immersive-vr", { optionalFeatures: ["local-floor"] });
    this.session = session;
    session.addEventListener("end", () => {
      this.session = null;
      this.page.ended();
    });
    try {
      await this.#begin(session, rig, pose);
    } catch (error) {
      await session.end().catch(() => null); // it may have ended by itself
      throw error;
    }
  }

  /**
   * Paint in a session until it ends.
   * @param {any} session
   * @param {any} rig
   * @param {any} pose
   */
  async #begin(session, rig, pose) {
    const { gl } = this.stage;
    await /** @type {any} */ (gl).makeXRCompatible();
    const layer = new /** @type {any} */ (window).XRWebGLLayer(session, gl);
    await session.updateRenderState({ baseLayer: layer, depthNear: NEAR_M, depthFar: FAR_M });
    const space = await session
      .requestReferenceSpace("local-floor")
      .catch(() => session.requestReferenceSpace("local"));
    const floor = computeFloor(rig, pose);
    const paint = (/** @type {number} */ _now, /** @type {any} */ frame) => {
      if (this.session !== session) return;
      session.requestAnimationFrame(paint);
      const viewerPose = frame.getViewerPose(space);
      if (viewerPose) this.#paint(viewerPose.views, layer, floor);
    };
    session.requestAnimationFrame(paint);
  }

  /**
   * Request the views of both eyes, and draw the last ones.
   * @param {any[]} views XRViews
   * @param {any} layer
   * @param {{R: number[], T: number[]}} floor
   */
  #paint(views, layer, floor) {
    const { gl } = this.stage;
    gl.bindFramebuffer(gl.FRAMEBUFFER, layer.framebuffer);
    const eyes = views.slice(0, 2).map((view) => cameraFromView(view, floor, EYE_SIDE, EYE_SIDE));
    this.page.requestEyes(
      eyes.map(({ R, T, lens: { fx, fy, cx, cy } }) => ({ R, T, fx, fy, cx, cy })),
      EYE_SIDE,
    );
    views.forEach((view, eye) => {
      const { x, y, width, height } = layer.getViewport(view);
      const camera = cameraFromView(view, floor, width, height);
      this.stage.draw(camera, [x, y, width, height], { ...this.page.drawOptions(), reproject: true }, eye);
    });
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
}
