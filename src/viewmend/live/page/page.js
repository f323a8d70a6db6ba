// The viewer page: connects its parts, and repaints when something has changed.
// Its frames come from a server (main.js) or from files (published.js).

import { DRAWN_MODES } from "./draw/scene.js";
import { Stage } from "./draw/stage.js";
import { findSurfacePoint } from "./draw/projection.js";
import { buildRigLines } from "./draw/rig.js";
import { Headset, isHeadsetSupported } from "./headset.js";
import { Settings, parseMode } from "./settings.js";
import { CameraList } from "./ui/cameras.js";
import { buildControls } from "./ui/controls.js";
import { byId } from "./ui/dom.js";
import { Layout } from "./ui/layout.js";
import { buildModes, nameSides, offerModels, placeDivider } from "./ui/modes.js";
import { Original } from "./ui/original.js";
import { showScale } from "./ui/scale.js";
import { Notices } from "./ui/notices.js";
import { OnAir } from "./ui/on_air.js";
import { PathPanel } from "./ui/paths.js";
import { Refining } from "./ui/refining.js";
import { Statistics } from "./ui/statistics.js";
import { buildTools, saveScreenshot } from "./ui/tools.js";
import { Transport } from "./ui/transport.js";
import { listenToGestures } from "./view/gestures.js";
import { Keys } from "./view/keys.js";
import { chooseSize, computeSharpSide, fitBox, fovFromFocal, lensFromFov, resizeLens } from "./view/lens.js";
import { Motion } from "./view/motion.js";
import { formatPose, parseFrameIndex, parsePose } from "./view/url_state.js";
import { extrinsicsFromPose, eyeFromPose, poseFromCamera } from "./view/pose.js";
import { RepaintLimiter, Resolution } from "./draw/resolution.js";

/** A double-click multiplies the distance to the target by this factor. */
const DOUBLE_CLICK_ZOOM = 0.7;
/** A double-click never brings the view closer than this share of the rig's home distance. */
const MIN_DISTANCE_SHARE = 0.1;
/** Image sizes are limited to these values, in pixels, until the server has sent its own limits. */
const DEFAULT_LIMITS = { max_side_px: 2048, max_pixels: 2 ** 21 };
/** The vertical field of view, in degrees, that is used before there is a pose. */
const DEFAULT_FOV = 50;
/** The identity as a 3 x 3 rotation, row by row. */
const NO_ROTATION = [1, 0, 0, 0, 1, 0, 0, 0, 1];

/**
 * @typedef {object} Source what the frames come from
 * @property {boolean} live whether a server renders views, too
 * @property {string[]} modes modes that can be shown, in the order of the mode strip
 * @property {URLSearchParams} query parameters of the URL, which may name a view
 * @property {string | null} token
 * @property {any} connection its "status" events say whether frames are available; `open()` tries again
 * @property {any} link dispatches "rig" and "state", and accepts changes of the clock; see link/viewer.js
 * @property {import("./link/assets.js").Assets} assets
 * @property {import("./view/url_state.js").UrlState} urlState writes the view to the URL
 * @property {import("./ui/paths.js").Films} films
 * @property {() => Promise<void>} start
 */

