"""The geometry by itself, and films for two eyes."""

import cv2
import numpy as np
import pytest
from live.browser import scene

pytestmark = pytest.mark.slow


def clay(pixels: np.ndarray) -> float:
    return float((np.abs(pixels - np.array(scene.CLAY)).max(-1) < 30).mean())


def test_the_hull_and_its_points_are_shown_alone_and_beside_others(view):
    shown = {}
    for name in ("Hull", "Points"):
        view.page.locator("#modes").get_by_role("radio", name=name).click()
        view.settle()
        assert view.server.looks[-1]["modes"] == [name.lower()]
        shown[name] = clay(view.picture())
    assert shown["Hull"] > 0.02 and shown["Points"] < 0.7 * shown["Hull"]
    view.page.locator("#modes").get_by_role("radio", name="Side by side").click()
    view.tab("view")
    view.page.locator("#split-right").select_option("hull")
    view.settle()
    assert view.server.looks[-1]["modes"] == ["rendered", "hull"]


def test_every_picture_can_be_chosen_and_all_are_seen_at_once_on_a_large_screen(view, desktop):
    assert desktop.page.locator("#modes").evaluate("e => e.scrollWidth <= e.clientWidth")
    strip = view.page.locator("#modes").get_by_role("radio")
    assert strip.count() == 9
    strip.last.scroll_into_view_if_needed()
    box, width = strip.last.bounding_box(), view.page.viewport_size["width"]
    assert box["x"] >= 0 and box["x"] + box["width"] <= width


def test_a_film_for_headsets_has_two_eyes_in_the_size_that_was_chosen(desktop, tmp_path):
    pytest.importorskip("av")
    page = desktop.page
    for _ in range(2):
        page.get_by_role("button", name="Add view").click()
    page.locator("#path-stereo").check()
    films = []
    for expected in ("viewmend-path_SBS.mp4", "viewmend-path.mp4"):
        with page.expect_download(timeout=60_000) as waiting:
            page.get_by_role("button", name="Export MP4").click()
        assert waiting.value.suggested_filename == expected
        waiting.value.save_as(tmp_path / expected)
        films.append(cv2.VideoCapture(str(tmp_path / expected)).read()[1])
        page.locator("#path-stereo").uncheck()
    two, one = desktop.server.paths[-2:]
    assert two["stereo_m"] == pytest.approx(0.064) and one["stereo_m"] is None
    assert (two["width"], two["height"]) == (240, 480) and (one["width"], one["height"]) == (480, 480)
    assert two["poses"][0]["cx"] == 120 and two["poses"][0]["fy"] < one["poses"][0]["fy"], (
        "narrower, but nothing is cut"
    )
    assert films[0].shape == films[1].shape == (480, 480, 3)
