// The page: puts the parts together and repaints when something changed. Its frames come from a server or from files.

import { DRAWN_MODES } from "./draw/scene.js";
import { Stage } from "./draw/stage.js";
import { surfaceAt } from "./draw/projection.js";
import { rigLines } from "./draw/rig.js";
import { Headset, headsetThere } from "./headset.js";
import { sourcesOf } from "./link/assets.js";
import { Settings, modeOf } from "./settings.js";
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
import { buildTools, screenshot } from "./ui/tools.js";
import { Transport } from "./ui/transport.js";
import { listenToGestures } from "./view/gestures.js";
import { Keys } from "./view/keys.js";
import { contained, fovOf, lensOf, resize, sharpSide, sizeFor } from "./view/lens.js";
import { Motion } from "./view/motion.js";
import { poseOf, poseText, timeOf } from "./view/url_state.js";
import { extrinsicsOf, eyeOf, poseOfCamera } from "./view/pose.js";
import { RepaintLimiter, Resolution } from "./draw/resolution.js";

/** How much closer a double-click comes. */
const CLOSER = 0.7;
const LIMITS = { max_side_px: 2048, max_pixels: 2 ** 21 };

/**
 * @typedef {object} Source where the frames come from
 * @property {boolean} live whether a server renders views, too
 * @property {string[]} modes what can be shown, in the order of the strip
 * @property {URLSearchParams} query the view that the address asks for
 * @property {string | null} token
 * @property {any} connection its events "status" say whether the frames can be had; `open()` tries again
 * @property {any} link dispatches "rig" and "state", and takes the clock's changes; see link/viewer.js
 * @property {import("./link/assets.js").Assets} assets
 * @property {import("./view/url_state.js").UrlState} urlState writes the view to the address
 * @property {import("./ui/paths.js").Films} films
 * @property {() => Promise<void>} start
 */

export class Page {
  /** @param {Source} source */
  constructor(source) {
    const { query, token } = source;
    this.source = source;
    this.canvas = byId("picture");
    this.settings = new Settings(query, source.modes, source.live);
    this.stage = new Stage(this.canvas);
    this.motion = new Motion(window.matchMedia("(prefers-reduced-motion: reduce)").matches);
    this.resolution = new Resolution();
    this.repaints = new RepaintLimiter(this.stage.software);
    this.limits = LIMITS;
    this.painted = 0;
    this.scheduled = false;
    /** Whether the next refresh has to paint, though it shows no other frame or pose. */
    this.stale = true;
    this.connection = source.connection;
    this.link = source.link;
    this.assets = source.assets;
    this.assets.fillers = this.stage.scene.fillers;
    /** The frame that the page draws; null if the server draws. @type {import("./link/assets.js").Frame | null} */
    this.drawn = null;
    this.notices = new Notices(() => this.connection.open());
    this.onAir = new OnAir(this.link, this.notices, token);
    this.refining = new Refining();
    this.statistics = new Statistics(() => this.motion.moving || (this.transport.playing && this.transport.shown >= 0));
    this.transport = new Transport(this.link, timeOf(query.get("time")));
    this.urlState = source.urlState;
    this.motion.first = poseOf(query.get("pose"));
    this.layout = new Layout(this.settings, () => this.wake());
    this.cameras = new CameraList(this.settings, (camera) => this.snap(camera));
    this.original = new Original(token, (mode, camera, image) => {
      this.stage.photo(mode, camera, image);
      this.wake();
    });
    /** The camera that the view was put to, and the pose that it got there. @type {any} */
    this.snapped = null;
    this.headset = new Headset(this.stage, {
      look: (eyes, side) => this.link.look({ ...this.wanted(), eyes, width: side, height: side, depth: true, moving: false }),
      drawOptions: () => this.drawOptions(0.5),
      ended: () => this.wake(),
    });
    const { motion, transport, notices, settings } = this;
    this.paths = new PathPanel({ motion, transport, notices, settings, films: source.films, wake: () => this.wake() });
    buildModes(settings, source.modes);
    this.controls = buildControls(settings, motion, () => this.wake());
    this.tools = buildTools({
      settings,
      notices,
      reset: () => this.reset(),
      shot: () => screenshot(this.canvas, () => this.paint(), `viewmend-${String(transport.shown).padStart(4, "0")}.png`, notices),
      link: () => {
        this.updateAddress();
        return this.urlState.link();
      },
      headset: () => this.headset.enter(motion.rig, motion.pose),
    });
    this.keys = new Keys(motion, this.actions(), () => this.wake());
    listenToGestures(this.canvas, motion, () => this.viewer().lens.fx, () => this.wake(), (x, y) => this.focus(x, y));
    settings.addEventListener("change", () => this.wake());
    this.listen();
  }

