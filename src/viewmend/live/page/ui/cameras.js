// The rig's cameras: a list to snap to, labels over the picture, and which of them colour it.

import { project } from "../draw/projection.js";
import { byId, element } from "./dom.js";
import { AT_CAMERA } from "../settings.js";

/** @param {number[]} colour */
const css = (colour) => `rgb(${colour.map(Math.round).join(" ")})`;

export class CameraList {
  /** @param {import("../settings.js").Settings} settings @param {(camera: any) => void} snap */
  constructor(settings, snap) {
    this.settings = settings;
    this.snap = snap;
    /** The camera that the view is at. @type {any} */
    this.here = null;
    byId("input").addEventListener("change", () => this.toggleInput());
    byId("inputs-all").addEventListener("click", () => settings.set("without", ""));
    /** @type {any[]} */
    this.cameras = [];
    this.last = -1;
    this.used = "";
    /** What was shown before a camera was left out; null if nothing else was. @type {{mode: string, left: string, right: string} | null} */
    this.before = null;
    settings.watch(["without"], () => this.#inputs());
  }

  /** @param {any} rig */
  set(rig) {
    this.cameras = rig.cameras;
    this.used = "";
    const make = (/** @type {any} */ camera, /** @type {number} */ index) => {
      const button = element("button", { type: "button", textContent: camera.name, title: `Go to ${camera.name}` });
      button.addEventListener("click", () => this.to(index));
      return button;
    };
    byId("cameras").replaceChildren(...this.cameras.map(make));
    byId("labels").replaceChildren(...this.cameras.map(make));
    for (const label of byId("labels").children) label.tabIndex = -1;
    this.#inputs();
    this.use([], undefined);
  }

  /** Leave the camera that the view is at out, or use it again. */
  toggleInput() {
    if (!this.here || byId("input").disabled) return;
    const { settings, here: { name } } = this;
    const without = settings.without;
    const leavesOut = !without.includes(name);
    const others = without.filter((/** @type {string} */ other) => other !== name);
    settings.set("without", (leavesOut ? [...without, name] : others).join(","));
    if (!leavesOut) this.#endComparison();
    else if (!settings.shown.some((value) => AT_CAMERA.includes(value))) this.#beginComparison();
  }

  /** Compare the view with the camera's image. */
  #beginComparison() {
    const { settings } = this;
    this.before = { mode: settings.get("mode"), left: settings.get("left"), right: settings.get("right") };
    settings.set("left", "completed");
    settings.set("right", "original");
    settings.set("mode", "split");
  }

  /** Return to what was shown before the comparison, unless something else was chosen since. */
  #endComparison() {
    const { settings, before } = this;
    this.before = null;
    if (!before || settings.get("mode") !== "split" || settings.get("right") !== "original") return;
    settings.set("mode", before.mode);
    settings.set("left", before.left);
    settings.set("right", before.right);
  }

  /** @param {any} camera the one that the view is at; null for none */
  at(camera) {
    if (camera === this.here) return;
    this.here = camera;
    this.#inputs();
  }

  /** Which cameras are inputs. */
  #inputs() {
    const without = this.settings.without;
    for (const list of ["cameras", "labels"]) {
      this.cameras.forEach(({ name }, index) => byId(list).children[index]?.toggleAttribute("data-off", without.includes(name)));
    }
    const off = this.here && without.includes(this.here.name);
    byId("input-row").hidden = !this.here;
    byId("input-name").textContent = this.here ? `Use ${this.here.name} as an input` : "";
    byId("input").checked = !off;
    byId("input").disabled = !off && this.cameras.length - without.length <= 2; // a hull needs two
    byId("inputs-all").hidden = !without.length;
    this.used = "";
  }

  /** @param {number} index */
  to(index) {
    this.last = index;
    this.snap(this.cameras[index]);
  }

  /** @param {number} steps along the list */
  next(steps) {
    const count = this.cameras.length;
    if (count) this.to((Math.max(this.last, steps < 0 ? 0 : -1) + steps + count) % count);
  }

  /** Which cameras colour the picture. @param {string[]} sources @param {number[][] | undefined} colours @returns {boolean} whether it changed */
  use(sources, colours) {
    const used = JSON.stringify([sources, colours]);
    if (used === this.used) return false;
    this.used = used;
    this.cameras.forEach((camera, index) => {
      const place = sources.indexOf(camera.name);
      for (const list of ["cameras", "labels"]) {
        const button = byId(list).children[index];
        button.toggleAttribute("data-used", place >= 0);
        if (place >= 0 && colours?.[place]) button.style.setProperty("--colour", css(colours[place]));
        else button.style.removeProperty("--colour");
      }
    });
    const out = this.settings.without.length;
    byId("camera-count").textContent = `${sources.length} of ${this.cameras.length} used for this view${out ? `, ${out} left out` : ""}`;
    return true;
  }

  /** @param {boolean} shown @param {any} viewer in CSS pixels @param {{left: number, top: number}} box where the picture is */
  place(shown, viewer, box) {
    const labels = byId("labels");
    labels.hidden = !shown;
    if (!shown) return;
    this.cameras.forEach((camera, index) => {
      const at = project(viewer, camera.center);
      const label = labels.children[index];
      label.hidden = !at;
      if (at) label.style.transform = `translate(${at[0] + box.left}px, ${at[1] + box.top}px) translate(-50%, 9px)`;
    });
  }
}
