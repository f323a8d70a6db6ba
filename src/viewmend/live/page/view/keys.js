// The keyboard: keys that are held move the view, the others act once.

/** Degrees a second of a held arrow key, and shares of the distance a second of a held letter. */
const [TURN_PER_S, WALK_PER_S, ZOOM_PER_S] = [75, 0.7, 1.1];

const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const WALK = { KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyQ: [0, 1, 0], KeyE: [0, -1, 0], KeyW: [0, 0, 1], KeyS: [0, 0, -1] };
const ZOOM = { Equal: -1, NumpadAdd: -1, Minus: 1, NumpadSubtract: 1 };

/** Keys that a control there has a use for: all in a field or a list, those that move a slider, those that press a switch. */
const SLIDER_KEYS = [...Object.keys(ARROWS), "Home", "End", "PageUp", "PageDown"];

/** @param {KeyboardEvent} event whether its key belongs to a control there */
function takesKey({ target, code }) {
  if (!(target instanceof Element)) return false;
  if (target.matches("input[type=range], [role=slider]")) return SLIDER_KEYS.includes(code);
  if (target.matches("input[type=checkbox]")) return code === "Space";
  return target.matches("input, select, textarea");
}

export class Keys {
  /**
   * @param {import("./motion.js").Motion} motion
   * @param {Record<string, () => void>} actions by `KeyboardEvent.code`, or by `key` for signs
   * @param {() => void} wake
   */
  constructor(motion, actions, wake) {
    this.motion = motion;
    /** @type {Set<string>} */
    this.held = new Set();
    this.shift = false;
    window.addEventListener("keydown", (event) => {
      if (event.altKey || event.ctrlKey || event.metaKey || document.querySelector("dialog[open]")) return;
      if (takesKey(event)) return;
      this.shift = event.shiftKey;
      const continuous = event.code in ARROWS || event.code in WALK || event.code in ZOOM;
      const button = event.target instanceof HTMLButtonElement && (event.code === "Space" || event.code === "Enter");
      const action = button ? undefined : actions[event.key] ?? actions[event.code];
      if (continuous) this.held.add(event.code);
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

  /** Move by what is held. @param {number} elapsedMs @returns {boolean} whether anything is */
  step(elapsedMs) {
    const seconds = Math.min(elapsedMs, 100) / 1000;
    const { motion } = this;
    const reach = (motion.goal?.distance ?? 1) * WALK_PER_S * seconds;
    for (const code of this.held) {
      if (code in ARROWS) {
        const [x, y] = /** @type {any} */ (ARROWS)[code];
        if (this.shift) motion.shift(x * reach, y * reach, 0);
        else motion.turn(-x * TURN_PER_S * seconds, -y * TURN_PER_S * seconds);
      } else if (code in WALK) {
        const [x, y, z] = /** @type {any} */ (WALK)[code];
        motion.shift(x * reach, y * reach, z * reach);
      } else {
        motion.zoom(Math.exp(/** @type {any} */ (ZOOM)[code] * ZOOM_PER_S * seconds));
      }
    }
    return this.held.size > 0;
  }
}