class Page {
  /** @param {Source} source */
  constructor(source) {
    const { query, token } = source;
    this.source = source;
    this.connection = source.connection;
    this.link = source.link;
    this.urlState = source.urlState;
    this.canvas = byId("picture");

    // state of the view
    this.settings = new Settings(query, source.modes, source.live);
    this.stage = new Stage(this.canvas);
    this.motion = new Motion(window.matchMedia("(prefers-reduced-motion: reduce)").matches);
    this.motion.initialPose = parsePose(query.get("pose"));
    this.assets = source.assets;
    this.assets.fillers = this.stage.scene.fillers;
    /**
     * The frame that the page draws; null if the server draws.
     * @type {import("./link/assets.js").Frame | null}
     */
    this.drawn = null;
    /** The camera that the view was moved to, and the pose that this gave. @type {any} */
    this.snapped = null;
    this.limits = DEFAULT_LIMITS;

    // scheduling of repaints
    this.resolution = new Resolution();
    /** Canvas pixels per CSS pixel at the last repaint. */
    this.paintedRatio = 0;
    this.repaints = new RepaintLimiter(this.stage.software);
    this.refreshedAt = 0;
    this.scheduled = false;
    /** Whether the next refresh has to paint, even if frame and pose are the same. */
    this.stale = true;

    // parts of the user interface
    this.notices = new Notices(() => this.connection.open());
    this.onAir = new OnAir(this.link, this.notices, token);
    this.refining = new Refining();
    this.transport = new Transport(this.link, parseFrameIndex(query.get("time")));
    this.statistics = new Statistics(() => this.isActive);
    this.layout = new Layout(this.settings, () => this.wake());
    this.cameras = new CameraList(this.settings, (camera) => this.snap(camera));
    this.original = new Original(token, (mode, camera, image) => {
      this.stage.setPhoto(mode, camera, image);
      this.wake();
    });
    this.headset = new Headset(this.stage, {
      requestEyes: (eyes, side) => this.requestEyes(eyes, side),
      drawOptions: () => this.buildDrawOptions(0.5),
      ended: () => this.wake(),
    });
    this.paths = new PathPanel({
      motion: this.motion,
      transport: this.transport,
      notices: this.notices,
      settings: this.settings,
      films: source.films,
      wake: () => this.wake(),
    });
    buildModes(this.settings, source.modes);
    this.controls = buildControls(this.settings, this.motion, () => this.wake());
    this.tools = this.buildTools();

    // input
    this.keys = new Keys(this.motion, this.listActions(), () => this.wake());
    listenToGestures(
      this.canvas,
      this.motion,
      () => this.computeViewer().lens.fx,
      () => this.wake(),
      (x, y) => this.focus(x, y),
    );
    this.settings.addEventListener("change", () => this.wake());
    this.listenToLink();
    this.listenToAssets();
    this.listenToCanvas();
  }

  buildTools() {
    return buildTools({
      settings: this.settings,
      notices: this.notices,
      reset: () => this.reset(),
      saveScreenshot: () => {
        const name = `viewmend-${String(this.transport.shown).padStart(4, "0")}.png`;
        saveScreenshot(this.canvas, () => this.paint(), name, this.notices);
      },
      getLink: () => {
        this.updateUrl();
        return this.urlState.getLink();
      },
      enterHeadset: () => this.headset.enter(this.motion.rig, this.motion.pose),
    });
  }

  /** The action of each key, by `KeyboardEvent.code` or `key`. @returns {Record<string, () => void>} */
  listActions() {
    const { settings, transport, tools } = this;
    const toggle = (/** @type {"rig" | "reproject" | "panel"} */ name) => () => {
      settings.set(name, !settings.get(name));
    };
    const modes = this.source.modes.map((mode, index) => {
      return [`Digit${index + 1}`, () => settings.set("mode", mode)];
    });
    return {
      ...Object.fromEntries(modes),
      KeyR: () => this.reset(),
      Home: () => this.reset(),
      KeyF: () => this.controls.setMovement(this.motion.mode === "fly" ? "orbit" : "fly"),
      KeyN: () => this.cameras.goToNext(1),
      KeyB: () => this.cameras.goToNext(-1),
      KeyX: () => this.toggleInput(),
      KeyG: toggle("rig"),
      KeyT: toggle("reproject"),
      KeyH: toggle("panel"),
      KeyP: tools.saveScreenshot,
      KeyC: () => this.paths.toggleRecording(),
      "?": tools.toggleHelp,
      Space: () => transport.toggle(),
      KeyL: () => transport.goLive(),
      ",": () => transport.step(-1),
      ".": () => transport.step(1),
      "[": () => transport.changeSpeed(-1),
      "]": () => transport.changeSpeed(1),
    };
  }

  // Events of the source

