"""What the page says and does when something is slow, missing or broken."""

import re
from dataclasses import replace

import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import opened

pytestmark = pytest.mark.slow


FILL_TWICE = """async () => {
  const { HoleFill } = await import('/page/draw/fill.js');
  const gl = new OffscreenCanvas(64, 64).getContext('webgl2');
  const fill = new HoleFill(gl);
  gl.clearColor(1, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT);
  for (const height of [0, 64]) {
    const lens = { fx: 64, fy: 64, cx: 32, cy: 32, width: 64, height };
    const viewer = { R: [1, 0, 0, 0, 1, 0, 0, 0, 1], T: [0, 0, 4], lens };
    fill.draw([[-1, -1, -1], [1, 1, 1]], viewer, [0, 0, 64, height], [0, 0, 0]);
  }
  const pixel = new Uint8Array(4);
  gl.readPixels(32, 32, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  return [...pixel];
}"""
"""Fills the holes of a page without height, then those of a canvas that is one red hole; returns its colour."""
NOTE_COMPLETED = """async (count) => {
  const { Assets } = await import('/page/link/assets.js');
  const assets = new Assets(() => '');
  for (let time = 0; time < count; time++) {
    for (const again of [time, 9000]) assets.addCompleted({ time: again, without: [], cameras: [], mesh: true });
  }
  return [...assets.completed.keys()];
}"""
"""Takes the messages of a live rig whose frames were completed in advance; returns what it remembers."""
LOSE_GPU = (
    "(async () => { const gl = document.querySelector('#picture').getContext('webgl2');"
    " const e = gl.getExtension('WEBGL_lose_context'); e.loseContext();"
    " await new Promise(r => setTimeout(r, 200)); e.restoreContext(); })()"
)
TRY_AGAIN = (
    "(() => { const button = document.querySelector('#cover-retry');"
    " if (!button.checkVisibility()) return false;"
    " button.click();"
    " return document.querySelector('#cover-title').textContent === 'Connecting'; })()"
)
"""In one step, as there is no button while the page tries; true if it tries at once."""
REQUEST_AND_WAIT = (
    "setTimeout(() => { const request = new XMLHttpRequest();"
    " request.open('GET', 'unanswered', false); request.send(); })"
)
"""Stops the page's thread until the request is answered."""

# A reload may take milliseconds and no request: the browser has the image already.
COUNT_ORIGINALS = (
    "window.originals = 0;"
    " document.querySelector('#original-image').addEventListener('load', () => window.originals++)"
)


def cover(view) -> str:
    return view.page.locator("#cover").inner_text() if view.page.locator("#cover").is_visible() else ""


def test_loading_is_said_until_the_first_picture(browser, server):
    server.hold, server.source = True, "loading"
    with opened(browser, server, "phone") as view:
        view.until(lambda: "Loading" in cover(view))
        server.source = "ready"
        view.until(lambda: "Rendering" in cover(view))
        server.hold = False
        view.until(lambda: cover(view) == "")


def test_a_lost_connection_comes_back_with_view_and_time(desktop):
    desktop.page.locator("#seek").fill("9")
    desktop.drag(90, 0)
    desktop.settle()
    before, camera = desktop.picture(), desktop.server.looks[-1]["camera"]
    count = len(desktop.server.hellos)
    desktop.page.locator("#cameras button").first.focus()
    desktop.server.drop()
    desktop.until(lambda: len(desktop.server.hellos) > count)
    desktop.settle()
    assert desktop.page.evaluate("document.activeElement.textContent") == "cam00"
    assert desktop.server.looks[-1]["camera"] == camera
    assert desktop.data("time") == "9"
    assert np.abs(desktop.picture() - before).mean() < 1
    assert cover(desktop) == ""


def test_a_connection_that_broke_without_a_close_is_restored(browser, server):
    worker = server.files["link/worker.js"]
    impatient = worker.content.replace(b"PING_MS = 5000", b"PING_MS = 300")
    server.files["link/worker.js"] = replace(worker, content=impatient)
    with opened(browser, server) as view:
        view.until(lambda: server.looks)
        for viewer in server.viewers:
            viewer.silent = True
        view.until(lambda: any(viewer.look and not viewer.silent for viewer in list(server.viewers)))


