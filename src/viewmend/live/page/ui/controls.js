// The sections "View" and "Quality", and the switches that appear twice.

import { byId, element, setSlider, setUpRadioGroup } from "./dom.js";

/** The positions of the quality slider: patches that the model reads, null for all. */
const PATCHES = [64, 128, 256, 512, 1024, 2048, null];
/** The names of the error rules. */
const RULES = { holes: "only holes", all: "the whole subject", predicted: "pixels predicted to be wrong" };
/** The names of the codecs. */
const CODECS = { jpeg: "JPEG", vp9: "VP9 video", h264: "H.264 video" };
/**
 * Settings that are a checkbox with the same id.
 * @type {("reproject" | "sharp" | "adaptive" | "originals" | "rig")[]}
 */
const CHECKBOXES = ["reproject", "sharp", "adaptive", "originals", "rig"];

/** @typedef {import("../settings.js").Settings} Settings */

/**
 * Set up the controls.
 * @param {Settings} settings
 * @param {import("../view/motion.js").Motion} motion
 * @param {() => void} wake
 */
export function buildControls(settings, motion, wake) {
  const showMovement = setUpRadioGroup(byId("movement"), (value) => {
    motion.mode = value === "fly" ? "fly" : "orbit";
    showMovement(value);
  });
  byId("fov").addEventListener("input", () => {
    motion.setFov(Number(byId("fov").value));
    wake();
  });
  for (const name of CHECKBOXES) {
    const box = byId(name);
    box.addEventListener("change", () => settings.set(name, box.checked));
    settings.watch([name], () => (box.checked = settings.get(name)));
  }
  byId("tool-rig").addEventListener("click", () => settings.set("rig", !settings.get("rig")));
  settings.watch(["rig"], () => byId("tool-rig").setAttribute("aria-pressed", String(settings.get("rig"))));
  setUpQuality(settings);
  byId("side").addEventListener("input", () => settings.set("side", Number(byId("side").value)));
  settings.watch(["side"], () => setSlider(byId("side"), settings.get("side")));
  byId("error-rule").addEventListener("change", () => settings.set("errorRule", byId("error-rule").value));
  byId("codec").addEventListener("change", () => settings.set("codec", byId("codec").value));
  setUpTheme(settings);
  return {
    /** @param {string} mode */
    setMovement(mode) {
      motion.mode = mode === "fly" ? "fly" : "orbit";
      showMovement(mode);
    },
    /**
     * @param {string[]} rules that the server knows
     * @param {string} standard the one that it was started with
     */
    setRules(rules, standard) {
      if (!rules.includes(settings.get("errorRule"))) settings.set("errorRule", standard, false);
      fillList(byId("error-rule"), rules, RULES, settings.get("errorRule"));
    },
    /** @param {string[]} codecs that both sides support */
    setCodecs(codecs) {
      if (!codecs.includes(settings.get("codec"))) settings.set("codec", "jpeg", false);
      fillList(byId("codec"), codecs, CODECS, settings.get("codec"));
    },
    /** @param {number} fov degrees */
    setFov(fov) {
      setSlider(byId("fov"), Math.round(fov));
      byId("fov-value").textContent = `${Math.round(fov)}°`;
    },
    /** @param {{width: number, height: number}} size of the image that is shown */
    setSize({ width, height }) {
      const text = `${width} × ${height}`;
      if (byId("side-value").textContent !== text) byId("side-value").textContent = text;
    },
  };
}

/** Set up the slider for the number of patches. @param {Settings} settings */
function setUpQuality(settings) {
  byId("quality").addEventListener("input", () => {
    settings.set("topK", PATCHES[Number(byId("quality").value)]);
  });
  settings.watch(["topK"], () => {
    const topK = settings.get("topK");
    const position = PATCHES.findIndex((patches) => patches !== null && topK !== null && patches >= topK);
    setSlider(byId("quality"), position < 0 ? PATCHES.length - 1 : position);
    const text = topK === null ? "all" : `best ${topK} patches`;
    byId("quality-value").textContent = text;
    byId("quality").setAttribute("aria-valuetext", text);
  });
}

/**
 * Set up the page's theme and the background of images, which follows the theme until one is chosen.
 * @param {Settings} settings
 */
function setUpTheme(settings) {
  byId("theme").addEventListener("change", () => {
    settings.set("background", "");
    settings.set("theme", byId("theme").value);
  });
  byId("background").addEventListener("input", () => {
    settings.set("background", byId("background").value.slice(1));
  });
  settings.watch(["theme", "background", "modelGround"], () => {
    byId("theme").value = settings.get("theme");
    byId("background").value = `#${settings.backgroundColour}`;
    document.documentElement.dataset.theme = settings.get("theme");
    byId("stage").style.background = `#${settings.backgroundColour}`;
  });
}

/**
 * Fill a list with values, and hide it if there is nothing to choose.
 * @param {any} list
 * @param {string[]} values
 * @param {Record<string, string>} names of the values
 * @param {string} chosen
 */
function fillList(list, values, names, chosen) {
  const options = values.map((value) => element("option", { value, textContent: names[value] ?? value }));
  list.replaceChildren(...options);
  list.value = chosen;
  list.closest("label").hidden = values.length < 2;
}
