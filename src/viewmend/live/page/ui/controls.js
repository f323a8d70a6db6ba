// The sections "View" and "Quality", and the switches that appear twice.

import { byId, element, radioGroup, setSlider } from "./dom.js";

const TOKENS = [64, 128, 256, 512, 1024, 2048, null];
const RULES = { holes: "only holes", all: "the whole subject", predicted: "pixels predicted to be wrong" };
const CODECS = { jpeg: "JPEG", vp9: "VP9 video", h264: "H.264 video" };

/** @typedef {import("../settings.js").Settings} Settings */

/** The page's theme and the background of images; the theme's own until one is chosen. @param {Settings} settings */
function buildGround(settings) {
  byId("theme").addEventListener("change", () => {
    settings.set("background", "");
    settings.set("theme", byId("theme").value);
  });
  byId("background").addEventListener("input", () => settings.set("background", byId("background").value.slice(1)));
  settings.watch(["theme", "background", "modelGround"], () => {
    byId("theme").value = settings.get("theme");
    byId("background").value = `#${settings.ground}`;
    document.documentElement.dataset.theme = settings.get("theme");
    byId("stage").style.background = `#${settings.ground}`;
  });
}

/** @param {Settings} settings @param {import("../view/motion.js").Motion} motion @param {() => void} wake */
export function buildControls(settings, motion, wake) {
  const showMovement = radioGroup(byId("movement"), (value) => {
    motion.mode = value === "fly" ? "fly" : "orbit";
    showMovement(value);
  });
  byId("fov").addEventListener("input", () => {
    motion.lens(Number(byId("fov").value));
    wake();
  });
  for (const name of /** @type {("reproject" | "sharp" | "adaptive" | "originals" | "rig")[]} */ (["reproject", "sharp", "adaptive", "originals", "rig"])) {
    const box = byId(name);
    box.addEventListener("change", () => settings.set(name, box.checked));
    settings.watch([name], () => (box.checked = settings.get(name)));
  }
  byId("tool-rig").addEventListener("click", () => settings.set("rig", !settings.get("rig")));
  settings.watch(["rig"], () => byId("tool-rig").setAttribute("aria-pressed", String(settings.get("rig"))));
  byId("quality").addEventListener("input", () => settings.set("topK", TOKENS[Number(byId("quality").value)]));
  settings.watch(["topK"], () => {
    const topK = settings.get("topK");
    const place = TOKENS.findIndex((tokens) => tokens !== null && topK !== null && tokens >= topK);
    setSlider(byId("quality"), place < 0 ? TOKENS.length - 1 : place);
    const text = topK === null ? "all" : `best ${topK} patches`;
    byId("quality-value").textContent = text;
    byId("quality").setAttribute("aria-valuetext", text);
  });
  byId("side").addEventListener("input", () => settings.set("side", Number(byId("side").value)));
  settings.watch(["side"], () => setSlider(byId("side"), settings.get("side")));
  byId("error-rule").addEventListener("change", () => settings.set("errorRule", byId("error-rule").value));
  byId("codec").addEventListener("change", () => settings.set("codec", byId("codec").value));
  buildGround(settings);
  return {
    /** @param {string} mode */
    movement(mode) {
      motion.mode = mode === "fly" ? "fly" : "orbit";
      showMovement(mode);
    },
    /** @param {string[]} rules that the server knows @param {string} standard the one it was started with */
    rules(rules, standard) {
      const list = byId("error-rule");
      list.replaceChildren(...rules.map((value) => element("option", { value, textContent: /** @type {any} */ (RULES)[value] ?? value })));
      if (!rules.includes(settings.get("errorRule"))) settings.set("errorRule", standard, false);
      list.value = settings.get("errorRule");
      list.closest("label").hidden = rules.length < 2;
    },
    /** @param {string[]} codecs that both sides can */
    codecs(codecs) {
      const list = byId("codec");
      list.replaceChildren(...codecs.map((value) => element("option", { value, textContent: /** @type {any} */ (CODECS)[value] ?? value })));
      if (!codecs.includes(settings.get("codec"))) settings.set("codec", "jpeg", false);
      list.value = settings.get("codec");
      list.closest("label").hidden = codecs.length < 2;
    },
    /** @param {number} fov degrees */
    fov(fov) {
      setSlider(byId("fov"), Math.round(fov));
      byId("fov-value").textContent = `${Math.round(fov)}°`;
    },
    /** @param {{width: number, height: number}} size of the picture that is shown */
    size({ width, height }) {
      const text = `${width} × ${height}`;
      if (byId("side-value").textContent !== text) byId("side-value").textContent = text;
    },
  };
}
