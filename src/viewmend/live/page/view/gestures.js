// Mouse and touch on the canvas: one finger or the left button turns the view, two fingers or the right
// button move it, and the wheel and pinching zoom.

/** A drag over the whole height turns the view by this angle, in degrees. */
const DEGREES_PER_HEIGHT = 200;
/** A pixel of the wheel multiplies the distance by e to the power of this. */
const ZOOM_PER_PIXEL = 0.0012;
/** The same for pinching on a touchpad, which browsers report as a wheel with the control key. */
const PINCH_PER_PIXEL = 0.01;
/** The pixels of a WheelEvent's unit, by its `deltaMode`: pixels, lines and pages. */
const PIXELS_PER_UNIT = [1, 16, 400];

/**
 * Move the view by mouse and touch.
 * @param {HTMLElement} surface
 * @param {import("./motion.js").Motion} motion
 * @param {() => number} focal of the lens, CSS pixels
 * @param {() => void} wake called when something has moved
 * @param {(x: number, y: number) => void} focus makes the surface at a position the target, CSS pixels
 */
export function listenToGestures(surface, motion, focal, wake, focus) {
  /** @type {Map<number, {x: number, y: number}>} */
  const pointers = new Map();
  let button = 0;

  const pan = (/** @type {number} */ dx, /** @type {number} */ dy) => {
    const metres = (motion.goal?.distance ?? 1) / focal();
    motion.pan(-dx * metres, -dy * metres, 0);
  };
  const turn = (/** @type {number} */ dx, /** @type {number} */ dy) => {
    const degreesPerPixel =
      motion.mode === "fly" ? 180 / Math.PI / focal() : DEGREES_PER_HEIGHT / surface.clientHeight;
    motion.turn(dx * degreesPerPixel, dy * degreesPerPixel);
  };
  /** Measure the middle and the distance of two fingers. */
  const measurePinch = () => {
    const [a, b] = pointers.values();
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
    const dx = event.clientX - last.x;
    const dy = event.clientY - last.y;
    if (pointers.size === 2) {
      const before = measurePinch();
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      const after = measurePinch();
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
      // on another site's page, the wheel scrolls that page until the view was touched
      if (window.top !== window && document.activeElement !== surface) return;
      event.preventDefault();
      const pixels = event.deltaY * (PIXELS_PER_UNIT[event.deltaMode] ?? 1);
      motion.zoom(Math.exp(pixels * (event.ctrlKey ? PINCH_PER_PIXEL : ZOOM_PER_PIXEL)));
      wake();
    },
    { passive: false },
  );
}
