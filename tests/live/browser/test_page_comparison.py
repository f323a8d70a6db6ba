"""Models are compared, and cameras left out, while one looks: split view, original, error map and score."""

import re
from collections import Counter
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from live.browser.conftest import SCREENSHOT_S, opened
from live.browser.test_page_completed_ahead import Green
from live.browser.test_page_drawing import silent
from live.live_servers import CAMERAS, PIPELINE, get, running
from reference.ball import BallCapture

from viewmend import serve
from viewmend.models.smooth_fill import SmoothFill

pytestmark = pytest.mark.slow

NAME = CAMERAS.names[0]


def texts(view, *names: str) -> list[str]:
    return [view.page.locator(f"#{name}").inner_text() for name in names]


def test_a_camera_is_left_out_scored_and_used_again(browser, ball):
    tries = Counter()

    def fail_once(route):
        path = urlsplit(route.request.url).path
        tries[path] += 1
        if tries[path] == 1:
            route.fulfill(status=503, body="{}")
        else:
            route.continue_()

    with opened(browser, ball, query="?time=0") as view:
        view.until(lambda: view.data("drawn") is not None, SCREENSHOT_S)
        view.page.route(re.compile(r"/(camera|frame)\.jpg"), fail_once)
        (session,) = ball.live.registry.sessions
        assert view.page.locator("#input-row").is_hidden()
        view.page.keyboard.press("n")
        view.until(lambda: view.page.locator("#input-row").is_visible())
        view.page.keyboard.press("x")
        view.until(lambda: getattr(session.wanted_look, "without", None) == (NAME,), SCREENSHOT_S)
        view.until(lambda: "dB" in view.page.locator("#error-name").inner_text(), SCREENSHOT_S)
        names = ["Completed (views)", "Original"]
        view.until(lambda: texts(view, "left-name", "right-name") == names, SCREENSHOT_S)
        assert tries["/camera.jpg"] > 1 and tries["/frame.jpg"] > 1
        view.errors.clear()  # the browser notes the status
        asked = f"{ball.url}/frame.jpg?time=0&mode=error&camera={NAME}&without={NAME}"
        score = float(get(asked)[1]["X-Viewmend-PSNR"])
        assert f"subject {score:.1f} dB" in view.page.locator("#error-name").inner_text()
        view.until(lambda: f"without={NAME}" in view.page.url)
        view.page.get_by_role("button", name="Use all cameras").click()
        view.until(lambda: getattr(session.wanted_look, "without", None) == (), SCREENSHOT_S)
        view.until(lambda: view.page.locator("#error-name").is_hidden())


def test_the_original_lies_behind_the_divider_in_its_place(browser, ball):
    with opened(browser, ball, query="?time=0&mode=split&left=original&right=completed") as view:
        view.until(lambda: view.data("drawn") is not None, SCREENSHOT_S)
        view.page.keyboard.press("n")
        view.until(
            lambda: view.page.locator("#original-image").evaluate("i => i.complete && i.naturalWidth > 0")
        )
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        divider = view.page.locator("#divider").bounding_box()
        box = view.page.evaluate("Object.assign({}, document.querySelector('#divider').dataset)")
        left, width = float(box["left"]), float(box["width"])
        shown = []
        for share in (0.98, 0.02):
            view.page.mouse.move(divider["x"] + divider["width"] / 2, divider["y"] + divider["height"] / 2)
            view.page.mouse.down()
            view.page.mouse.move(left + share * width, divider["y"] + divider["height"] / 2, steps=3)
            view.page.mouse.up()
            view.page.wait_for_timeout(600)
            shown.append(view.picture())
            divider = view.page.locator("#divider").bounding_box()
        original, output = shown
        inside = (output.max(-1) > 40) & (original.max(-1) > 40)
        assert inside.sum() > 5000
        outlines = [(image.max(-1) > 40).astype(np.uint8) for image in shown]
        overlap = (outlines[0] & outlines[1]).sum() / (outlines[0] | outlines[1]).sum()
        assert overlap > 0.9, "the same place and size"
        grey = [cv2.GaussianBlur(image.mean(-1), (0, 0), 4)[inside] for image in shown]
        assert np.corrcoef(*grey)[0, 1] > 0.8


def test_two_models_are_compared(browser, ball):
    with opened(browser, ball, query="?time=0&mode=split") as view:
        view.until(lambda: view.data("drawn") is not None, SCREENSHOT_S)
        view.page.locator("#split-left").select_option("completed")
        view.page.locator("#split-right").select_option("compared:paper-small")
        (session,) = ball.live.registry.sessions
        modes = ("completed", "compared")
        view.until(lambda: getattr(session.wanted_look, "modes", None) == modes, SCREENSHOT_S)
        assert session.wanted_look.model == "paper-small"
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        assert texts(view, "right-name") == ["Completed (paper-small)"] and ball.service.error is None


def test_until_another_result_arrives_the_drawn_view_is_shown(browser):
    def are_green(view) -> list[bool]:
        """Whether each half of the view is."""
        halves = [half[half.max(-1) > 60] for half in np.array_split(view.picture(), 2, axis=1)]
        return [(half[:, 1] - half[:, [0, 2]].max(-1) > 120).sum() > 0.5 * len(half) for half in halves]

    query = "?time=0&panel=0&mode=split&left=completed&right=compared:paper-small"
    with running(inpainter=Green()) as server, opened(browser, server, query=query) as view:
        view.page.set_viewport_size({"width": 480, "height": 320})
        server.service.renderer._models["paper-small"] = Green()
        view.until(lambda: are_green(view) == [True, True], SCREENSHOT_S)
        (session,) = server.live.registry.sessions
        with silent(server):
            view.page.locator("#quality").evaluate("e => (e.value = 1, e.dispatchEvent(new Event('input')))")
            view.until(lambda: session.wanted_look.top_k is not None, SCREENSHOT_S)
            assert are_green(view) == [True, True], "another context is nearly the same"
            view.page.locator("#split-right").select_option("compared:rays", force=True)
            view.until(lambda: are_green(view) == [True, False], SCREENSHOT_S)
            view.page.locator("#error-rule").select_option("all", force=True)
            view.until(lambda: are_green(view) == [False, False], SCREENSHOT_S)


def test_depth_and_errors_have_a_scale(browser, ball):
    with opened(browser, ball, query="?time=0&mode=depth") as view:
        view.until(lambda: view.page.locator("#scale").is_visible(), SCREENSHOT_S)
        far, near = (float(text.split()[0]) for text in texts(view, "scale-low", "scale-high"))
        assert far > near > 0


def test_a_program_moves_the_page(browser):
    with serve(BallCapture(CAMERAS, 3), SmoothFill(), config=PIPELINE) as viewer:
        page = browser.new_page()
        page.goto(viewer.address)
        canvas = page.locator("#picture")
        canvas.and_(page.locator("[data-drawn]")).wait_for(timeout=1000 * SCREENSHOT_S)
        viewer.show(azimuth=123.0, time=2, mode="rendered")
        checked = page.locator("#modes [aria-checked=true]")
        page.wait_for_url("**/*pose=123*", timeout=1000 * SCREENSHOT_S)
        page.locator("#picture[data-drawn='2']").wait_for(timeout=1000 * SCREENSHOT_S)
        assert checked.inner_text() == "Rendered" and "time=2" in page.url
        page.close()