  /** Handle the messages of the server, or of the clock of a published performance. */
  listenToLink() {
    const { link } = this;
    listen(this.connection, "status", (status) => this.notices.setConnection(status));
    listen(link, "welcome", (welcome) => this.welcome(welcome));
    listen(link, "rig", (rig) => this.setRig(rig));
    listen(link, "state", (state) => {
      this.notices.setSourceState(state);
      this.wake(!this.drawing || !state.playing);
    });
    listen(link, "completed", (message) => this.assets.addCompleted(message));
    listen(link, "show", (view) => this.show(view));
    listen(link, "link", (query) => this.showLink(query));
    listen(link, "stats", (stats) => (this.statistics.server = stats));
    listen(link, "error", ({ message }) => this.notices.toast(message, "error"));
    listen(link, "picture", (shown) => this.takeFrame(shown));
    listen(link, "undecodable", (text) => this.fallBackToJpeg(text));
  }

  listenToAssets() {
    listen(this.assets, "change", (frame) => this.wake(frame === this.drawn));
    listen(this.assets, "dropped", (frame) => {
      if (this.drawn === frame) this.drawn = null;
      this.stage.scene.drop(frame);
    });
  }

  /** Recreate everything on the GPU after the browser has lost and restored the context. */
  listenToCanvas() {
    this.canvas.addEventListener("webglcontextlost", (/** @type {Event} */ event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.stage.prepare();
      this.original.repeat();
      this.drawn = null;
      this.link.lastRequest = "";
      this.showSources([], undefined);
      this.wake();
    });
  }

  /** Adopt the server's limits, models, error rules and codecs. @param {any} welcome the message */
  welcome(welcome) {
    this.limits = welcome.limits;
    this.controls.setCodecs(welcome.codecs);
    offerModels(this.settings, welcome.model, welcome.models ?? []);
    this.controls.setRules(welcome.error_rules, welcome.error_rule);
    this.settings.set("modelGround", welcome.background ?? "000000", false);
    this.wake();
  }

  /** @param {any} rig the message */
  setRig(rig) {
    this.#forgetOtherCameras(rig.cameras);
    byId("source").textContent = rig.name;
    if (this.source.live) document.title = `${rig.name} · viewmend live`;
    this.motion.setRig(rig);
    this.cameras.setRig(rig);
    this.assets.open(rig);
    this.showSources([], undefined);
    this.wake();
  }

