// Figures: how fast, how late, what each stage costs, with the last frames as a small plot.

import { byId, element } from "./dom.js";

const STAGES = {
  geometry: ["Geometry", "#4fc3b1"],
  context: ["Context", "#6ea8fe"],
  rendering: ["Rendering", "#f0c04c"],
  inpainting: ["Completing", "#ef7fa7"],
  encode: ["Encoding", "#a58bf0"],
  wait: ["Waiting", "#56606d"],
};
const HISTORY = 120;
const LATENCIES = 60;

/** @param {number[]} values @param {number} share */
function quantile(values, share) {
  const sorted = [...values].sort((a, b) => a - b);
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : NaN;
}

/** Times of events within the last two seconds. */
class Rate {
  constructor() {
    /** @type {number[]} */
    this.times = [];
  }

  mark() {
    this.times.push(performance.now());
    if (this.times.length > 400) this.times.splice(0, 200);
  }

  get perSecond() {
    const start = performance.now() - 2000;
    return this.times.filter((time) => time > start).length / 2;
  }
}

export class Statistics {
  /** @param {() => boolean} active whether the view moves or plays: a frame rate means nothing at rest */
  constructor(active) {
    this.active = active;
    this.pictures = new Rate();
    this.repaints = new Rate();
    this.drawn = new Rate();
    /** What the last view drawn by the page needed; null if the server draws. @type {{draws: number, triangles: number, textureBytes: number} | null} */
    this.cost = null;
    /** @type {number[]} */
    this.latencies = [];
    /** @type {Record<string, number>[]} */
    this.history = [];
    /** @type {any} */
    this.server = null;
    /** @type {any} */
    this.header = null;
    this.answered = 0;
    this.bytes = 0;
    /** @type {Record<string, HTMLElement>} */
    this.figures = {};
    /** @type {Record<string, HTMLElement>} */
    this.stages = {};
    this.#build();
    setInterval(() => this.#show(), 500);
  }

  #build() {
    for (const [name, text] of [
      ["fps", "frames/s"], ["repaints", "repaints/s"], ["latency", "latency"],
      ["holes", "holes"], ["size", "resolution"], ["kb", "per frame"],
      ["dropped", "dropped"], ["viewers", "viewers"], ["budget", "time budget"],
      ["triangles", "triangles"], ["textures", "textures"],
    ]) {
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

  /** A picture is on the canvas. @param {any} header @param {number} bytes @returns {number | null} pose to pixel, if it answers a new look */
  picture(header, bytes) {
    this.pictures.mark();
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

  /** The page has drawn a view, or shown one of the server's. @param {{draws: number, triangles: number, textureBytes: number} | null} cost */
  painted(cost) {
    this.repaints.mark();
    this.cost = cost;
    if (cost) this.drawn.mark();
  }

  #show() {
    const { cost } = this;
    const median = quantile(this.latencies, 0.5);
    const fps = Math.round((cost ? this.drawn : this.pictures).perSecond);
    const late = !cost && median > 0 ? [`${median.toFixed(0)} ms`] : [];
    byId("readout").textContent = this.active() ? [...(fps ? [`${fps} fps`] : []), ...late].join(" · ") : "";
    if (!this.header) return;
    if (!byId("section-stats").offsetParent) return;
    const { figures, header, server } = this;
    const count = (/** @type {number} */ value) => value.toLocaleString("en");
    const put = (/** @type {string} */ name, /** @type {string} */ value, unit = "") => {
      figures[name].replaceChildren(value, element("small", { textContent: unit }));
    };
    put("fps", (cost ? this.drawn : this.pictures).perSecond.toFixed(1));
    put("triangles", cost ? count(cost.triangles) : "–");
    put("textures", cost ? (cost.textureBytes / 1e6).toFixed(1) : "–", cost ? " MB" : "");
    put("repaints", this.repaints.perSecond.toFixed(0));
    put("latency", Number.isNaN(median) ? "–" : median.toFixed(0), " ms");
    put("holes", (100 * header.holes).toFixed(1), " %");
    put("size", `${header.width}×${header.height}`);
    put("kb", (this.bytes / 1000).toFixed(0), " kB");
    put("dropped", String(header.dropped));
    put("viewers", String(server?.viewers ?? "–"));
    put("budget", server?.budget ? server.budget.target_ms.toFixed(0) : "none", server?.budget ? " ms" : "");
    const recent = this.history.slice(-20);
    for (const name of Object.keys(this.stages)) {
      const mean = recent.reduce((sum, stages) => sum + (stages[name] ?? 0), 0) / recent.length;
      this.stages[name].textContent = `${mean.toFixed(mean < 9.95 ? 1 : 0)} ms`;
    }
    this.#plot();
  }

  #plot() {
    const canvas = byId("plot");
    const ratio = Math.min(2, window.devicePixelRatio);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    canvas.width = width;
    canvas.height = height;
    const pen = canvas.getContext("2d");
    const sums = this.history.map((stages) => Object.keys(STAGES).reduce((sum, name) => sum + (stages[name] ?? 0), 0));
    const top = 1.15 * Math.max(10, quantile(sums, 0.97));
    const bar = width / HISTORY;
    this.history.forEach((stages, index) => {
      let y = height;
      const x = width - (this.history.length - index) * bar;
      for (const [name, [, colour]] of Object.entries(STAGES)) {
        const part = ((stages[name] ?? 0) / top) * height;
        pen.fillStyle = colour;
        pen.fillRect(x, y - part, Math.max(1, bar - 0.5), part);
        y -= part;
      }
    });
    const step = [5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000].find((ms) => top / ms <= 3.2) ?? 10000;
    pen.font = `${10 * ratio}px system-ui, sans-serif`;
    for (let ms = step; ms < top; ms += step) {
      const y = Math.round(height * (1 - ms / top)) + 0.5;
      pen.fillStyle = "#8a929c40";
      pen.fillRect(0, y, width, 1);
      pen.fillStyle = "#8a929c";
      if (y > 14 * ratio) pen.fillText(`${ms} ms`, 5 * ratio, y - 3 * ratio);
    }
  }
}
