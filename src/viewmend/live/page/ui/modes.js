// Which picture is shown, and the divider of "side by side".

import { clamp } from "../view/matrix.js";
import { byId, element, radioGroup } from "./dom.js";
import { modeOf } from "../settings.js";

/** @typedef {import("../settings.js").Settings} Settings */

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

/** The name of a completed view next to those of other models. @param {string} model */
const completedBy = (model) => `${MODES.completed} (${model})`;
/** The name of the completed view: with the server's model, once it is known. */
let completed = MODES.completed;
/** Of what is shown on one side of the divider. @param {string} value */
const nameOf = (value) =>
  ({ ...MODES, completed, original: "Original", error: "Error map", compared: completedBy(value.slice("compared:".length)) })[modeOf(value)] ?? value;
/** The same in a narrow list: without the server's model, or the other model alone. @param {string} value */
const shortNameOf = (value) =>
  value === "completed" ? MODES.completed : modeOf(value) === "compared" ? value.slice("compared:".length) : nameOf(value);

/** What can be compared, once the server said which models it has. @param {Settings} settings @param {string} own model's name @param {string[]} models the others */
export function offerModels(settings, own, models) {
  completed = completedBy(own);
  const others = [...models.map((name) => `compared:${name}`), "original", "error"];
  for (const side of /** @type {("left" | "right")[]} */ (["left", "right"])) {
    const list = byId(`split-${side}`);
    for (const option of [...list.options]) if (!(option.value in MODES)) option.remove();
    list.append(...others.map((value) => element("option", { value, textContent: shortNameOf(value) })));
    if (![...list.options].some(({ value }) => value === settings.get(side))) settings.set(side, "completed");
    list.value = settings.get(side);
    for (const option of list.options) option.textContent = shortNameOf(option.value);
    byId(`${side}-name`).textContent = nameOf(settings.get(side));
  }
}

/** @param {Settings} settings @param {string[]} modes that can be shown */
export function buildModes(settings, modes) {
  const strip = byId("modes");
  const offered = Object.entries(MODES).filter(([value]) => modes.includes(value));
  for (const [value, text] of offered) {
    const button = element("button", { type: "button", textContent: text });
    button.setAttribute("role", "radio");
    button.dataset.value = value;
    strip.append(button);
  }
  const show = radioGroup(strip, (value) => settings.set("mode", value));
  settings.watch(["mode"], () => show(settings.get("mode")));

  for (const side of /** @type {("left" | "right")[]} */ (["left", "right"])) {
    const list = byId(`split-${side}`);
    for (const [value, text] of offered) {
      if (value !== "split") list.append(element("option", { value, textContent: text }));
    }
    list.addEventListener("change", () => settings.set(side, list.value));
    settings.watch([side, "mode"], () => {
      list.value = settings.get(side);
      byId(`${side}-name`).textContent = nameOf(settings.get(side));
      byId(`${side}-name`).hidden = settings.get("mode") !== "split";
      byId("split-modes").hidden = settings.get("mode") !== "split";
    });
  }
  buildDivider(settings);
}

/** @param {Settings} settings */
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
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02, Home: -1, End: 1 }[event.key];
    if (step === undefined) return;
    event.preventDefault();
    settings.set("divider", clamp(settings.get("divider") + step, 0, 1));
  });
}

/**
 * Name both sides of the divider by what they show.
 * @param {Settings} settings @param {(mode: string) => string} shownMode what is drawn for a mode at this pose
 */
export function nameSides(settings, shownMode) {
  for (const side of /** @type {("left" | "right")[]} */ (["left", "right"])) {
    const wanted = settings.get(side);
    const isThere = shownMode(modeOf(wanted)) === modeOf(wanted);
    const text = isThere ? nameOf(wanted) : `${MODES.completed} (${nameOf(wanted).toLowerCase()}: only at a camera)`;
    const label = byId(`${side}-name`);
    if (label.textContent !== text) label.textContent = text;
  }
}

/**
 * Put the divider and the two names where they belong.
 * @param {Settings} settings @param {import("../view/lens.js").Box} free @returns {number} the divider's x, CSS pixels
 */
export function placeDivider(settings, free) {
  const divider = byId("divider");
  const at = settings.get("divider");
  const x = free.left + at * free.width;
  Object.assign(divider.dataset, { left: free.left, width: free.width });
  divider.hidden = settings.get("mode") !== "split";
  divider.style.transform = `translateX(${x}px)`;
  divider.style.top = `${free.top}px`;
  divider.style.height = `${free.height}px`;
  divider.setAttribute("aria-valuenow", String(Math.round(100 * at)));
  byId("left-name").style.left = `${free.left + 12}px`;
  byId("right-name").style.right = `${window.innerWidth - free.left - free.width + 12}px`;
  return x;
}