  /** What keys and tools do. @returns {Record<string, () => void>} */
  actions() {
    const { settings, transport, tools } = this;
    const flip = (/** @type {"rig" | "reproject" | "panel"} */ name) => () => settings.set(name, !settings.get(name));
    const modes = this.source.modes.map((mode, index) => [`Digit${index + 1}`, () => settings.set("mode", mode)]);
    return {
      ...Object.fromEntries(modes),
      KeyR: () => this.reset(), Home: () => this.reset(),
      KeyF: () => this.controls.movement(this.motion.mode === "fly" ? "orbit" : "fly"),
      KeyN: () => this.cameras.next(1), KeyB: () => this.cameras.next(-1),
      KeyX: () => this.toggleInput(),
      KeyG: flip("rig"), KeyT: flip("reproject"), KeyH: flip("panel"),
      KeyP: tools.shot, KeyC: () => this.paths.toggleRecording(), "?": tools.help,
      Space: () => transport.toggle(), KeyL: () => transport.live(),
      Comma: () => transport.step(-1), Period: () => transport.step(1),
      BracketLeft: () => transport.faster(-1), BracketRight: () => transport.faster(1),
    };
  }

  reset() {
    if (this.motion.rig) this.motion.reset();
    this.wake();
  }

  /** The camera that the view is at or moves to; null if it is at none. */
  get camera() {
    return this.source.live && this.motion.goal === this.snapped?.goal ? this.snapped?.camera ?? null : null;
  }

  /** Leave out or use the camera of the newest pose, which may not have been painted yet. */
  toggleInput() {
    this.cameras.at(this.camera);
    this.cameras.toggleInput();
  }

  /** What the server's program wants to be seen. @param {{pose?: any, time?: number, mode?: string}} view */
  show({ pose, time, mode }) {
    const { motion, transport, settings } = this;
    if (pose && motion.rig) {
      const { fov } = motion.goal ?? motion.home();
      motion.jump(pose.R ? poseOfCamera(motion.rig, pose, motion.rig.center, fov) : { ...motion.home(), ...motion.goal, roll: 0, ...pose });
    }
    if (time !== undefined) transport.pauseAt(time);
    if (mode) settings.set("mode", mode, false);
    this.wake();
  }

  /** Turn about the surface that is seen there. @param {number} x CSS pixels @param {number} y */
  focus(x, y) {
    const [viewer, { goal }] = [this.viewer(), this.motion];
    const point = this.drawn?.shape ? surfaceAt(this.drawn.shape.positions, viewer, x - viewer.box.left, y - viewer.box.top) : null;
    if (!goal || !point) return;
    this.motion.jump({ ...goal, target: point, distance: Math.max(CLOSER * goal.distance, 0.1 * this.motion.rig.home.distance) });
    this.wake();
  }

  /** To a camera's place, so that its whole picture is in view. @param {any} camera */
  snap(camera) {
    const { free } = this.frame();
    const f = Math.min((free.width / camera.width) * camera.K[0], (free.height / camera.height) * camera.K[4]);
    this.motion.snap(camera, fovOf(free, f));
    this.snapped = { camera, goal: this.motion.goal };
    this.wake();
  }