  /** Forget what refers to cameras of an earlier rig. @param {any[]} cameras */
  #forgetOtherCameras(cameras) {
    const names = cameras.map(({ name }) => name);
    const excluded = this.settings.excludedCameras.filter((name) => names.includes(name));
    this.settings.set("without", excluded.join(","));
    const isSameRig = JSON.stringify(cameras) === JSON.stringify(this.motion.rig?.cameras);
    if (!isSameRig) this.snapped = null;
  }

  /**
   * Show the view that the program which runs the server asks for.
   * @param {{pose?: any, time?: number, mode?: string}} view
   */
  show({ pose, time, mode }) {
    const { motion, transport, settings } = this;
    if (pose && motion.rig) {
      const { fov } = motion.goal ?? motion.computeHome();
      const target = pose.R
        ? poseFromCamera(motion.rig, pose, motion.rig.center, fov)
        : { ...motion.computeHome(), ...motion.goal, roll: 0, ...pose };
      motion.moveTo(target);
    }
    if (time !== undefined) transport.pauseAt(time);
    if (mode && this.source.modes.includes(mode)) settings.set("mode", mode, false);
    this.wake();
  }

  /** Show the view of a link, as a page that is opened with it does. @param {URLSearchParams} query */
  showLink(query) {
    const { motion, transport } = this;
    this.settings.readUrl(query);
    const time = parseFrameIndex(query.get("time"));
    if (time < 0) transport.goLive();
    else transport.pauseAt(time);
    motion.moveTo(parsePose(query.get("pose")) ?? motion.computeHome());
    this.wake();
  }

  /** Show a frame that the server has rendered. @param {any} shown */
  takeFrame(shown) {
    const { header } = shown;
    const { renderedModes } = this.settings;
    this.stage.take(shown);
    if (!this.drawing) {
      this.showSources(header.input_views, renderedModes.includes("coverage") ? header.colours : undefined);
    }
    if (!this.drawing) this.transport.showFrame(header.time);
    this.controls.setSize(header);
    const lacksConfidence =
      renderedModes.includes("confidence") && header.full && header.confidence === null;
    this.notices.markArrived(lacksConfidence);
    if (header.full) this.refining.finish();
    this.paint();
    if (this.drawn !== null && this.stage.fading) this.wake(false);
    const latency = this.statistics.addFrame(header, shown.bytes);
    const { frame, look, time, full } = header;
    Object.assign(this.canvas.dataset, { frame, look, time, full });
    const detail = { header, bytes: shown.bytes, latency_ms: latency };
    this.canvas.dispatchEvent(new CustomEvent("framepainted", { detail }));
  }

  /**
   * Switch from video to JPEG after a frame could not be decoded.
   * @param {string} text the decoder's error
   */
  fallBackToJpeg(text) {
    if (this.settings.get("codec") === "jpeg") {
      this.notices.toast(`An image could not be decoded: ${text}`, "error");
      return;
    }
    this.notices.toast("This browser cannot decode the video; using JPEG.", "error");
    this.settings.set("codec", "jpeg", false);
    byId("codec").value = "jpeg";
  }

  // The view

  reset() {
    if (this.motion.rig) this.motion.reset();
    this.wake();
  }

  /** The camera that the view is at or moves to; null if it is at none. */
  get camera() {
    if (!this.source.live || this.motion.goal !== this.snapped?.goal) return null;
    return this.snapped?.camera ?? null;
  }

  /** Leave out or use the camera of the newest pose, which may not have been painted yet. */
  toggleInput() {
    this.cameras.setCurrent(this.camera);
    this.cameras.toggleInput();
  }

  /**
   * Make the surface at a position of the page the target, and come closer.
   * @param {number} x CSS pixels
   * @param {number} y CSS pixels
   */
  focus(x, y) {
    const viewer = this.computeViewer();
    const { goal } = this.motion;
    const { left, top } = viewer.box;
    const positions = this.drawn?.shape?.positions;
    const point = positions ? findSurfacePoint(positions, viewer, x - left, y - top) : null;
    if (!goal || !point) return;
    const minDistance = MIN_DISTANCE_SHARE * this.motion.rig.home.distance;
    const distance = Math.max(DOUBLE_CLICK_ZOOM * goal.distance, minDistance);
    this.motion.moveTo({ ...goal, target: point, distance });
    this.wake();
  }

  /** Move to a camera's position, with its whole image in view. @param {any} camera */
  snap(camera) {
    const { free } = this.computeBoxes();
    const focalX = (free.width / camera.width) * camera.K[0];
    const focalY = (free.height / camera.height) * camera.K[4];
    this.motion.moveToCamera(camera, fovFromFocal(free, Math.min(focalX, focalY)));
    this.snapped = { camera, goal: this.motion.goal };
    this.wake();
  }

  /** The box of the image on the page, and the part of it that no panel covers, in CSS pixels. */
  computeBoxes() {
    const { page, free } = this.layout;
    const [width, height] = this.settings.get("size").split("x").map(Number);
    if (!(width > 0 && height > 0)) return { box: page, free };
    const box = fitBox(free, width / height);
    return { box, free: box };
  }

  /** The newest pose as a camera of the image's box. */
  computeViewer() {
    const { box, free } = this.computeBoxes();
    const { pose, rig } = this.motion;
    if (!pose) {
      return { R: NO_ROTATION, T: [0, 0, 0], lens: lensFromFov(box, free, DEFAULT_FOV), distance: 1, box };
    }
    const lens = lensFromFov(box, free, pose.fov);
    return { ...extrinsicsFromPose(rig, pose), lens, distance: pose.distance, box };
  }

  // Requests

  /** The part of a request that does not depend on the pose. */
  buildViewRequest() {
    const { settings } = this;
    return {
      modes: settings.renderedModes,
      top_k: settings.get("topK"),
      error_rule: settings.get("errorRule") || null,
      adaptive: settings.get("adaptive"),
      background: settings.backgroundColour,
      without: settings.excludedCameras,
      model: settings.comparedModel,
      depth: settings.get("reproject") || settings.get("rig"),
      codec: settings.get("codec"),
    };
  }

  /**
   * Request both eyes of a headset.
   * @param {any[]} eyes
   * @param {number} side of each eye's image, pixels
   */
  requestEyes(eyes, side) {
    const size = { width: side, height: side };
    this.link.requestView({ ...this.buildViewRequest(), eyes, ...size, depth: true, moving: false });
  }

  /** Request the view at the newest pose, unless the page draws it. */
  requestView() {
    if (!this.motion.pose || this.headset.session) return;
    const { moving } = this.motion;
    if (!this.source.live) {
      if (!moving) this.updateUrl();
      return;
    }
    const { drawing } = this;
    const { playing } = this.transport;
    if (moving || playing) this.refining.stop();
    if (drawing && (moving || playing || !this.drawn)) {
      this.link.cancelRequest();
      this.canvas.dataset.full = "false";
      return;
    }
    const { R, T, lens, box } = this.computeViewer();
    const size = this.chooseRequestSize(box);
    const { fx, fy, cx, cy } = resizeLens(lens, size.width, size.height);
    const request = {
      camera: { R, T, fx, fy, cx, cy },
      ...size,
      ...this.buildViewRequest(),
      moving,
      ...(drawing ? { full: true, depth: false } : {}),
    };
    if (this.link.requestView(request)) {
      this.stage.expect(this.link.requestCount, request);
      if (!drawing) this.notices.markRequested();
      if (!moving && !playing) this.refining.begin();
    }
    if (!moving) this.updateUrl();
  }

  /**
   * The image size to request: the chosen one, or as many pixels as the canvas has while the view is at rest.
   * @param {import("./view/lens.js").Box} box
   * @returns {{width: number, height: number}} pixels
   */
  chooseRequestSize(box) {
    const { settings, motion, transport } = this;
    const [width, height] = settings.get("size").split("x").map(Number);
    const atRest = (this.drawing || settings.get("sharp")) && !motion.moving && !transport.playing;
    const side = atRest ? computeSharpSide(box, Math.min(2, window.devicePixelRatio)) : settings.get("side");
    return width > 0 ? { width, height } : chooseSize(box, side, this.limits);
  }

  /** Write the shown view to the URL. */
  updateUrl() {
    const { motion, settings, transport } = this;
    const mode = settings.get("mode");
    const split = mode === "split";
    this.urlState.update({
      pose: motion.atHome || !motion.goal ? null : formatPose(motion.goal),
      time: transport.stillFrame < 0 ? null : String(transport.stillFrame),
      mode: mode === "completed" ? null : mode,
      without: settings.get("without") || null,
      left: split ? settings.get("left") : null,
      right: split ? settings.get("right") : null,
    });
  }

  // Drawing

  /** Whether the page itself draws the moving views; without a server also while files fail. */
  get drawing() {
    const { settings, assets, source } = this;
    return (
      settings.renderedModes.every((mode) => DRAWN_MODES.includes(mode)) &&
      (assets.usable || !source.live) &&
      settings.get("render") === "page" &&
      !this.headset.session &&
      !this.onAir.wanted &&
      this.motion.pose !== null
    );
  }

  /** Whether the view moves or plays. */
  get isActive() {
    return this.motion.moving || (this.transport.playing && this.transport.shown >= 0);
  }

  /** Canvas pixels per CSS pixel; a slow device lowers them while the view moves or plays. */
  get pixelRatio() {
    const full = Math.min(2, window.devicePixelRatio);
    return this.isActive && this.settings.get("adaptive") ? full * this.resolution.factor : full;
  }

  /** Choose the frame to draw, and request the next ones. @param {number} now ms */
  chooseFrame(now) {
    const { transport, motion, assets } = this;
    assets.exclude(this.settings.get("without"));
    assets.modes = this.settings.renderedModes;
    transport.drawing = this.drawing;
    const fps = motion.rig?.fps ?? 0;
    const time = transport.drawing ? transport.timeAt(now, fps) : -1;
    if (time < 0 || !motion.pose) {
      this.drawn = null;
      return;
    }

    // request the assets of this frame and of the next ones
    const eye = eyeFromPose(motion.rig, motion.pose);
    const { range, playing } = transport;
    const framesPerMs = (fps * transport.state.speed) / 1000;
    const live = transport.state.kind === "live";
    assets.request(time, eye, range, { playing, framesPerMs, live });
    if (assets.waitsForFrames) {
      this.link.setBuffering(playing && assets.updateBuffering(time, eye, range), time);
    }

    // draw the newest frame whose assets have arrived, or keep the last one
    const maxDelay = playing && !assets.waitsForFrames ? Math.ceil(2 * fps) : 0;
    const last = this.isStillDrawable(eye) ? this.drawn : null;
    const chosen = assets.choose(time, eye, range, maxDelay) ?? last;
    if (!chosen) return;
    this.drawn = chosen;
    assets.shown = chosen;
    this.showDrawnSources(chosen, eye);
    transport.showFrame(chosen.time);
    this.notices.markArrived(false);
    this.canvas.dataset.drawn = String(chosen.time);
    this.canvas.dispatchEvent(new CustomEvent("framedrawn"));
  }

  /** Whether the assets of the frame drawn last are still there. @param {number[]} eye */
  isStillDrawable(eye) {
    const { drawn, assets } = this;
    return drawn && assets.frames.get(drawn.time) === drawn && assets.isDrawable(drawn, eye);
  }

  /**
   * Mark the cameras that colour a frame that the page draws, or those of the server's image on top of it.
   * @param {import("./link/assets.js").Frame} frame
   * @param {number[]} eye
   */
  showDrawnSources(frame, eye) {
    const { cameras } = /** @type {import("./link/assets.js").Shape} */ (frame.shape).header;
    const used = this.assets.findNeededCameras(frame, eye).map((number) => cameras[number]);
    const names = used.filter(({ completed }) => !completed).map(({ name }) => name);
    const { lastImage, header } = this.stage;
    this.showSources(lastImage.opacity > 0 && header ? header.input_views : names, undefined);
  }

  /**
   * Mark the cameras that colour the view.
   * @param {string[]} names
   * @param {number[][] | undefined} colours of the mode "coverage"
   */
  showSources(names, colours) {
    if (!this.motion.rig) return;
    if (!this.cameras.markUsed(names, colours) && this.stage.lines?.count) return;
    this.stage.lines?.set(buildRigLines(this.motion.rig, names, colours));
  }

  /**
   * @param {number} divider its position as a share of the viewport's width
   * @returns {import("./draw/stage.js").DrawOptions}
   */
  buildDrawOptions(divider) {
    const { settings } = this;
    const split = settings.get("mode") === "split";
    const parts = split
      ? [
          { mode: parseMode(settings.get("left")), until: divider },
          { mode: parseMode(settings.get("right")), until: 1 },
        ]
      : [{ mode: settings.get("mode"), until: 1 }];
    return {
      parts,
      reproject: settings.get("reproject"),
      rig: settings.get("rig") ? this.motion.rig : null,
      frame: this.drawing ? this.drawn : null,
    };
  }

  paint() {
    const { settings, stage } = this;
    const viewer = this.computeViewer();
    const { box } = viewer;

    // fit the canvas to the page
    const { width, height } = this.layout.page;
    const ratio = this.pixelRatio;
    this.paintedRatio = ratio;
    const canvasWidth = Math.round(width * ratio);
    const canvasHeight = Math.round(height * ratio);
    if (this.canvas.width !== canvasWidth) this.canvas.width = canvasWidth;
    if (this.canvas.height !== canvasHeight) this.canvas.height = canvasHeight;

    // draw the view on both sides of the divider
    const dividerX = placeDivider(settings, settings.get("size") ? box : this.layout.free);
    const divider = Math.min(1, Math.max(0, (dividerX - box.left) / box.width));
    const bottom = height - box.top - box.height;
    const viewport = [box.left, bottom, box.width, box.height].map((value) => Math.round(value * ratio));
    stage.clear(settings.backgroundColour);
    stage.draw(viewer, viewport, this.buildDrawOptions(divider));

    // update what is shown around it
    nameSides(settings, (mode) => stage.resolveMode(viewer, mode));
    this.cameras.placeLabels(settings.get("rig"), viewer, box);
    this.updateComparison();
    this.statistics.addRepaint(this.drawing && this.drawn ? stage.scene.cost : null);
    this.controls.setFov(this.motion.pose?.fov ?? DEFAULT_FOV);
  }

  /** Show the image of the camera that the view is at, and the view's score if that camera is left out. */
  updateComparison() {
    const { settings, transport, motion, camera } = this;
    const time = transport.shown;
    this.cameras.setCurrent(camera);

    // the original image
    const split = settings.shownModes.includes("original");
    const leftOut = camera && settings.excludedCameras.includes(camera.name);
    const originals = settings.get("originals");
    const besideView = (originals && !split) || leftOut;
    this.original.show(originals || split || leftOut ? camera : null, time, besideView);

    // the score of the view, of each model
    const scored = leftOut && !transport.playing && !motion.moving && time >= 0;
    const models = [null, ...(settings.comparedModel ? [settings.comparedModel] : [])];
    this.original.scores.show(scored ? { camera, time, without: settings.get("without"), models } : null);
    showScale(settings, this.stage.header);
  }

  // Repaints

  /**
   * Refresh at the display's next repaint, and go on while something moves.
   * @param {boolean} [changed] false to paint only if another frame is available
   */
  wake(changed = true) {
    this.stale ||= changed;
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.refresh(now));
  }

  /** @param {number} now ms */
  refresh(now) {
    this.scheduled = false;
    if (!this.repaints.due(now)) {
      this.wake(false);
      return;
    }
    const elapsed = Math.min(100, Math.max(1, now - this.refreshedAt));
    this.refreshedAt = now;

    // move the view
    const held = this.keys.step(elapsed);
    const busy = this.paths.step(now);
    const stepped = this.motion.step(elapsed);

    // choose and request frames
    const last = this.drawn;
    this.chooseFrame(now);
    const fading = this.drawn !== null && this.stage.fading;
    const changes = held || busy || stepped || this.motion.moving || fading;
    this.resolution.update(elapsed, stepped || busy);
    this.requestView();

    // paint if anything has changed
    const sharpens = this.pixelRatio !== this.paintedRatio;
    if (this.stale || changes || sharpens || this.drawn !== last) {
      this.stale = false;
      this.paint();
    }
    // frames of a live source are announced, those of a recording are not
    const plays = this.drawing && this.transport.playing && this.transport.state?.kind !== "live";
    if (changes || plays || this.link.requestPending) this.wake(false);
  }

  async start() {
    await this.source.start();
    if (this.source.live && (await isHeadsetSupported())) byId("tool-headset").hidden = false;
    this.wake();
  }
}

/**
 * Call a function with the detail of each event.
 * @param {EventTarget} target
 * @param {string} name of the event
 * @param {(detail: any) => void} react
 */
function listen(target, name, react) {
  target.addEventListener(name, (event) => react(/** @type {CustomEvent} */ (event).detail));
}

/** Open the page, or show on its cover why this browser cannot. @param {() => Source} createSource */
export function openPage(createSource) {
  try {
    void new Page(createSource()).start();
  } catch (error) {
    byId("cover").dataset.kind = "error";
    byId("cover-title").textContent = "This browser is not supported";
    byId("cover-text").textContent = /** @type {Error} */ (error).message;
  }
}
