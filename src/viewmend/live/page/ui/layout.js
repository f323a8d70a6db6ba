// Measures the part of the page that no panel covers; the subject is shown in its middle.

import { byId } from "./dom.js";

/** @typedef {import("../view/lens.js").Box} Box */

/** The free part is at least this wide and high, in CSS pixels. */
const MIN_SIDE = 60;
/** Matches narrow pages, where the panel is at the bottom. */
const NARROW = window.matchMedia("(max-width: 760px)");

/** Keeps the boxes `page` and `free` up to date, and calls back when they change. */
export class Layout {
  /** @param {import("../settings.js").Settings} settings @param {() => void} changed */
  constructor(settings, changed) {
    this.changed = changed;
    /** @type {Box} */
    this.page = { left: 0, top: 0, width: 1, height: 1 };
    /** @type {Box} */
    this.free = this.page;
    const observer = new ResizeObserver(() => this.measure());
    for (const id of ["stage", "panel", "tabs"]) observer.observe(byId(id));
    for (const part of document.querySelectorAll(".dock")) observer.observe(part);
    settings.watch(["panel"], () => {
      document.body.dataset.panel = settings.get("panel") ? "on" : "off";
      byId("tool-panel").setAttribute("aria-pressed", String(settings.get("panel")));
      this.measure();
    });
    this.#listenToTabs();
  }

  get narrow() {
    return NARROW.matches;
  }

  /** Open and close the sections of a narrow page. */
  #listenToTabs() {
    const tabs = byId("tabs");
    tabs.addEventListener("click", (/** @type {Event} */ event) => {
      const tab = /** @type {Element} */ (event.target).closest("button");
      if (!tab) return;
      const open = document.body.dataset.section === tab.dataset.section;
      if (open) delete document.body.dataset.section;
      else document.body.dataset.section = tab.dataset.section;
      for (const one of tabs.children) one.setAttribute("aria-expanded", String(!open && one === tab));
      this.measure();
    });
  }

  measure() {
    const { innerWidth: width, innerHeight: height } = window;
    const bar = measureElement(".bar");
    const panel = measureElement(".panel");
    const dock = measureElement(".dock");
    const covered = panel.width > 0;
    const right = covered && !this.narrow ? panel.left : width;
    const bottom = Math.min(dock.top, covered && this.narrow ? panel.top : height);
    this.page = { left: 0, top: 0, width, height };
    this.free = {
      left: 0,
      top: bar.bottom,
      width: Math.max(MIN_SIDE, right),
      height: Math.max(MIN_SIDE, bottom - bar.bottom),
    };
    document.body.style.setProperty("--middle", `${this.free.left + this.free.width / 2}px`);
    document.body.style.setProperty("--centre", `${this.free.top + this.free.height / 2}px`);
    this.changed();
  }
}

/** Measure an element, which must exist. @param {string} selector */
function measureElement(selector) {
  return /** @type {Element} */ (document.querySelector(selector)).getBoundingClientRect();
}
