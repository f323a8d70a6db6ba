"""The views of a path: a turntable, their order and moments; a link; a double-click; the cameras' images."""

import numpy as np
import pytest
from live.browser.conftest import SCREENSHOT_S, SIZES, opened
from live.live_servers import running

pytestmark = pytest.mark.slow


def moments(page) -> list[float]:
    return [float(field.input_value()) for field in page.locator("#path-views input").all()]


def focused(page) -> str | None:
    return page.evaluate("document.activeElement.getAttribute('aria-label')")


def text(page) -> str:
    return page.locator("#path-text").inner_text()


def test_a_turntable_and_the_order_of_views(desktop):
    page = desktop.page
    page.locator("#path-seconds").fill("4")
    page.get_by_role("button", name="Turntable").click()
    desktop.until(lambda: "9 views, 4 s" in text(page), 10)
    (asked,) = desktop.server.turntables
    assert (asked["arc"], asked["width"], asked["height"]) == ("360", "480", "480") and int(
        asked["frames"]
    ) > 1
    assert moments(page) == [n / 2 for n in range(9)]
    desktop.server.film_hold = True
    page.get_by_role("button", name="Export MP4").click()
    desktop.until(lambda: bool(desktop.server.paths), 30)
    page.get_by_role("button", name="Cancel").click()
    poses = desktop.server.paths[-1]["poses"]
    eyes = np.array([-np.reshape(pose["R"], (3, 3)).T @ pose["T"] for pose in poses])
    assert {pose["fx"] for pose in poses} == {600.0}, "the lens that the server has fitted"
    assert np.allclose(np.hypot(eyes[:, 0], eyes[:, 2]).max(), 2.5, atol=0.5)
    assert len(poses) == 121 and np.abs(eyes[0] - eyes[-1]).max() < 1e-3
    assert np.ptp(eyes[:, 1]) < 1e-3 and np.ptp(eyes[:, 0]) > 3 and np.ptp(eyes[:, 2]) > 3
    field = page.get_by_label("Seconds of view 2", exact=True)
    field.fill("3")
    field.press("Enter")
    assert moments(page) == [0.0, *(3 + n / 2 for n in range(8))]
    assert focused(page) == "Seconds of view 2"
    page.get_by_role("button", name="Delete view 1", exact=True).click()
    assert "8 views, 4 s" in text(page) and moments(page)[0] == 0
    assert focused(page) == "Delete view 1", "what was the second view"
    page.get_by_role("button", name="Move view 1 down", exact=True).click()
    assert moments(page) == [n / 2 for n in range(8)], "the moments stay"
    assert focused(page) == "Move view 2 down", "it goes along"
    page.get_by_role("button", name="Go to view 2", exact=True).click()
    desktop.settle()
    eye = (
        -np.reshape(desktop.server.looks[-1]["camera"]["R"], (3, 3)).T
        @ desktop.server.looks[-1]["camera"]["T"]
    )
    assert np.abs(eye - eyes[15]).max() < 0.05, "what was the second view of the turntable"
    page.get_by_role("button", name="Move view 7 down", exact=True).press("Enter")
    assert focused(page) == "Move view 8 up"
    page.get_by_role("button", name="Delete view 8", exact=True).press("Enter")
    assert focused(page) == "Delete view 7"


def test_a_link_is_copied(desktop):
    desktop.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    desktop.drag(80, 0)
    desktop.settle()
    desktop.page.get_by_role("button", name="Copy a link").click()
    desktop.until(lambda: "Link copied" in desktop.page.locator("#toasts").inner_text())
    link = desktop.page.evaluate("navigator.clipboard.readText()")
    assert link.startswith(desktop.server.url) and "pose=" in link


@pytest.mark.parametrize("size", SIZES)
def test_a_double_click_or_tap_turns_about_the_surface(browser, size):
    with running() as server, opened(browser, server, size, "?time=0") as view:
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        x, y = view.middle()

        def double_tap() -> bool:
            for _ in range(2):
                view.page.touchscreen.tap(x + 20, y - 20)
            view.page.wait_for_timeout(3000)
            return "pose=" in view.page.url

        if size == "phone":
            view.until(double_tap, SCREENSHOT_S)  # again if there was too much time between the taps
        else:
            view.page.mouse.dblclick(x + 40, y - 30)
            view.until(lambda: "pose=" in view.page.url, SCREENSHOT_S)
        distance, target = (
            np.array([float(value) for value in view.page.url.split("pose=")[1].split("&")[0].split(",")])[
                part
            ]
            for part in (3, slice(5, None))
        )
        rig = server.service.renderer.rig_json
        assert distance < 0.8 * rig["home"]["distance"]
        (geometry,) = [server.service.renderer.geometry(server.service.source.read(0))]
        gap = (geometry.mesh.vertices.numpy() - target).__abs__().max(1).min()
        assert gap < 0.01, "on the surface"


def test_the_cameras_show_their_images(browser):
    with running() as server, opened(browser, server, query="?time=0&pose=20,20,0,9,45,0,0,0") as view:
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        before = view.picture()
        view.page.keyboard.press("g")

        def has_images() -> bool:
            shown = view.picture()
            colourful = (np.ptp(shown, -1) > 40) & (np.abs(shown - before).max(-1) > 30)
            return colourful.sum() > 300

        view.until(has_images, SCREENSHOT_S)  # not only grey and golden lines
