// What the person has chosen. Whoever wants to know of a change listens for "change".

/**
 * @typedef {object} Choices
 * @property {"rendered" | "holes" | "mended" | "split" | "depth" | "coverage" | "confidence"} mode
 * @property {string} left mode on the divider's left
 * @property {string} right mode on its right
 * @property {number} divider where it is, 0 to 1 of the free part's width
 * @property {number | null} topK
 * @property {string} errorRule what is mended; "" for what the server was started with
 * @property {number} side pixels of a square with as many pixels as the picture
 * @property {string} size "" for the page's shape, or "WIDTHxHEIGHT"
 * @property {string} codec
 * @property {boolean} adaptive whether a moving view may cost resolution
 * @property {boolean} reproject
 * @property {boolean} rig
 * @property {boolean} panel
 */

const DEFAULTS = {
  mode: "mended",
  left: "rendered",
  right: "mended",
  divider: 0.5,
  topK: null,
  errorRule: "",
  side: 384,
  size: "",
  codec: "jpeg",
  adaptive: true,
  reproject: true,
  rig: false,
  panel: window.innerHeight > 460,
};

const PICTURES = ["rendered", "holes", "mended", "depth", "coverage", "confidence"];
/** What a choice may be, where not everything is one. @type {Record<string, (value: string) => boolean>} */
const SENSIBLE = {
  mode: (value) => value === "split" || PICTURES.includes(value),
  left: (value) => PICTURES.includes(value),
  right: (value) => PICTURES.includes(value),
  size: (value) => /^[1-9]\d*x[1-9]\d*$/.test(value),
};

export class Settings extends EventTarget {
  /** @param {URLSearchParams} query choices by name, e.g. `?mode=split&size=320x320&reproject=0` */
  constructor(query) {
    super();
    /** @type {any} */
    this.values = { ...DEFAULTS };
    for (const [name, standard] of Object.entries(DEFAULTS)) {
      const given = query.get(name);
      if (given === null || SENSIBLE[name]?.(given) === false) continue;
      if (typeof standard === "boolean") this.values[name] = given !== "0";
      else if (typeof standard === "number" || name === "topK") this.values[name] = Number(given) || standard;
      else this.values[name] = given;
    }
  }

  /** @param {keyof Choices} name @returns {any} */
  get(name) {
    return this.values[name];
  }

  /** @param {keyof Choices} name @param {any} value */
  set(name, value) {
    if (this.values[name] === value) return;
    this.values[name] = value;
    this.dispatchEvent(new CustomEvent("change", { detail: name }));
  }

  /** The modes that the server must render. @returns {string[]} */
  get modes() {
    if (this.values.mode !== "split") return [this.values.mode];
    const { left, right } = this.values;
    return left === right ? [left] : [left, right];
  }

  /** Call now and on every change of one of `names`. @param {(keyof Choices)[]} names @param {() => void} react */
  watch(names, react) {
    this.addEventListener("change", (event) => {
      if (names.includes(/** @type {CustomEvent} */ (event).detail)) react();
    });
    react();
  }
}
