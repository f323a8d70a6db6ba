"""The last picture follows the newest pose until the next one is there; stereo does the same for two eyes."""

import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import opened

pytestmark = pytest.mark.slow


def truth(look: dict, height: int, width: int) -> np.ndarray:
    """What a picture of this look would be on the page."""
    lens = look["camera"]
    x, y = width / look["width"], height / look["height"]
    scaled = {"fx": lens["fx"] * x, "fy": lens["fy"] * y, "cx": lens["cx"] * x, "cy": lens["cy"] * y}
    return scene.picture(*scene.render({**lens, **scaled}, width, height, 0), "completed").astype(int)


def wrong(shown: np.ndarray, expected: np.ndarray) -> float:
    """Share of the subject's pixels that are visibly off."""
    off = np.abs(shown - expected).max(-1) > 60
    return float(off.sum() / (expected.max(-1) > 0).sum())


def at_rest(view) -> float:
    """How wrong a picture is that was not turned: it has fewer pixels than the page."""
    shown = view.picture()
    return wrong(shown, truth(view.server.looks[-1], *shown.shape[:2]))


def held(view, dx: int, dy: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Move while the server sends nothing: the picture before, the one that is shown now, and the truth."""
    before = view.picture()
    view.server.hold = True
    view.drag(dx, dy)
    view.page.wait_for_timeout(600)
    shown = view.picture()
    return before, shown, truth(view.server.looks[-1], *shown.shape[:2])


def test_the_last_picture_is_seen_from_the_new_pose(view):
    least = at_rest(view)
    before, shown, expected = held(view, 40, 15)
    assert wrong(before, expected) > 0.25
    assert wrong(shown, expected) < least + 0.05


def test_with_the_switch_off_it_stays_until_the_next_one(view):
    view.tab("view")
    view.page.locator("#reproject").set_checked(False)
    view.settle()
    before, shown, _ = held(view, 40)
    assert np.abs(before - shown).mean() < 0.5
    view.server.hold = False
    view.settle()
    assert np.abs(before - view.picture()).mean() > 1
    assert view.server.looks[-1]["depth"] is False


def test_zoom_and_pan_are_followed_too(desktop):
    least = at_rest(desktop)
    desktop.server.hold = True
    desktop.page.mouse.move(*desktop.middle())
    desktop.page.mouse.wheel(0, -150)
    desktop.drag(60, 30, button="right")
    desktop.page.wait_for_timeout(600)
    shown = desktop.picture()
    assert wrong(shown, truth(desktop.server.looks[-1], *shown.shape[:2])) < least + 0.05


def test_what_was_hidden_is_dim_and_not_torn(desktop):
    """A large turn: seen surfaces keep their colours, what lies between is darker, nothing is drawn twice."""
    _, shown, expected = held(desktop, 160)
    inside = expected.max(-1) > 0
    assert (shown[inside].max(-1) > 25).mean() > 0.6
    assert (shown[~inside].max(-1) > 60).mean() < 0.03


HEADSET = """
(() => {
  const eye = x => ({
    transform: {matrix: [1,0,0,0, 0,1,0,0, 0,0,1,0, x,1.5,0,1]},
    projectionMatrix: [1,0,0,0, 0,1,0,0, 0,0,-1.001,-1, 0,0,-0.1,0],
  });
  const views = [eye(-0.03), eye(0.03)];
  const session = new class extends EventTarget {
    async updateRenderState() {}
    async requestReferenceSpace() { return {}; }
    requestAnimationFrame(paint) { this.timer = setTimeout(() => paint(0, {getViewerPose: () => ({views})}), 30); }
    async end() { clearTimeout(this.timer); this.dispatchEvent(new Event('end')); }
  };
  const xr = {isSessionSupported: async () => true, requestSession: async () => session};
  Object.defineProperty(navigator, 'xr', {value: xr});
  window.endSession = () => session.end();
  WebGL2RenderingContext.prototype.makeXRCompatible = async () => {};
  window.XRWebGLLayer = class {
    framebuffer = null;
    getViewport(view) { return {x: view === views[0] ? 0 : 640, y: 0, width: 640, height: 640}; }
  };
})()
"""


def test_a_headset_gets_two_eyes_of_one_state(browser, server):
    with opened(browser, server, query="", script=HEADSET) as view:
        view.page.wait_for_selector("#picture[data-frame]")
        view.page.get_by_role("button", name="Enter VR").click()
        view.until(lambda: "eyes" in server.looks[-1])
        look = server.looks[-1]
        assert look["depth"] is True
        left, right = (np.array(e["R"]).reshape(3, 3).T @ -np.array(e["T"]) for e in look["eyes"])
        R = np.reshape(look["eyes"][0]["R"], (3, 3))
        np.testing.assert_allclose(right - left, 0.06 * R[0], atol=1e-6)
        np.testing.assert_allclose(left[1], 1.5, atol=1e-6)  # above the floor of the subject's box
        np.testing.assert_allclose(R[1], [0, -1, 0], atol=1e-6)
        assert R[2] @ (scene.CENTER - left) > 2  # it looks at the subject
        assert look["eyes"][0]["fx"] == look["width"] / 2
        view.page.evaluate("endSession()")
        view.until(lambda: "camera" in server.looks[-1])


def test_a_session_that_ends_while_it_starts_leaves_the_page_as_it_was(browser, server):
    ends = "WebGL2RenderingContext.prototype.makeXRCompatible = async () => { window.endSession(); };"
    with opened(browser, server, script=HEADSET + ends) as view:
        view.settle()
        view.page.get_by_role("button", name="Enter VR").click()
        view.page.wait_for_timeout(300)
        count = len(server.looks)
        view.drag(60, 0)
        view.until(lambda: len(server.looks) > count and "camera" in server.looks[-1], 20)


def test_without_a_headset_there_is_no_button(desktop):
    assert desktop.page.locator("#tool-headset").is_hidden()


def test_where_the_processor_draws_some_refreshes_are_left_out(desktop):
    counts = desktop.page.evaluate(
        "import('/page/draw/resolution.js').then(({ RepaintLimiter }) => [false, true].map((software) => {"
        "  const limiter = new RepaintLimiter(software);"
        "  return Array.from({ length: 60 }, (_, n) => limiter.due((1000 / 60) * n)).filter(Boolean).length; }))"
    )
    assert counts[0] == 60
    assert 38 <= counts[1] <= 41
