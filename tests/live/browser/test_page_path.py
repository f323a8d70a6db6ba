"""Camera paths: recorded, previewed, and exported as a film that plays."""

import cv2
import numpy as np
import pytest
from live.browser import scene

pytestmark = pytest.mark.slow


def eye(camera: dict) -> np.ndarray:
    R, T = np.reshape(camera["R"], (3, 3)), np.array(camera["T"])
    return -R.T @ T


def export(view, tmp_path) -> tuple[dict, list[np.ndarray]]:
    """Press the button; what was posted and the film's frames."""
    pytest.importorskip("av")
    with view.page.expect_download(timeout=60_000) as waiting:
        view.page.get_by_role("button", name="Export MP4").click()
    path = tmp_path / waiting.value.suggested_filename
    waiting.value.save_as(path)
    assert path.suffix == ".mp4"
    film, frames = cv2.VideoCapture(str(path)), []
    assert film.get(cv2.CAP_PROP_FPS) == 30
    while (read := film.read())[0]:
        frames.append(read[1][..., ::-1])
    return view.server.paths[-1], frames


def test_views_that_were_added_become_a_film(view, tmp_path):
    view.tab("path")
    button = view.page.get_by_role("button", name="Export MP4")
    assert button.is_disabled()
    view.page.get_by_role("button", name="Add view").click()
    first = view.server.looks[-1]["camera"]
    view.drag(70, 20)
    view.settle()
    view.page.get_by_role("button", name="Add view").click()
    last = view.server.looks[-1]["camera"]
    assert "2 views" in view.page.locator("#path-text").inner_text()
    posted, frames = export(view, tmp_path)
    assert posted["fps"] == 30
    assert posted["mode"] == "mended"
    assert (posted["width"], posted["height"]) == (480, 480)
    assert len(posted["poses"]) == len(posted["times"]) == len(frames) == 61
    np.testing.assert_allclose(eye(posted["poses"][0]), eye(first), atol=1e-4)
    np.testing.assert_allclose(eye(posted["poses"][-1]), eye(last), atol=1e-4)
    assert posted["times"] == [(n // 3) % scene.FRAMES for n in range(61)]
    rgb, z, points = scene.render(posted["poses"][0], 480, 480, 0)
    assert np.abs(frames[0].astype(int) - scene.picture(rgb, z, points, "mended")).mean() < 6
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 5


def test_own_movement_is_recorded_and_time_may_stand_still(desktop, tmp_path):
    page = desktop.page
    page.locator("#seek").fill("7")
    page.locator("#picture").focus()
    page.keyboard.press("c")
    desktop.drag(150, 0, steps=20)
    page.wait_for_timeout(300)
    page.keyboard.press("c")
    assert "s recorded" in page.locator("#path-text").inner_text()
    page.locator("#path-time").select_option("still")
    page.locator("#path-size").select_option("640x640")
    posted, frames = export(desktop, tmp_path)
    assert set(posted["times"]) == {7}
    assert len(frames) == len(posted["poses"]) > 5
    assert frames[0].shape == (640, 640, 3)
    way = [np.linalg.norm(eye(b) - eye(a)) for a, b in zip(posted["poses"], posted["poses"][1:], strict=False)]
    assert sum(way) > 0.5
    assert max(way) < 0.6


def test_preview_goes_along_the_path_and_a_hand_stops_it(desktop):
    page = desktop.page
    page.get_by_role("button", name="Add view").click()
    start = eye(desktop.server.looks[-1]["camera"])
    desktop.drag(200, 0)
    desktop.settle()
    page.get_by_role("button", name="Add view").click()
    page.get_by_role("button", name="Preview").click()
    desktop.until(lambda: np.linalg.norm(eye(desktop.server.looks[-1]["camera"]) - start) < 0.1)
    desktop.until(lambda: page.get_by_role("button", name="Preview").is_visible())
    end = eye(desktop.server.looks[-1]["camera"])
    assert np.linalg.norm(end - start) > 0.5
    page.get_by_role("button", name="Preview").click()
    desktop.drag(10, 0)
    desktop.until(lambda: page.get_by_role("button", name="Preview").is_visible(), 1.5)
    page.get_by_role("button", name="Clear").click()
    assert page.get_by_role("button", name="Preview").is_disabled()


def test_a_film_that_fails_is_said(desktop):
    page = desktop.page
    page.route("**/path.mp4", lambda route: route.fulfill(status=409, json={"error": "another film is being made"}))
    for _ in range(2):
        page.get_by_role("button", name="Add view").click()
    page.get_by_role("button", name="Export MP4").click()
    desktop.until(lambda: "another film is being made" in page.locator("#toasts").inner_text())
    desktop.errors.clear()  # the browser notes the status
    assert page.get_by_role("button", name="Export MP4").is_enabled()
