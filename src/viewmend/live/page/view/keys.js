// The keyboard: some keys move the view while they are held, the others act once.

/** An arrow key turns the view by this many degrees per second. */
const TURN_PER_S = 75;
/** A letter moves the view by this share of its distance per second. */
const WALK_PER_S = 0.7;
/** A zoom key multiplies the distance by e to the power of this per second. */
const ZOOM_PER_S = 1.1;
/** Longer times between two steps, in milliseconds, count as this long. */
const MAX_STEP_MS = 100;
/** The direction of each arrow key, to the right and down. */
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
/** The direction of each letter, to the right, down and forward. */
const WALK = {
  KeyA: [-1, 0, 0],
  KeyD: [1, 0, 0],
  KeyQ: [0, 1, 0],
  KeyE: [0, -1, 0],
  KeyW: [0, 0, 1],
  KeyS: [0, 0, -1],
};
/** The sign of each zoom character; 1 moves away. A "+" may need the shift key, a "=" on the same key not. */
const ZOOM = { "+": -1, "=": -1, "-": 1 };
/** The keys that move a slider. */
const SLIDER_KEYS = [...Object.keys(ARROWS), "Home", "End", "PageUp", "PageDown"];

/**
 * Whether the focused control uses a key itself: a field or a list uses all keys, a slider those that move
 * it, and a checkbox the space bar.
 * @param {KeyboardEvent} event
 */
function isUsedByControl({ target, code }) {
  if (!(target instanceof Element)) return false;
  if (target.matches("input[type=range], [role=slider]")) return SLIDER_KEYS.includes(code);
  if (target.matches("input[type=checkbox]")) return code === "Space";
  return target.matches("input, select, textarea");
}

export class Keys {
  /**
   * @param {import("./motion.js").Motion} motion
   * @param {Record<string, () => void>} actions by `KeyboardEvent.code`, or by `key` for characters
   * @param {() => void} wake
   */
  constructor(motion, actions, wake) {
    this.motion = motion;
    /**
     * The keys that are held, by their code: a zoom character, or the code.
     * @type {Map<string, string>}
     */
    this.held = new Map();
    this.shift = false;
    window.addEventListener("keydown", (event) => {
      // macOS does not report the release of other keys while the Command key is held
      if (event.metaKey) this.held.clear();
      if (event.metaKey || document.querySelector("dialog[open]") || isUsedByControl(event)) return;
      // a character counts wherever the keyboard has it, also where it needs AltGr
      const isCharacter = event.key in ZOOM || event.key in actions;
      const isTyped = isCharacter && event.getModifierState("AltGraph");
      if ((event.altKey || event.ctrlKey) && !isTyped) return;
      this.shift = event.shiftKey;
      const name = isCharacter ? event.key : event.code;
      const continuous = name in ARROWS || name in WALK || name in ZOOM;
      const pressesButton =
        event.target instanceof HTMLButtonElement && (event.code === "Space" || event.code === "Enter");
      const action = pressesButton ? undefined : actions[name];
      if (continuous) this.held.set(event.code, name);
      else if (action && !event.repeat) action();
      if (continuous || action) event.preventDefault();
      wake();
    });
    window.addEventListener("keyup", (event) => {
      this.shift = event.shiftKey;
      this.held.delete(event.code);
    });
    window.addEventListener("blur", () => this.held.clear());
  }

  /**
   * Move the view by the held keys.
   * @param {number} elapsedMs
   * @returns {boolean} whether anything is
   */
  step(elapsedMs) {
    const seconds = Math.min(elapsedMs, MAX_STEP_MS) / 1000;
    const { motion } = this;
    const reach = (motion.goal?.distance ?? 1) * WALK_PER_S * seconds;
    for (const name of this.held.values()) {
      if (name in ARROWS) {
        const [x, y] = /** @type {any} */ (ARROWS)[name];
        if (this.shift) motion.pan(x * reach, y * reach, 0);
        else motion.turn(-x * TURN_PER_S * seconds, -y * TURN_PER_S * seconds);
      } else if (name in WALK) {
        const [x, y, z] = /** @type {any} */ (WALK)[name];
        motion.pan(x * reach, y * reach, z * reach);
      } else {
        motion.zoom(Math.exp(/** @type {any} */ (ZOOM)[name] * ZOOM_PER_S * seconds));
      }
    }
    return this.held.size > 0;
  }
}
