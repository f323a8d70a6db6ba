// Statistics: frame rate, latency and the cost of each stage, with a small plot of the last frames.

import { byId, element } from "./dom.js";

/** The name and the colour of each stage of the server. */
const STAGES = {
  geometry: ["Geometry", "#4fc3b1"],
  context: ["Context", "#6ea8fe"],
  rendering: ["Rendering", "#f0c04c"],
  inpainting: ["Completing", "#ef7fa7"],
  encode: ["Encoding", "#a58bf0"],
  wait: ["Waiting", "#56606d"],
};
/** The figures: the end of each element's id, and its label. */
const FIGURES = {
  fps: "frames/s",
  repaints: "repaints/s",
  latency: "latency",
  holes: "holes",
  size: "resolution",
  kb: "per frame",
  dropped: "dropped",
  viewers: "viewers",
  budget: "time budget",
  triangles: "triangles",
  textures: "textures",
};
/** The plot shows this many frames. */
const HISTORY = 120;
/** The costs of the stages are means of this many frames. */
const RECENT = 20;
/** The latency is the median of this many frames. */
const LATENCIES = 60;
/** Rates are measured over this long, in milliseconds. */
const RATE_MS = 2000;
/** When a rate has more events than this, the oldest half is dropped. */
const MAX_EVENTS = 400;
/** The figures are updated at this interval, in milliseconds. */
const UPDATE_MS = 500;
/** The plot has grid lines at a multiple of one of these, in milliseconds. */
const GRID_STEPS_MS = [5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000];
/** The plot has at most about this many grid lines. */
const MAX_GRID_LINES = 3.2;

