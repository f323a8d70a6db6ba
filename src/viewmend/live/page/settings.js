// User settings; dispatches "change".

/**
 * @typedef {object} Choices
 * @property {"rendered" | "holes" | "completed" | "split" | "depth" | "coverage" | "confidence" | "hull" | "points"} mode
 * @property {string} left mode on the divider's left, or one of `COMPARED`
 * @property {string} right mode on its right
 * @property {string} without names of cameras that are not used, separated by commas
 * @property {number} divider where it is, 0 to 1 of the free part's width
 * @property {number | null} topK
 * @property {string} errorRule what is completed; "" for what the server was started with
 * @property {number} side pixels of a square with as many pixels as the picture has, at most, while it moves
 * @property {string} size "" for the page's shape, or "WIDTHxHEIGHT"
 * @property {string} codec
 * @property {boolean} sharp whether a view at rest has as many pixels as the canvas
 * @property {boolean} adaptive whether a moving view may cost resolution
 * @property {boolean} reproject
 * @property {boolean} originals whether the original image is shown next to a view at a camera
 * @property {"dark" | "light"} theme
 * @property {string} background of the images, hexadecimal RGB; "" for the theme's or the model's
 * @property {string} modelGround background colour of the model, hexadecimal RGB; not stored
 * @property {"page" | "server"} render who draws moving views
 * @property {boolean} rig
 * @property {boolean} panel
 */

const DEFAULTS = {
  mode: "completed",
  without: "",
  left: "rendered",
  right: "completed",
  divider: 0.5,
  topK: null,
  errorRule: "",
  side: 640,
  size: "",
  codec: "jpeg",
  sharp: true,
  adaptive: true,
  reproject: true,
  originals: true,
  theme: "dark",
  background: "",
  modelGround: "000000",
  render: "page",
  rig: false,
  panel: window.innerHeight > 460,
};

const PICTURES = ["rendered", "holes", "completed", "depth", "coverage", "confidence", "hull", "points"];
/** What a split view shows besides: the view completed by another model, the image of the camera that the view is at, and the difference. */
export const COMPARED = /^(compared:[\w.-]+|original|error)$/;
/** The mode that the server knows, or the page's own. @param {string} value */
export const modeOf = (value) => value.split(":")[0];
/** Images that exist only at a camera; elsewhere, their side shows the completed view. */
export const AT_CAMERA = ["original", "error"];
/** What a choice may be, where not everything is one. @type {Record<string, (value: string) => boolean>} */
const SENSIBLE = {
  mode: (value) => value === "split" || PICTURES.includes(value),
  left: (value) => PICTURES.includes(value) || COMPARED.test(value),
  right: (value) => PICTURES.includes(value) || COMPARED.test(value),
  theme: (value) => value === "dark" || value === "light",
  modelGround: () => false,
  render: (value) => value === "page" || value === "server",
  background: (value) => /^([0-9a-f]{6})?$/.test(value),
  size: (value) => /^[1-9]\d*x[1-9]\d*$/.test(value),
};

/** Choices of a mode. */
const CHOOSING = ["mode", "left", "right"];
/** Storage key of the settings; those in the URL are not stored. */
const KEPT = "viewmend.settings";
const IN_ADDRESS = ["mode", "left", "right", "size", "without"];

/** What the person chose before, as texts by name. @returns {Record<string, string>} */
function kept() {
  try {
    return JSON.parse(localStorage.getItem(KEPT) ?? "{}") ?? {};
  } catch {
    return {}; // a browser that keeps nothing, or something of another page
  }
}

export class Settings extends EventTarget {
  /**
   * @param {URLSearchParams} query choices by name, e.g. `?mode=split&size=320x320&reproject=0`; they go before kept ones
   * @param {string[]} modes that can be shown
   * @param {boolean} live whether a server renders views, too; if not, choices are not kept, and the controls begin hidden
   */
  constructor(query, modes, live) {
    super();
    this.keeps = live;
    /** @type {any} */
    this.values = { ...DEFAULTS };
    if (!live) this.values.panel = false;
    const before = live ? kept() : {};
    for (const [name, standard] of Object.entries(DEFAULTS)) {
      const given = query.get(name) ?? before[name] ?? null;
      if (typeof given !== "string" || SENSIBLE[name]?.(given) === false) continue;
      if (CHOOSING.includes(name) && !modes.includes(given) && !(live && COMPARED.test(given))) continue;
      if (typeof standard === "boolean") this.values[name] = given !== "0";
      else if (typeof standard === "number" || name === "topK") this.values[name] = Number(given) || standard;
      else this.values[name] = given;
    }
  }

  /** @param {keyof Choices} name @returns {any} */
  get(name) {
    return this.values[name];
  }

  /** @param {keyof Choices} name @param {any} value @param {boolean} [own] whether the person chose it, for the next time too */
  set(name, value, own = true) {
    if (this.values[name] === value) return;
    this.values[name] = value;
    if (own && this.keeps && !IN_ADDRESS.includes(name)) this.#keep(name, value);
    this.dispatchEvent(new CustomEvent("change", { detail: name }));
  }

  /** @param {string} name @param {any} value */
  #keep(name, value) {
    const text = typeof value === "boolean" ? String(Number(value)) : String(value ?? "");
    try {
      localStorage.setItem(KEPT, JSON.stringify({ ...kept(), [name]: text }));
    } catch {
      // The browser keeps nothing: the choice holds until the page is closed.
    }
  }

  /** Background of the images. @returns {string} hexadecimal RGB */
  get ground() {
    const { background, modelGround, theme } = this.values;
    if (background) return background;
    if (modelGround !== "000000") return modelGround;
    return theme === "light" ? "f2f4f6" : "000000";
  }

  /** The modes that the server must render. @returns {string[]} */
  get modes() {
    return [...new Set(this.shown.map((value) => (AT_CAMERA.includes(value) ? "completed" : modeOf(value))))];
  }

  /** What is shown, from left to right. @returns {string[]} */
  get shown() {
    const { mode, left, right } = this.values;
    return mode === "split" ? [left, right] : [mode];
  }

  /** The other model that is shown; null for none. @returns {string | null} */
  get model() {
    return this.shown.find((value) => value.startsWith("compared:"))?.slice("compared:".length) ?? null;
  }

  /** Names of cameras that are not used. @returns {string[]} */
  get without() {
    return this.values.without.split(",").filter(Boolean);
  }

  /** Call now and on every change of one of `names`. @param {(keyof Choices)[]} names @param {() => void} react */
  watch(names, react) {
    this.addEventListener("change", (event) => {
      if (names.includes(/** @type {CustomEvent} */ (event).detail)) react();
    });
    react();
  }
}