def test_a_page_that_repaints_slowly_gets_no_more_pictures_than_it_takes(browser, server):
    server.playing = True
    with opened(browser, server, query="?mode=depth") as view:
        view.until(lambda: server.viewers and server.viewers[-1].sent > 3)
        viewer, unanswered = server.viewers[-1], []
        view.page.route("**/unanswered", lambda route: unanswered.append(route))
        view.page.evaluate(REQUEST_AND_WAIT)
        view.until(lambda: unanswered)
        before = viewer.sent
        view.page.wait_for_timeout(3000)
        assert viewer.sent <= before + 3, (
            "one that the page had not taken, one that waits, and one on its way"
        )
        unanswered[0].fulfill()
        view.until(lambda: viewer.sent > before + 6)


def test_who_comes_back_while_a_try_is_due_has_one_connection(desktop):
    look_away = "Object.defineProperty(document, 'hidden', {{value: {}, configurable: true}});"
    look_away += "document.dispatchEvent(new Event('visibilitychange'))"
    desktop.server.refuse = 4503
    desktop.server.drop()
    desktop.until(lambda: "Retrying in 4" in cover(desktop), 20)
    desktop.server.refuse = None
    count = len(desktop.server.hellos)
    for hidden in ("true", "false"):
        desktop.page.evaluate(look_away.format(hidden))
    desktop.until(lambda: len(desktop.server.hellos) > count)
    desktop.page.wait_for_timeout(5000)
    assert len(desktop.server.hellos) == count + 1


def test_while_it_is_lost_there_is_a_button(desktop):
    desktop.server.refuse = 4503
    desktop.server.drop()
    said = r"The maximum number of viewers is reached\.\s+Retrying in"
    desktop.until(lambda: re.search(said, cover(desktop)))
    desktop.page.locator("#cover-retry").click()  # there is one again after each try
    desktop.until(TRY_AGAIN)
    desktop.server.refuse = None
    desktop.until(lambda: not cover(desktop))


@pytest.mark.parametrize(("code", "words"), [(4401, "needs a token"), (4426, "Reload the page")])
def test_a_final_refusal_says_what_to_do(browser, server, code, words):
    server.refuse = code
    with opened(browser, server, "phone") as view:
        view.until(lambda: words in cover(view))
        view.page.wait_for_timeout(700)
        assert not server.viewers


def test_the_token_of_the_address_is_passed_on(browser, server):
    asked = []
    with opened(browser, server, "desktop", "?token=a%20b") as view:
        view.settle()
        view.page.on("request", lambda request: asked.append(request.url))
        for _ in range(2):
            view.page.get_by_role("button", name="Add view").click()
        with view.page.expect_download(timeout=60_000):
            view.page.get_by_role("button", name="Export MP4").click()
        assert any(url.endswith("/path.mp4?token=a+b") for url in asked)


def test_a_failing_source_and_model_are_said_beside_the_picture(desktop):
    pill = desktop.page.locator("#pill")
    desktop.server.source, desktop.server.error = "failing", "camera cam01 is gone"
    desktop.until(lambda: pill.is_visible() and "Source error" in pill.inner_text())
    assert pill.get_attribute("title") == "camera cam01 is gone"
    desktop.server.source, desktop.server.model_error = "ready", "out of memory"
    desktop.until(lambda: "Model failed; showing the rendered view" in pill.inner_text())
    desktop.server.model_error = None
    desktop.until(pill.is_hidden)


def test_a_stall_is_said(desktop):
    desktop.server.hold = True
    desktop.drag(60, 0)
    desktop.until(desktop.page.locator("#pill").is_visible)
    assert "Waiting for the server" in desktop.page.locator("#pill").inner_text()
    desktop.server.hold = False
    desktop.until(desktop.page.locator("#pill").is_hidden)


def test_broken_pictures_do_not_stop_the_page(desktop):
    desktop.server.broken = True
    desktop.drag(60, 0)
    desktop.until(lambda: "An image could not be decoded" in desktop.page.locator("#toasts").inner_text())
    desktop.server.broken = False
    desktop.drag(60, 0)
    desktop.settle()


