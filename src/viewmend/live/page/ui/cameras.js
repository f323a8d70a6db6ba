// The rig's cameras: a list to snap to, labels over the picture, and which of them colour it.

import { project } from "../draw/projection.js";
import { byId, element } from "./dom.js";

/** @param {number[]} colour */
const css = (colour) => `rgb(${colour.map(Math.round).join(" ")})`;

export class CameraList {
  /** @param {(camera: any) => void} snap */
  constructor(snap) {
    this.snap = snap;
    /** @type {any[]} */
    this.cameras = [];
    this.last = -1;
    this.used = "";
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
    this.use([], undefined);
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
    byId("camera-count").textContent = `${sources.length} of ${this.cameras.length} used for this view`;
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
