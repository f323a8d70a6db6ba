"""A view at rest is sharp, and the page remembers it: in its address and in the browser."""

from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import opened
from live.browser.stand_in import LIMITS, StandIn

pytestmark = pytest.mark.slow


def told(view) -> dict[str, str]:
    return {name: values[0] for name, values in parse_qs(urlsplit(view.page.url).query).items()}


@pytest.mark.parametrize("size", ["phone", "desktop"])
def test_at_rest_each_pixel_of_the_canvas_is_asked_for(browser, server, size):
    with opened(browser, server, size, "") as view:
        view.settle()
        look = view.server.looks[-1]
        page = view.page.viewport_size
        longest = LIMITS["max_side_px"] / max(page.values())
        most = min(1.0, longest, np.sqrt(LIMITS["max_pixels"] / (page["width"] * page["height"])))
        for side in ("width", "height"):
            assert most * page[side] - 4 <= look[side] <= most * page[side] + 1
        view.tab("quality")
        assert view.page.locator("#side-value").inner_text() == f"{look['width']} × {look['height']}"
        start = len(view.server.looks)
        view.drag(60, 0, steps=8)
        view.settle()
        moving = [look for look in view.server.looks[start:] if look["moving"]]
        assert moving
        assert all(look["width"] * look["height"] <= 1.02 * 640**2 for look in moving)
        assert view.server.looks[-1]["width"] == look["width"]


def says(view, resolution: str) -> None:
    view.until(lambda: view.page.locator("#side-value").inner_text() == resolution)


def test_the_slider_tells_the_resolution_that_is_shown(browser, server):
    with opened(browser, server, "desktop", "?side=400") as view:
        view.settle()
        view.page.keyboard.press("Space")
        says(view, "504 × 316")  # 400 pixels squared in the page's shape
        view.page.keyboard.press("Space")
        says(view, "1024 × 640")


def test_a_capture_of_one_time_has_no_timeline(browser, desktop):
    assert desktop.page.locator("#transport").is_visible()
    with StandIn(frames=1, playing=True) as server, opened(browser, server, "phone", "") as view:
        view.settle()
        view.until(lambda: view.page.locator("#transport").is_hidden())
        assert view.page.locator("#modes").is_visible()
        view.until(lambda: view.server.looks[-1]["height"] == 844)  # at rest, though its clock runs


def test_a_reload_shows_the_same_pose_picture_and_time(view):
    view.drag(70, 30)
    view.page.locator("#modes").get_by_role("radio", name="Holes").click()
    view.page.locator("#seek").fill("12")
    view.until(
        lambda: told(view).get("time") == "12" and told(view).get("mode") == "holes" and "pose" in told(view)
    )
    before = view.server.looks[-1]
    view.page.reload()
    view.settle()
    view.until(lambda: view.data("time") == "12")
    after = view.server.looks[-1]
    assert after["modes"] == ["holes"]
    np.testing.assert_allclose(after["camera"]["R"], before["camera"]["R"], atol=1e-5)
    np.testing.assert_allclose(after["camera"]["T"], before["camera"]["T"], atol=1e-3)
    view.page.get_by_role("button", name="Reset the view").click()
    view.page.get_by_role("button", name="Play", exact=True).click()
    view.until(lambda: not {"pose", "time"} & told(view).keys())
    assert told(view)["sharp"] == "0", "what it does not write stays"


@pytest.mark.parametrize("pose", ["1,2,3", "0,95,0,3,45,0,1,0", "0,x,0,3,45,0,1,0", "0,0,0,0,45,0,1,0"])
def test_a_pose_that_makes_no_sense_is_the_home(browser, server, pose):
    with opened(browser, server, "desktop", f"?sharp=0&pose={pose}&time=-3") as view:
        view.settle()
        T = np.array(view.server.looks[-1]["camera"]["T"])
        R = np.reshape(view.server.looks[-1]["camera"]["R"], (3, 3))
        np.testing.assert_allclose(np.linalg.norm(-R.T @ T - scene.CENTER), 3, atol=1e-3)


def test_choices_are_kept_for_the_next_time(browser, server):
    with opened(browser, server) as view:
        view.settle()
        view.page.locator("#side").fill("512")
        view.page.locator("#adaptive").set_checked(False)
        view.page.locator("#modes").get_by_role("radio", name="Depth").click()
        view.page.goto(server.url + "?sharp=0")
        view.settle()
        look = view.server.looks[-1]
        assert look["width"] * look["height"] == pytest.approx(512**2, rel=0.05)
        assert look["adaptive"] is False
        assert look["modes"] == ["completed"], "the address tells the picture"
        assert not view.page.locator("#adaptive").is_checked()
        view.page.goto(server.url + "?sharp=0&side=256&adaptive=1")
        view.settle()
        assert view.server.looks[-1]["adaptive"] is True
        view.page.evaluate("localStorage.setItem('viewmend.settings', '[7')")
        view.page.goto(server.url + "?sharp=0")
        view.settle()
        assert view.page.locator("#adaptive").is_checked()
