// The cameras of the rig: a list to choose from, labels over the image, and marks of those that colour the
// view.

import { project } from "../draw/projection.js";
import { byId, element } from "./dom.js";
import { isCameraOnly } from "../settings.js";

/** Ids of the elements that have a button for each camera. */
const LISTS = ["cameras", "labels"];
/** A visual hull needs at least this many cameras. */
const MIN_INPUTS = 2;

/** @param {number[]} colour RGB */
const formatColour = (colour) => `rgb(${colour.map(Math.round).join(" ")})`;

export class CameraList {
  /**
   * @param {import("../settings.js").Settings} settings
   * @param {(camera: any) => void} snap moves to a camera
   */
  constructor(settings, snap) {
    this.settings = settings;
    this.snap = snap;
    /** The camera that the view is at. @type {any} */
    this.current = null;
    byId("input").addEventListener("change", () => this.toggleInput());
    byId("inputs-all").addEventListener("click", () => settings.set("without", ""));
    /** @type {any[]} */
    this.cameras = [];
    /** The index of the camera chosen last. */
    this.lastIndex = -1;
    /** The marked cameras and their colours, as JSON. */
    this.marked = "";
    /**
     * The modes before a camera was left out; null if they are still shown.
     * @type {{mode: string, left: string, right: string} | null}
     */
    this.modesBefore = null;
    settings.watch(["without"], () => this.#showInputs());
  }

  /** @param {any} rig */
  setRig(rig) {
    const listNames = (/** @type {any[]} */ cameras) => JSON.stringify(cameras.map(({ name }) => name));
    const isListed = listNames(rig.cameras) === listNames(this.cameras);
    this.cameras = rig.cameras;
    if (!isListed) this.#buildButtons();
    this.#showInputs();
    this.markUsed([], undefined);
  }

  /** Build the lists of buttons, which takes the focus from them. */
  #buildButtons() {
    const buildButton = (/** @type {any} */ camera, /** @type {number} */ index) => {
      const title = `Go to ${camera.name}`;
      const button = element("button", { type: "button", textContent: camera.name, title });
      button.addEventListener("click", () => this.goTo(index));
      return button;
    };
    for (const list of LISTS) {
      byId(list).replaceChildren(...this.cameras.map(buildButton));
    }
    for (const label of byId("labels").children) label.tabIndex = -1;
  }

  /** Leave out the camera that the view is at, or use it again. */
  toggleInput() {
    if (!this.current || byId("input").disabled) return;
    const { settings } = this;
    const { name } = this.current;
    const excluded = settings.excludedCameras;
    const leavesOut = !excluded.includes(name);
    const others = excluded.filter((/** @type {string} */ other) => other !== name);
    settings.set("without", (leavesOut ? [...excluded, name] : others).join(","));
    if (!leavesOut) this.#endComparison();
    else if (!settings.shownModes.some(isCameraOnly)) this.#beginComparison();
  }

  /** Compare the view with the camera's image. */
  #beginComparison() {
    const { settings } = this;
    this.modesBefore = {
      mode: settings.get("mode"),
      left: settings.get("left"),
      right: settings.get("right"),
    };
    settings.set("left", "completed");
    settings.set("right", "original");
    settings.set("mode", "split");
  }

  /** Return to the modes before the comparison, unless others were chosen since. */
  #endComparison() {
    const { settings, modesBefore } = this;
    this.modesBefore = null;
    if (!modesBefore || settings.get("mode") !== "split" || settings.get("right") !== "original") return;
    settings.set("mode", modesBefore.mode);
    settings.set("left", modesBefore.left);
    settings.set("right", modesBefore.right);
  }

  /** @param {any} camera the one that the view is at; null for none */
  setCurrent(camera) {
    if (camera === this.current) return;
    this.current = camera;
    this.#showInputs();
  }

  /** Show which cameras are inputs. */
  #showInputs() {
    const excluded = this.settings.excludedCameras;
    for (const list of LISTS) {
      this.cameras.forEach(({ name }, index) => {
        byId(list).children[index]?.toggleAttribute("data-off", excluded.includes(name));
      });
    }
    const { current } = this;
    const off = current && excluded.includes(current.name);
    byId("input-row").hidden = !current;
    byId("input-name").textContent = current ? `Use ${current.name} as an input` : "";
    byId("input").checked = !off;
    byId("input").disabled = !off && this.cameras.length - excluded.length <= MIN_INPUTS;
    byId("inputs-all").hidden = !excluded.length;
    this.marked = "";
  }

  /** @param {number} index */
  goTo(index) {
    this.lastIndex = index;
    this.snap(this.cameras[index]);
  }

  /** @param {number} steps along the list */
  goToNext(steps) {
    const count = this.cameras.length;
    if (!count) return;
    const from = Math.max(this.lastIndex, steps < 0 ? 0 : -1);
    this.goTo((from + steps + count) % count);
  }

  /**
   * Mark the cameras that colour the view.
   * @param {string[]} names
   * @param {number[][] | undefined} colours of the mode "coverage"
   * @returns {boolean} whether they have changed
   */
  markUsed(names, colours) {
    const marked = JSON.stringify([names, colours]);
    if (marked === this.marked) return false;
    this.marked = marked;
    this.cameras.forEach((camera, index) => {
      const rank = names.indexOf(camera.name);
      const used = rank >= 0;
      for (const list of LISTS) {
        const button = byId(list).children[index];
        button.toggleAttribute("data-used", used);
        if (used && colours?.[rank]) button.style.setProperty("--colour", formatColour(colours[rank]));
        else button.style.removeProperty("--colour");
      }
    });
    const excluded = this.settings.excludedCameras.length;
    const suffix = excluded ? `, ${excluded} left out` : "";
    const count = `${names.length} of ${this.cameras.length}`;
    byId("camera-count").textContent = `${count} used for this view${suffix}`;
    return true;
  }

  /**
   * Place the labels over the image.
   * @param {boolean} shown
   * @param {any} viewer in CSS pixels
   * @param {{left: number, top: number}} box of the image
   */
  placeLabels(shown, viewer, box) {
    const labels = byId("labels");
    labels.hidden = !shown;
    if (!shown) return;
    this.cameras.forEach((camera, index) => {
      const pixel = project(viewer, camera.center);
      const label = labels.children[index];
      label.hidden = !pixel;
      if (!pixel) return;
      const position = `${pixel[0] + box.left}px, ${pixel[1] + box.top}px`;
      label.style.transform = `translate(${position}) translate(-50%, 9px)`;
    });
  }
}