  listen() {
    const on = (/** @type {EventTarget} */ from, /** @type {string} */ name, /** @type {(detail: any) => void} */ react) =>
      from.addEventListener(name, (event) => react(/** @type {CustomEvent} */ (event).detail));
    on(this.connection, "status", (status) => this.notices.connect(status));
    on(this.link, "welcome", (welcome) => {
      this.limits = welcome.limits;
      this.controls.codecs(welcome.codecs);
      offerModels(this.settings, welcome.model, welcome.models ?? []);
      this.controls.rules(welcome.error_rules, welcome.error_rule);
      this.settings.set("modelGround", welcome.background ?? "000000", false);
      this.wake();
    });
    on(this.link, "rig", (rig) => {
      byId("source").textContent = rig.name;
      if (this.source.live) document.title = `${rig.name} · viewmend live`;
      this.motion.place(rig);
      this.cameras.set(rig);
      this.assets.open(rig);
      this.showSources([], undefined);
      this.wake();
    });
    on(this.link, "state", (state) => {
      this.notices.source(state);
      this.wake(!this.drawing || !state.playing);
    });
    on(this.link, "completed", (message) => this.assets.offer(message));
    on(this.link, "show", (view) => this.show(view));
    on(this.assets, "change", (frame) => this.wake(frame === this.drawn));
    on(this.assets, "dropped", (frame) => {
      if (this.drawn === frame) this.drawn = null;
      this.stage.scene.drop(frame);
    });
    on(this.link, "stats", (stats) => (this.statistics.server = stats));
    on(this.link, "error", ({ message }) => this.notices.toast(message, "error"));
    on(this.link, "picture", (shown) => this.take(shown));
    on(this.link, "trouble", (text) => this.trouble(text));
    this.canvas.addEventListener("webglcontextlost", (/** @type {Event} */ event) => event.preventDefault());
    this.canvas.addEventListener("webglcontextrestored", () => {
      this.stage.prepare();
      this.drawn = null;
      this.link.lastLook = "";
      this.showSources([], undefined);
      this.wake();
    });
  }

  /** A picture that cannot be decoded: video falls back to JPEG. @param {string} text */
  trouble(text) {
    if (this.settings.get("codec") === "jpeg") {
      this.notices.toast(`An image could not be decoded: ${text}`, "error");
      return;
    }
    this.notices.toast("This browser cannot decode the video; using JPEG.", "error");
    this.settings.set("codec", "jpeg", false);
    byId("codec").value = "jpeg";
  }

  /** @param {any} shown */
  take(shown) {
    const { header } = shown;
    this.stage.take(shown);
    if (!this.drawing) this.showSources(header.input_views, this.settings.modes.includes("coverage") ? header.colours : undefined);
    if (!this.drawing) this.transport.picture(header.time);
    this.controls.size(header);
    this.notices.arrived(this.settings.modes.includes("confidence") && header.full && header.confidence === null);
    if (header.full) this.refining.finish();
    this.paint();
    if (this.drawn !== null && this.stage.fading) this.wake(false);
    const latency = this.statistics.picture(header, shown.bytes);
    Object.assign(this.canvas.dataset, { frame: header.frame, look: header.look, time: header.time, full: header.full });
    this.canvas.dispatchEvent(new CustomEvent("framepainted", { detail: { header, bytes: shown.bytes, latency_ms: latency } }));
  }

  /** @param {string[]} names @param {number[][] | undefined} colours */
  showSources(names, colours) {
    if (!this.motion.rig || (!this.cameras.use(names, colours) && this.stage.lines?.count)) return;
    this.stage.lines?.set(rigLines(this.motion.rig, names, colours));
  }

  /** Where the picture is on the page, and the part of it that nothing covers. */
  frame() {
    const { page, free } = this.layout;
    const [width, height] = this.settings.get("size").split("x").map(Number);
    if (!(width > 0 && height > 0)) return { box: page, free };
    const box = contained(free, width / height);
    return { box, free: box };
  }

  /** The newest pose as a camera of the picture's box. */
  viewer() {
    const { box, free } = this.frame();
    const { pose, rig } = this.motion;
    if (!pose) return { R: [1, 0, 0, 0, 1, 0, 0, 0, 1], T: [0, 0, 0], lens: lensOf(box, free, 50), distance: 1, box };
    return { ...extrinsicsOf(rig, pose), lens: lensOf(box, free, pose.fov), distance: pose.distance, box };
  }

  /** The part of a look that does not depend on the pose. */
  wanted() {
    const { settings } = this;
    return {
      modes: settings.modes,
      top_k: settings.get("topK"),
      error_rule: settings.get("errorRule") || null,
      adaptive: settings.get("adaptive"),
      background: settings.ground,
      without: settings.without,
      model: settings.model,
      depth: settings.get("reproject") || settings.get("rig"),
      codec: settings.get("codec"),
    };
  }