/** @param {number[]} values @param {number} share */
function computeQuantile(values, share) {
  if (!values.length) return NaN;
  const sorted = [...values].sort((a, b) => a - b);
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

/** The rate of events. */
class Rate {
  constructor() {
    /** @type {number[]} */
    this.times = [];
  }

  mark() {
    this.times.push(performance.now());
    if (this.times.length > MAX_EVENTS) this.times.splice(0, MAX_EVENTS / 2);
  }

  get perSecond() {
    const start = performance.now() - RATE_MS;
    return this.times.filter((time) => time > start).length / (RATE_MS / 1000);
  }
}

export class Statistics {
  /** @param {() => boolean} isActive whether the view moves or plays; at rest, a frame rate means nothing */
  constructor(isActive) {
    this.isActive = isActive;
    /** Frames of the server. */
    this.received = new Rate();
    this.repaints = new Rate();
    /** Views that the page has drawn. */
    this.drawn = new Rate();
    /**
     * What the last view drawn by the page needed; null if the server draws.
     * @type {{draws: number, triangles: number, textureBytes: number} | null}
     */
    this.cost = null;
    /** @type {number[]} */
    this.latencies = [];
    /** Milliseconds of each stage, by frame. @type {Record<string, number>[]} */
    this.history = [];
    /** The last message "stats". @type {any} */
    this.server = null;
    /** The header of the last frame. @type {any} */
    this.header = null;
    /** Number of the last request that was answered. */
    this.answered = 0;
    this.bytes = 0;
    /** @type {Record<string, HTMLElement>} */
    this.figures = {};
    /** @type {Record<string, HTMLElement>} */
    this.stages = {};
    this.#build();
    setInterval(() => this.#show(), UPDATE_MS);
  }

  #build() {
    for (const [name, text] of Object.entries(FIGURES)) {
      const value = element("dd", { id: `figure-${name}`, textContent: "–" });
      this.figures[name] = value;
      byId("figures").append(element("div", {}, element("dt", { textContent: text }), value));
    }
    for (const [name, [text, colour]] of Object.entries({ ...STAGES, total: ["Total", ""] })) {
      const value = element("span", { textContent: "–" });
      const swatch = element("i");
      swatch.style.setProperty("--colour", colour || "transparent");
      byId("stages").append(element("li", { className: name }, swatch, text, value));
      this.stages[name] = value;
    }
  }

  /**
   * Take a frame of the server into account.
   * @param {any} header
   * @param {number} bytes
   * @returns {number | null} milliseconds from the request to the image, if the frame answers a new request
   */
  addFrame(header, bytes) {
    this.received.mark();
    this.header = header;
    this.bytes = bytes;
    this.history.push(header.stage_ms);
    if (this.history.length > HISTORY) this.history.shift();
    if (header.look <= this.answered) return null;
    this.answered = header.look;
    const latency = performance.now() - header.sent_ms;
    this.latencies.push(latency);
    if (this.latencies.length > LATENCIES) this.latencies.shift();
    return latency;
  }

  /**
   * Take a repaint into account.
   * @param {{draws: number, triangles: number, textureBytes: number} | null} cost of a view that the page has
   *   drawn;
   *   null for one of the server
   */
  addRepaint(cost) {
    this.repaints.mark();
    this.cost = cost;
    if (cost) this.drawn.mark();
  }

  #show() {
    const latency = computeQuantile(this.latencies, 0.5);
    const fps = (this.cost ? this.drawn : this.received).perSecond;
    this.#showReadout(fps, latency);
    if (!this.header || !byId("section-stats").offsetParent) return;
    this.#showFigures(fps, latency);
    this.#showStages();
    this.#plot();
  }

  /**
   * Show the frame rate and the latency at the top of the page.
   * @param {number} fps
   * @param {number} latency ms
   */
  #showReadout(fps, latency) {
    const parts = [];
    if (Math.round(fps)) parts.push(`${Math.round(fps)} fps`);
    if (!this.cost && latency > 0) parts.push(`${latency.toFixed(0)} ms`);
    byId("readout").textContent = this.isActive() ? parts.join(" · ") : "";
  }

  /** @param {number} fps @param {number} latency ms */
  #showFigures(fps, latency) {
    const { figures, header, server, cost } = this;
    const show = (/** @type {string} */ name, /** @type {string} */ value, unit = "") => {
      figures[name].replaceChildren(value, element("small", { textContent: unit }));
    };
    show("fps", fps.toFixed(1));
    show("triangles", cost ? cost.triangles.toLocaleString("en") : "–");
    show("textures", cost ? (cost.textureBytes / 1e6).toFixed(1) : "–", cost ? " MB" : "");
    show("repaints", this.repaints.perSecond.toFixed(0));
    show("latency", Number.isNaN(latency) ? "–" : latency.toFixed(0), " ms");
    show("holes", (100 * header.holes).toFixed(1), " %");
    show("size", `${header.width}×${header.height}`);
    show("kb", (this.bytes / 1000).toFixed(0), " kB");
    show("dropped", String(header.dropped));
    show("viewers", String(server?.viewers ?? "–"));
    show("budget", server?.budget ? server.budget.target_ms.toFixed(0) : "none", server?.budget ? " ms" : "");
  }

  /** Show the mean cost of each stage. */
  #showStages() {
    const recent = this.history.slice(-RECENT);
    for (const name of Object.keys(this.stages)) {
      const mean = recent.reduce((sum, stages) => sum + (stages[name] ?? 0), 0) / recent.length;
      this.stages[name].textContent = `${mean.toFixed(mean < 9.95 ? 1 : 0)} ms`;
    }
  }

  /** Plot the stages of the last frames as stacked bars. */
  #plot() {
    const canvas = byId("plot");
    const ratio = Math.min(2, window.devicePixelRatio);
    const width = Math.round(canvas.clientWidth * ratio);
    const height = Math.round(canvas.clientHeight * ratio);
    canvas.width = width;
    canvas.height = height;
    const context = canvas.getContext("2d");

    // one bar per frame
    const names = Object.keys(STAGES);
    const sums = this.history.map((stages) => names.reduce((sum, name) => sum + (stages[name] ?? 0), 0));
    const top = 1.15 * Math.max(10, computeQuantile(sums, 0.97));
    const bar = width / HISTORY;
    this.history.forEach((stages, index) => {
      let y = height;
      const x = width - (this.history.length - index) * bar;
      for (const [name, [, colour]] of Object.entries(STAGES)) {
        const part = ((stages[name] ?? 0) / top) * height;
        context.fillStyle = colour;
        context.fillRect(x, y - part, Math.max(1, bar - 0.5), part);
        y -= part;
      }
    });

    // grid lines
    const step = GRID_STEPS_MS.find((ms) => top / ms <= MAX_GRID_LINES) ?? 10000;
    context.font = `${10 * ratio}px system-ui, sans-serif`;
    for (let ms = step; ms < top; ms += step) {
      const y = Math.round(height * (1 - ms / top)) + 0.5;
      context.fillStyle = "#8a929c40";
      context.fillRect(0, y, width, 1);
      context.fillStyle = "#8a929c";
      if (y > 14 * ratio) context.fillText(`${ms} ms`, 5 * ratio, y - 3 * ratio);
    }
  }
}
