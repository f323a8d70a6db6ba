// User settings, from the URL, the browser's storage and the defaults.

/**
 * @typedef {"rendered" | "holes" | "completed" | "split" | "depth" | "coverage" | "confidence" | "hull"
 *   | "points"} Mode
 */

/**
 * @typedef {object} Choices
 * @property {Mode} mode what is shown
 * @property {string} left mode on the left of the divider, or a value that matches `COMPARED`
 * @property {string} right mode on the right of the divider
 * @property {string} without names of cameras that are not used, separated by commas
 * @property {number} divider its position as a share of the free part's width, 0 to 1
 * @property {number | null} topK patches that the model reads; null for all
 * @property {string} errorRule which pixels are completed; "" for the rule that the server was started with
 * @property {number} side a moving view has at most as many pixels as a square of this side
 * @property {string} size "" for the page's shape, or "WIDTHxHEIGHT"
 * @property {string} codec of the server's images
 * @property {boolean} sharp whether a view at rest has as many pixels as the canvas
 * @property {boolean} adaptive whether a moving view may cost resolution
 * @property {boolean} reproject whether the last image is reprojected to the newest pose
 * @property {boolean} originals whether the original image is shown next to a view at a camera
 * @property {"dark" | "light"} theme
 * @property {string} background of the images, hexadecimal RGB; "" for the theme's or the model's
 * @property {string} modelGround background colour of the model, hexadecimal RGB; not stored
 * @property {"page" | "server"} render what draws moving views
 * @property {boolean} rig whether the cameras are shown
 * @property {boolean} panel whether the controls are shown
 */

/** The value of each setting that neither the URL nor the storage names. */
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

/** The modes that show one view. */
const VIEW_MODES = ["rendered", "holes", "completed", "depth", "coverage", "confidence", "hull", "points"];
/**
 * What only a split view can show: the view completed by another model, the image of the
 * camera that the view is at, and the difference between the view and that image.
 */
const COMPARED = /^(compared:[\w.-]+|original|error)$/;
/** Images that exist only at a camera; elsewhere, their side shows the completed view. */
const CAMERA_ONLY_MODES = ["original", "error"];
/**
 * Tests of the values of settings that do not accept every text.
 * @type {Record<string, (value: string) => boolean>}
 */
const VALIDATORS = {
  mode: (value) => value === "split" || VIEW_MODES.includes(value),
  left: (value) => VIEW_MODES.includes(value) || COMPARED.test(value),
  right: (value) => VIEW_MODES.includes(value) || COMPARED.test(value),
  theme: (value) => value === "dark" || value === "light",
  modelGround: () => false,
  render: (value) => value === "page" || value === "server",
  background: (value) => /^([0-9a-f]{6})?$/.test(value),
  size: (value) => /^[1-9]\d*x[1-9]\d*$/.test(value),
};
/** Settings whose value is a mode. */
const MODE_SETTINGS = ["mode", "left", "right"];
/** Settings that are part of the URL, and therefore not stored. */
const URL_SETTINGS = ["mode", "left", "right", "size", "without"];
/** The settings are stored in the browser under this key. */
const STORAGE_KEY = "viewmend.settings";

/** Remove the name of the model from a mode such as "compared:paper". @param {string} value */
export const parseMode = (value) => value.split(":")[0];

/** Whether a mode's image exists only at a camera. @param {string} mode */
export const isCameraOnly = (mode) => CAMERA_ONLY_MODES.includes(mode);

/** Read the stored settings, as texts by name. @returns {Record<string, string>} */
function readStored() {
  try {
    return JSON.parse(localStorage.getItem(STORAGE_KEY) ?? "{}") ?? {};
  } catch {
    return {}; // the browser stores nothing, or another page stored something else
  }
}

/** Holds the settings and dispatches "change", with the name of the setting as detail. */
export class Settings extends EventTarget {
  /**
   * @param {URLSearchParams} query settings by name, e.g. `?mode=split&size=320x320&reproject=0`; they take
   *   precedence over stored ones
   * @param {string[]} modes that can be shown
   * @param {boolean} live whether a server renders views, too; if not, settings are not stored, and the
   *   controls are hidden at first
   */
  constructor(query, modes, live) {
    super();
    this.modes = modes;
    this.stored = live;
    /** @type {any} */
    this.values = { ...DEFAULTS };
    if (!live) this.values.panel = false;
    const stored = live ? readStored() : {};
    for (const [name, standard] of Object.entries(DEFAULTS)) {
      const text = query.get(name) ?? stored[name] ?? null;
      if (typeof text !== "string" || VALIDATORS[name]?.(text) === false) continue;
      if (MODE_SETTINGS.includes(name) && !modes.includes(text) && !(live && COMPARED.test(text))) continue;
      if (typeof standard === "boolean") this.values[name] = text !== "0";
      else if (typeof standard === "number" || name === "topK") this.values[name] = Number(text) || standard;
      else this.values[name] = text;
    }
  }

  /** Take the settings that are part of the URL from a link. @param {URLSearchParams} query */
  readUrl(query) {
    const linked = new Settings(query, this.modes, this.stored);
    for (const name of URL_SETTINGS) this.set(/** @type {keyof Choices} */ (name), linked.get(name));
  }

  /** @param {keyof Choices} name @returns {any} */
  get(name) {
    return this.values[name];
  }

  /**
   * @param {keyof Choices} name
   * @param {any} value
   * @param {boolean} [own] whether the user chose it, so that it is stored
   */
  set(name, value, own = true) {
    if (this.values[name] === value) return;
    this.values[name] = value;
    if (own && this.stored && !URL_SETTINGS.includes(name)) this.#store(name, value);
    this.dispatchEvent(new CustomEvent("change", { detail: name }));
  }

  /** @param {string} name @param {any} value */
  #store(name, value) {
    const text = typeof value === "boolean" ? String(Number(value)) : String(value ?? "");
    try {
      localStorage.setItem(STORAGE_KEY, JSON.stringify({ ...readStored(), [name]: text }));
    } catch {
      // the browser stores nothing: the choice holds until the page is closed
    }
  }

  /** Background of the images. @returns {string} hexadecimal RGB */
  get backgroundColour() {
    const { background, modelGround, theme } = this.values;
    if (background) return background;
    if (modelGround !== "000000") return modelGround;
    return theme === "light" ? "f2f4f6" : "000000";
  }

  /** The modes that the server must render. @returns {string[]} */
  get renderedModes() {
    const modes = this.shownModes.map((value) => (isCameraOnly(value) ? "completed" : parseMode(value)));
    return [...new Set(modes)];
  }

  /** The modes that are shown, from left to right. @returns {string[]} */
  get shownModes() {
    const { mode, left, right } = this.values;
    return mode === "split" ? [left, right] : [mode];
  }

  /** The other model whose view is shown; null for none. @returns {string | null} */
  get comparedModel() {
    return this.shownModes.find((value) => value.startsWith("compared:"))?.slice("compared:".length) ?? null;
  }

  /** Names of cameras that are not used. @returns {string[]} */
  get excludedCameras() {
    return this.values.without.split(",").filter(Boolean);
  }

  /**
   * Call now and on every change of one of `names`.
   * @param {(keyof Choices)[]} names
   * @param {() => void} react
   */
  watch(names, react) {
    this.addEventListener("change", (event) => {
      if (names.includes(/** @type {CustomEvent} */ (event).detail)) react();
    });
    react();
  }
}
