// Helpers for elements of the document.

/** The step of each arrow key in a radio group. @type {Record<string, number>} */
const ARROW_STEPS = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 };
/** The URL of a saved file is released after this long, in milliseconds. */
const REVOKE_MS = 60000;

/**
 * Get an element, which must exist.
 * @param {string} id
 * @returns {any}
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`no element ${id}`);
  return found;
}

/**
 * Create an element.
 * @param {string} tag
 * @param {Record<string, any>} properties
 * @param {(Node | string)[]} children
 * @returns {any}
 */
export function element(tag, properties = {}, ...children) {
  const created = Object.assign(document.createElement(tag), properties);
  created.append(...children);
  return created;
}

/**
 * Set the icon of a button.
 * @param {HTMLElement} button
 * @param {string} icon name of its symbol
 */
export function setIcon(button, icon) {
  button.querySelector("use")?.setAttribute("href", `#i-${icon}`);
}

/**
 * Set the value of a slider, and how far it is filled.
 * @param {HTMLInputElement} slider
 * @param {number} value
 */
export function setSlider(slider, value) {
  slider.value = String(value);
  const low = Number(slider.min);
  const high = Number(slider.max);
  const part = high > low ? (Number(slider.value) - low) / (high - low) : 0;
  slider.style.setProperty("--part", `${(100 * part).toFixed(1)}%`);
}

/**
 * Let one of several buttons be checked; arrow keys move to the next one.
 * @param {HTMLElement} group
 * @param {(value: string) => void} choose
 * @returns {(value: string) => void} shows which one is checked
 */
export function setUpRadioGroup(group, choose) {
  const listButtons = () => /** @type {HTMLButtonElement[]} */ ([...group.querySelectorAll("[role=radio]")]);
  group.addEventListener("click", (event) => {
    const button = /** @type {Element} */ (event.target).closest("[role=radio]");
    if (button instanceof HTMLElement) choose(button.dataset.value ?? "");
  });
  group.addEventListener("keydown", (event) => {
    const step = ARROW_STEPS[event.key];
    const buttons = listButtons();
    const index = buttons.indexOf(/** @type {any} */ (document.activeElement));
    if (!step || index < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const next = buttons[(index + step + buttons.length) % buttons.length];
    next.focus();
    choose(next.dataset.value ?? "");
  });
  return (value) => {
    for (const button of listButtons()) {
      const checked = button.dataset.value === value;
      button.setAttribute("aria-checked", String(checked));
      button.tabIndex = checked ? 0 : -1;
      if (checked) scrollTo(group, button);
    }
  };
}

/**
 * Scroll a strip until it shows one of its buttons; `scrollIntoView` would also scroll a page around it.
 * @param {HTMLElement} strip
 * @param {HTMLElement} button
 */
function scrollTo(strip, button) {
  const shown = strip.getBoundingClientRect();
  const wanted = button.getBoundingClientRect();
  const hiddenLeft = Math.max(0, shown.left - wanted.left);
  const hiddenRight = Math.max(0, wanted.right - shown.right);
  strip.scrollLeft += hiddenRight - hiddenLeft;
}

/**
 * Save a blob as a file.
 * @param {Blob} blob
 * @param {string} name
 */
export function download(blob, name) {
  const url = URL.createObjectURL(blob);
  element("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), REVOKE_MS);
}