  /** Whether the page draws moving views by itself. */
  get drawing() {
    const drawn = this.settings.modes.every((mode) => DRAWN_MODES.includes(mode));
    return drawn && this.assets.usable && this.settings.get("render") === "page" && !this.headset.session && !this.onAir.wanted && this.motion.pose !== null;
  }

  /** Choose the frame to draw, and ask for the next ones. @param {number} now ms */
  choose(now) {
    const { transport, motion, assets } = this;
    assets.leaveOut(this.settings.get("without"));
    assets.modes = this.settings.modes;
    transport.drawing = this.drawing;
    const fps = motion.rig?.fps ?? 0;
    const time = transport.drawing ? transport.timeAt(now, fps) : -1;
    if (time < 0 || !motion.pose) {
      this.drawn = null;
      return;
    }
    const [eye, { range, playing }] = [eyeOf(motion.rig, motion.pose), transport];
    const [framesPerMs, live] = [(fps * transport.state.speed) / 1000, transport.state.kind === "live"];
    assets.want(time, eye, range, { playing, framesPerMs, live });
    if (playing && assets.patient && assets.buffers(time, eye, range)) this.link.hold(time);
    const late = playing && !assets.patient ? Math.ceil(2 * fps) : 0;
    const kept = this.drawn && assets.frames.get(this.drawn.time) === this.drawn && assets.drawable(this.drawn, eye) ? this.drawn : null;
    const chosen = assets.choose(time, eye, range, late) ?? kept;
    if (!chosen) return;
    this.drawn = assets.shown = chosen;
    const { cameras } = /** @type {import("./link/assets.js").Shape} */ (chosen.shape).header;
    const used = assets.needed(chosen, eye).map((n) => cameras[n]);
    const names = used.filter(({ completed }) => !completed).map(({ name }) => name);
    const completes = this.stage.taken.shown > 0 && this.stage.header; // the server's picture covers the drawn one
    this.showSources(completes ? this.stage.header.input_views : names, undefined);
    transport.picture(chosen.time);
    this.notices.arrived(false);
    this.canvas.dataset.drawn = String(chosen.time);
    this.canvas.dispatchEvent(new CustomEvent("framedrawn"));
  }

  /** Ask for the view at the newest pose. */
  ask() {
    if (!this.motion.pose || this.headset.session) return;
    if (!this.source.live) {
      if (!this.motion.moving) this.updateAddress();
      return;
    }
    const { drawing } = this;
    if (this.motion.moving || this.transport.playing) this.refining.stop();
    if (drawing && (this.motion.moving || this.transport.playing || !this.drawn)) {
      this.link.rest();
      this.canvas.dataset.full = "false";
      return;
    }
    const { R, T, lens, box } = this.viewer();
    const [fixedWidth, fixedHeight] = this.settings.get("size").split("x").map(Number);
    const { moving } = this.motion;
    const atRest = (drawing || this.settings.get("sharp")) && !moving && !this.transport.playing;
    const side = atRest ? sharpSide(box, Math.min(2, window.devicePixelRatio)) : this.settings.get("side");
    const size = fixedWidth > 0 ? { width: fixedWidth, height: fixedHeight } : sizeFor(box, side, this.limits);
    const { fx, fy, cx, cy } = resize(lens, size.width, size.height);
    const look = { camera: { R, T, fx, fy, cx, cy }, ...size, ...this.wanted(), moving, ...(drawing ? { full: true, depth: false } : {}) };
    if (this.link.look(look)) {
      if (!drawing) this.notices.asked();
      if (!moving && !this.transport.playing) this.refining.begin();
    }
    if (!moving) this.updateAddress();
  }

  /** Write what is shown to the address. */
  updateAddress() {
    const { motion, settings, transport } = this;
    const split = settings.get("mode") === "split";
    this.urlState.update({
      pose: motion.atHome || !motion.goal ? null : poseText(motion.goal),
      time: transport.still < 0 ? null : String(transport.still),
      mode: settings.get("mode") === "completed" ? null : settings.get("mode"),
      without: settings.get("without") || null,
      left: split ? settings.get("left") : null,
      right: split ? settings.get("right") : null,
    });
  }

