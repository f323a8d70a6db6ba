// The choice of what is shown, and the divider of "Side by side".

import { clamp } from "../view/matrix.js";
import { byId, element, setUpRadioGroup } from "./dom.js";
import { parseMode } from "../settings.js";

/** @typedef {import("../settings.js").Settings} Settings */

/** The names of the modes, in the order of the strip. */
export const MODES = {
  rendered: "Rendered",
  holes: "Holes",
  completed: "Completed",
  split: "Side by side",
  depth: "Depth",
  coverage: "Source cameras",
  confidence: "Confidence",
  hull: "Hull",
  points: "Points",
};

/** The names of the images that only a split view can show. */
const COMPARED_NAMES = { original: "Original", error: "Error map" };
/** The sides of a split view. @type {("left" | "right")[]} */
const SIDES = ["left", "right"];
/** A mode that begins with this is the view completed by another model. */
const COMPARED_PREFIX = "compared:";
/** The shift of the divider by each key, as a share of the width. @type {Record<string, number>} */
const DIVIDER_STEPS = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 };
/** The names of the sides are this far from the edges, in CSS pixels. */
const NAME_MARGIN = 12;

/** The name of the completed view: with the server's model, once it is known. */
let completedName = MODES.completed;

/** Name the view completed by a model. @param {string} model */
const nameCompleted = (model) => `${MODES.completed} (${model})`;

/** Find the model of a mode such as "compared:paper". @param {string} value */
const findModel = (value) => value.slice(COMPARED_PREFIX.length);

/** Name what is shown on one side of the divider. @param {string} value */
function nameMode(value) {
  const mode = parseMode(value);
  if (mode === "completed") return completedName;
  if (mode === "compared") return nameCompleted(findModel(value));
  return /** @type {any} */ ({ ...MODES, ...COMPARED_NAMES })[mode] ?? value;
}

/** Name it in a narrow list: without the server's model, or the other model alone. @param {string} value */
function abbreviateMode(value) {
  if (value === "completed") return MODES.completed;
  return parseMode(value) === "compared" ? findModel(value) : nameMode(value);
}

/**
 * Offer what can be compared, once the server has named its models.
 * @param {Settings} settings
 * @param {string} own name of the server's model
 * @param {string[]} models the others
 */
export function offerModels(settings, own, models) {
  completedName = nameCompleted(own);
  const others = [...models.map((name) => `${COMPARED_PREFIX}${name}`), ...Object.keys(COMPARED_NAMES)];
  for (const side of SIDES) {
    const list = byId(`split-${side}`);
    for (const option of [...list.options]) {
      if (!(option.value in MODES)) option.remove();
    }
    list.append(...others.map((value) => element("option", { value, textContent: abbreviateMode(value) })));
    const offered = [...list.options].map(({ value }) => value);
    if (!offered.includes(settings.get(side))) settings.set(side, "completed");
    list.value = settings.get(side);
    for (const option of list.options) option.textContent = abbreviateMode(option.value);
    byId(`${side}-name`).textContent = nameMode(settings.get(side));
  }
}

/**
 * Build the strip and the lists of modes.
 * @param {Settings} settings
 * @param {string[]} modes that can be shown
 */
export function buildModes(settings, modes) {
  const strip = byId("modes");
  const offered = Object.entries(MODES).filter(([value]) => modes.includes(value));
  for (const [value, text] of offered) {
    const button = element("button", { type: "button", textContent: text });
    button.setAttribute("role", "radio");
    button.dataset.value = value;
    strip.append(button);
  }
  const show = setUpRadioGroup(strip, (value) => settings.set("mode", value));
  settings.watch(["mode"], () => show(settings.get("mode")));

  for (const side of SIDES) {
    const list = byId(`split-${side}`);
    for (const [value, text] of offered) {
      if (value !== "split") list.append(element("option", { value, textContent: text }));
    }
    list.addEventListener("change", () => settings.set(side, list.value));
    settings.watch([side, "mode"], () => {
      list.value = settings.get(side);
      const split = settings.get("mode") === "split";
      byId(`${side}-name`).textContent = nameMode(settings.get(side));
      byId(`${side}-name`).hidden = !split;
      byId("split-modes").hidden = !split;
    });
  }
  buildDivider(settings);
}

/** Let the divider be dragged, or moved by keys. @param {Settings} settings */
function buildDivider(settings) {
  const divider = byId("divider");
  const move = (/** @type {number} */ x) => {
    const { left, width } = divider.dataset;
    settings.set("divider", clamp((x - Number(left)) / Math.max(1, Number(width)), 0, 1));
  };
  divider.addEventListener("pointerdown", (/** @type {PointerEvent} */ event) => {
    divider.setPointerCapture(event.pointerId);
    event.preventDefault();
    divider.focus();
  });
  divider.addEventListener("pointermove", (/** @type {PointerEvent} */ event) => {
    if (divider.hasPointerCapture(event.pointerId)) move(event.clientX);
  });
  divider.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
    const step = DIVIDER_STEPS[event.key];
    if (step === undefined) return;
    event.preventDefault();
    settings.set("divider", clamp(settings.get("divider") + step, 0, 1));
  });
}

/**
 * Name both sides of the divider by what they show.
 * @param {Settings} settings
 * @param {(mode: string) => string} resolveMode finds the mode that is drawn at this pose
 */
export function nameSides(settings, resolveMode) {
  for (const side of SIDES) {
    const wanted = settings.get(side);
    const mode = parseMode(wanted);
    const name = nameMode(wanted);
    const available = resolveMode(mode) === mode;
    const text = available ? name : `${MODES.completed} (${name.toLowerCase()}: only at a camera)`;
    const label = byId(`${side}-name`);
    if (label.textContent !== text) label.textContent = text;
  }
}

/**
 * Place the divider and the names of its sides.
 * @param {Settings} settings
 * @param {import("../view/lens.js").Box} free
 * @returns {number} the divider's x, CSS pixels
 */
export function placeDivider(settings, free) {
  const divider = byId("divider");
  const share = settings.get("divider");
  const x = free.left + share * free.width;
  Object.assign(divider.dataset, { left: free.left, width: free.width });
  divider.hidden = settings.get("mode") !== "split";
  divider.style.transform = `translateX(${x}px)`;
  divider.style.top = `${free.top}px`;
  divider.style.height = `${free.height}px`;
  divider.setAttribute("aria-valuenow", String(Math.round(100 * share)));
  byId("left-name").style.left = `${free.left + NAME_MARGIN}px`;
  const right = window.innerWidth - free.left - free.width;
  byId("right-name").style.right = `${right + NAME_MARGIN}px`;
  return x;
}
