// Mouse and touch on the canvas: one finger or the left button turns, two fingers or the right one pan, wheel and pinch zoom.

/** Degrees for a drag over the picture's height. */
const TURN = 200;

/** @param {number} delta @param {number} mode of a WheelEvent */
const wheelPixels = (delta, mode) => delta * (mode === 1 ? 16 : mode === 2 ? 400 : 1);

/**
 * @param {HTMLElement} surface
 * @param {import("./motion.js").Motion} motion
 * @param {() => number} focal of the lens, CSS pixels
 * @param {() => void} wake call it when something moved
 * @param {(x: number, y: number) => void} focus turn about what is there, CSS pixels
 */
export function listenToGestures(surface, motion, focal, wake, focus) {
  /** @type {Map<number, {x: number, y: number}>} */
  const pointers = new Map();
  let button = 0;

  const pan = (/** @type {number} */ dx, /** @type {number} */ dy) => {
    const metres = (motion.goal?.distance ?? 1) / focal();
    motion.shift(-dx * metres, -dy * metres, 0);
  };
  const turn = (/** @type {number} */ dx, /** @type {number} */ dy) => {
    const degrees = motion.mode === "fly" ? (180 / Math.PI) / focal() : TURN / surface.clientHeight;
    motion.turn(dx * degrees, dy * degrees);
  };
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, width: Math.hypot(a.x - b.x, a.y - b.y) };
  };

  surface.addEventListener("pointerdown", (event) => {
    surface.setPointerCapture(event.pointerId);
    surface.focus({ preventScroll: true });
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    button = event.button;
    surface.dataset.held = "";
  });
  surface.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    if (pointers.size === 2) {
      const before = spread();
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      const after = spread();
      pan(after.x - before.x, after.y - before.y);
      if (after.width > 0) motion.zoom(before.width / after.width);
    } else {
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (pointers.size > 2) return;
      if (button !== 0 || event.shiftKey || event.ctrlKey) pan(dx, dy);
      else turn(dx, dy);
    }
    wake();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    surface.addEventListener(name, (event) => {
      pointers.delete(/** @type {PointerEvent} */ (event).pointerId);
      if (!pointers.size) delete surface.dataset.held;
    });
  }
  surface.addEventListener("dblclick", (event) => focus(event.clientX, event.clientY));
  surface.addEventListener("contextmenu", (event) => event.preventDefault());
  surface.addEventListener(
    "wheel",
    (event) => {
      // In another site's page the wheel scrolls that page, until the view was touched.
      if (window.top !== window && document.activeElement !== surface) return;
      event.preventDefault();
      motion.zoom(Math.exp(wheelPixels(event.deltaY, event.deltaMode) * (event.ctrlKey ? 0.01 : 0.0012)));
      wake();
    },
    { passive: false },
  );
}