  /** @param {number} divider its place as a share of the viewport's width @returns {import("./draw/stage.js").DrawOptions} */
  drawOptions(divider) {
    const { settings } = this;
    const split = settings.get("mode") === "split";
    const parts = split
      ? [{ mode: modeOf(settings.get("left")), until: divider }, { mode: modeOf(settings.get("right")), until: 1 }]
      : [{ mode: settings.get("mode"), until: 1 }];
    return { parts, reproject: settings.get("reproject"), rig: settings.get("rig") ? this.motion.rig : null, frame: this.drawing ? this.drawn : null };
  }

  paint() {
    const viewer = this.viewer();
    const { box } = viewer;
    const { width, height } = this.layout.page;
    const ratio = this.resolution.ratio;
    const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (this.canvas.width !== w) this.canvas.width = w;
    if (this.canvas.height !== h) this.canvas.height = h;
    const x = placeDivider(this.settings, this.settings.get("size") ? box : this.layout.free);
    const divider = Math.min(1, Math.max(0, (x - box.left) / box.width));
    const viewport = [box.left, height - box.top - box.height, box.width, box.height].map((value) => Math.round(value * ratio));
    this.stage.clear(this.settings.ground);
    this.stage.draw(viewer, viewport, this.drawOptions(divider));
    nameSides(this.settings, (mode) => this.stage.shownMode(viewer, mode));
    this.cameras.place(this.settings.get("rig"), viewer, box);
    this.compare();
    this.statistics.painted(this.drawing && this.drawn ? this.stage.scene.cost : null);
    this.controls.fov(this.motion.pose?.fov ?? 50);
  }

  /** The image of the camera that the view is at, and the view's score if that camera is left out. */
  compare() {
    const { settings, transport, motion, camera } = this;
    this.cameras.at(camera);
    const split = settings.shown.includes("original");
    const leftOut = camera && settings.without.includes(camera.name);
    this.original.show(settings.get("originals") || split || leftOut ? camera : null, transport.shown, settings.get("originals") && !split || leftOut);
    const scored = leftOut && !transport.playing && !motion.moving && transport.shown >= 0;
    const models = [null, ...(settings.model ? [settings.model] : [])];
    this.original.scores.show(scored ? { camera, time: transport.shown, without: settings.get("without"), models } : null);
    showScale(settings, this.stage.header);
  }

  /** Repaint at the display's next refresh, and on while something moves. @param {boolean} [changed] false: only if another frame is there */
  wake(changed = true) {
    this.stale ||= changed;
    if (this.scheduled) return;
    this.scheduled = true;
    requestAnimationFrame((now) => this.refresh(now));
  }

  /** @param {number} now */
  refresh(now) {
    this.scheduled = false;
    if (!this.repaints.due(now)) {
      this.wake(false);
      return;
    }
    const elapsed = Math.min(100, Math.max(1, now - this.painted));
    this.painted = now;
    const held = this.keys.step(elapsed);
    const busy = this.paths.step(now);
    const stepped = this.motion.step(elapsed);
    const last = this.drawn;
    this.choose(now);
    const changes = held || busy || stepped || this.motion.moving || (this.drawn !== null && this.stage.fading);
    this.resolution.refreshed(elapsed, stepped || busy);
    this.ask();
    if (this.stale || changes || this.drawn !== last) {
      this.stale = false;
      this.paint();
    }
    const plays = this.drawing && this.transport.playing && this.transport.state?.kind !== "live"; // whose frames are announced
    if (changes || plays || this.link.late) this.wake(false);
  }

  async start() {
    await this.source.start();
    if (this.source.live && (await headsetThere())) byId("tool-headset").hidden = false;
    this.wake();
  }
}

/** Open the page; says on its cover if the browser cannot. @param {() => Source} source */
export function openPage(source) {
  try {
    void new Page(source()).start();
  } catch (error) {
    byId("cover").dataset.kind = "error";
    byId("cover-title").textContent = "This browser is not supported";
    byId("cover-text").textContent = /** @type {Error} */ (error).message;
  }
}