def test_broken_video_falls_back_to_jpeg(desktop):
    if "vp9" not in desktop.server.hellos[0]["codecs"]:
        pytest.skip("this Chromium has no VP9")
    desktop.server.broken = True
    desktop.page.locator("#codec").select_option("vp9")
    desktop.until(lambda: desktop.server.looks[-1]["codec"] == "jpeg")
    desktop.server.broken = False
    desktop.drag(60, 0)
    desktop.settle()


def test_who_wants_no_motion_gets_none(browser, server):
    with opened(browser, server, reduced_motion="reduce") as view:
        view.settle()
        count = len(server.looks)
        view.page.locator("#cameras").get_by_role("button", name="cam03").click()
        view.settle()
        poses = {tuple(look["camera"]["R"]) for look in server.looks[count:]}
        assert len(poses) == 1


def test_a_lost_gpu_comes_back(desktop):
    before = desktop.picture()
    desktop.page.evaluate(LOSE_GPU)
    desktop.page.wait_for_timeout(500)
    desktop.drag(40, 0)
    desktop.page.get_by_role("button", name="Reset the view").click()
    desktop.settle()
    assert np.abs(desktop.picture() - before).mean() < 2
    desktop.errors.clear()


def test_a_lost_gpu_comes_back_with_the_original(browser, server):
    with opened(browser, server, query="?sharp=0&mode=split&left=completed&right=original") as view:
        view.settle()
        view.page.locator("#cameras").get_by_role("button", name="cam03").click()
        name = view.page.locator("#right-name")
        view.until(lambda: name.inner_text() == "Original", 60)
        view.settle()
        before = view.picture()
        view.page.evaluate(COUNT_ORIGINALS)
        view.page.evaluate(LOSE_GPU)
        view.until("window.originals > 0", 20)
        view.settle()
        view.until(lambda: name.inner_text() == "Original", 20)
        assert np.abs(view.picture() - before).mean() < 2
        view.errors.clear()


def test_holes_are_filled_after_the_page_had_no_height(desktop):
    assert desktop.page.evaluate(FILL_TWICE) == [255, 0, 0, 255]


def test_of_a_rig_that_goes_on_for_hours_the_page_remembers_the_newest_frames(browser, server):
    page = browser.new_page()
    page.goto(f"{server.url}page/link/assets.js")
    names = page.evaluate(NOTE_COMPLETED, 5000)
    page.close()
    assert names == [*map(str, range(5000 - len(names) + 1, 5000)), "9000"]
    assert 64 < len(names) < 2000


def test_a_key_that_is_released_while_the_command_key_is_held_does_not_move_the_view_on(desktop):
    # macOS reports no release of w here
    keyboard = desktop.page.keyboard
    keyboard.down("w")
    desktop.until(lambda: desktop.server.looks[-1]["moving"], 20)
    keyboard.down("Meta")
    keyboard.up("Meta")
    desktop.until(lambda: not desktop.server.looks[-1]["moving"], 20)


def test_cameras_of_an_earlier_rig_are_forgotten(desktop, monkeypatch):
    desktop.page.locator("#cameras").get_by_role("button", name="cam03").click()
    desktop.settle()
    desktop.page.keyboard.press("x")
    desktop.until(lambda: desktop.server.looks[-1]["without"] == ["cam03"], 20)
    rig = scene.rig()
    for camera in rig["cameras"]:
        camera["name"] = camera["name"].replace("cam", "north")
    count = len(desktop.server.looks)
    monkeypatch.setattr(scene, "rig", lambda: rig)
    desktop.server.drop()
    looks = desktop.server.looks
    desktop.until(lambda: len(looks) > count and looks[-1]["without"] == [], 20)
    assert desktop.page.locator("#input-row").is_hidden()
    desktop.until(lambda: "without" not in desktop.page.url, 20)
    desktop.errors.clear()  # the score of cam03, which was requested before the new rig arrived


def test_a_link_to_a_frame_of_an_earlier_live_run_does_not_pause_at_a_later_one(browser, server, monkeypatch):
    state = server._state
    live = {"kind": "live", "total": None, "loops": False, "end": 5}
    monkeypatch.setattr(server, "_state", lambda viewer: state(viewer) | live)
    server.playing = True
    with opened(browser, server, query="?sharp=0&time=20") as view:
        for end in (5, 25):
            live["end"] = end
            view.until(f"document.querySelector('#seek').max === '{end - 1}'", 60)
        view.page.wait_for_timeout(300)
        assert not server.clocks
