// Short words for the document.

/** @param {string} id @returns {any} */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`no element ${id}`);
  return found;
}

/** @param {string} tag @param {Record<string, any>} properties @param {(Node | string)[]} children @returns {any} */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

/** @param {HTMLElement} button @param {string} icon its symbol's name */
export function setIcon(button, icon) {
  button.querySelector("use")?.setAttribute("href", `#i-${icon}`);
}

/** A slider's value, and how far it is filled. @param {HTMLInputElement} slider @param {number} value */
export function setSlider(slider, value) {
  slider.value = String(value);
  const [low, high] = [Number(slider.min), Number(slider.max)];
  const part = high > low ? (Number(slider.value) - low) / (high - low) : 0;
  slider.style.setProperty("--part", `${(100 * part).toFixed(1)}%`);
}

/**
 * One of several buttons is checked: arrow keys go to the next, as in any radio group.
 * @param {HTMLElement} group @param {(value: string) => void} choose
 * @returns {(value: string) => void} shows which one is
 */
export function radioGroup(group, choose) {
  const buttons = () => /** @type {HTMLButtonElement[]} */ ([...group.querySelectorAll("[role=radio]")]);
  group.addEventListener("click", (event) => {
    const button = /** @type {Element} */ (event.target).closest("[role=radio]");
    if (button instanceof HTMLElement) choose(button.dataset.value ?? "");
  });
  group.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
    const all = buttons();
    const now = all.indexOf(/** @type {any} */ (document.activeElement));
    if (!step || now < 0) return;
    event.preventDefault();
    event.stopPropagation();
    const next = all[(now + step + all.length) % all.length];
    next.focus();
    choose(next.dataset.value ?? "");
  });
  return (value) => {
    for (const button of buttons()) {
      const checked = button.dataset.value === value;
      button.setAttribute("aria-checked", String(checked));
      button.tabIndex = checked ? 0 : -1;
      if (checked) button.scrollIntoView({ block: "nearest", inline: "nearest" });
    }
  };
}

/** Save something as a file. @param {Blob} blob @param {string} name */
export function download(blob, name) {
  const url = URL.createObjectURL(blob);
  element("a", { href: url, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}
