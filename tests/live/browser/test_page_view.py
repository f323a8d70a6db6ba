"""Every control does what it says, in a real browser: the pose."""

import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import opened

pytestmark = pytest.mark.slow


def camera(view):
    return view.server.looks[-1]["camera"]


def eye(view) -> np.ndarray:
    R, T = np.reshape(camera(view)["R"], (3, 3)), np.array(camera(view)["T"])
    return -R.T @ T


def forward(view) -> np.ndarray:
    return np.array(camera(view)["R"][6:9])


def changed(before: np.ndarray, after: np.ndarray) -> float:
    """Share of the pixels that are visibly another colour."""
    return float((np.abs(before - after).max(-1) > 30).mean())


def test_first_picture_shows_the_scene_from_home_in_the_middle_of_what_is_free(view):
    azimuth, elevation = np.deg2rad([20, 10])
    flat = np.array([np.sin(azimuth), 0, np.cos(azimuth)])
    expected = scene.CENTER + 3 * (np.cos(elevation) * flat + np.sin(elevation) * np.array([0, 1, 0]))
    np.testing.assert_allclose(eye(view), expected, atol=1e-6)
    bright = np.argwhere(view.picture().max(-1) > 40)
    x, y = view.middle()
    assert abs(np.mean([bright[:, 1].min(), bright[:, 1].max()]) - x) < 90
    assert abs(bright[:, 0].mean() - y) < 60
    assert view.page.title() == "two balls · viewmend live"


def test_dragging_orbits_about_the_centre(view):
    before, start = view.picture(), eye(view)
    view.drag(80, 40)
    view.settle()
    assert changed(before, view.picture()) > 0.01
    np.testing.assert_allclose(np.linalg.norm(eye(view) - scene.CENTER), 3, atol=1e-3)
    assert np.cross(start - scene.CENTER, eye(view) - scene.CENTER)[1] < -0.5  # the camera went left
    assert eye(view)[1] > start[1] + 0.1  # and up


@pytest.mark.parametrize("how", ["right", "shift"])
def test_other_drags_pan(desktop, how):
    start, direction = eye(desktop), forward(desktop)
    if how == "shift":
        desktop.page.keyboard.down("Shift")
    desktop.drag(100, 0, button="right" if how == "right" else "left")
    desktop.page.keyboard.up("Shift")
    desktop.settle()
    np.testing.assert_allclose(forward(desktop), direction, atol=1e-6)
    right = np.array(camera(desktop)["R"][:3])
    look = desktop.server.looks[-1]
    metres = 100 * 3 / (look["camera"]["fx"] * 1280 / look["width"])
    np.testing.assert_allclose(eye(desktop) - start, -metres * right, atol=1e-3)


def test_the_wheel_comes_closer(desktop):
    before = (desktop.picture().max(-1) > 40).sum()
    desktop.page.mouse.move(*desktop.middle())
    desktop.page.mouse.wheel(0, -300)
    desktop.settle()
    assert np.linalg.norm(eye(desktop) - scene.CENTER) < 2.5
    assert (desktop.picture().max(-1) > 40).sum() > 1.2 * before


def touch(view, points: list[list[tuple[float, float]]]) -> None:
    """Fingers: for each moment, where they are."""
    session = view.page.context.new_cdp_session(view.page)
    for n, moment in enumerate(points):
        fingers = [{"x": x, "y": y, "id": k} for k, (x, y) in enumerate(moment)]
        session.send(
            "Input.dispatchTouchEvent", {"type": "touchMove" if n else "touchStart", "touchPoints": fingers}
        )
        view.page.wait_for_timeout(20)
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_one_finger_orbits_two_pan_and_pinch(browser, server):
    with opened(browser, server, "phone") as view:
        view.settle()
        x, y = view.middle()
        start = eye(view)
        touch(view, [[(x, y)], [(x + 30, y)], [(x + 60, y)]])
        view.settle()
        assert np.linalg.norm(eye(view) - start) > 0.3
        np.testing.assert_allclose(np.linalg.norm(eye(view) - scene.CENTER), 3, atol=1e-3)
        start, direction = eye(view), forward(view)
        touch(
            view,
            [
                [(x - 40, y), (x + 40, y)],
                [(x - 40, y + 20), (x + 40, y + 20)],
                [(x - 40, y + 60), (x + 40, y + 60)],
            ],
        )
        view.settle()
        np.testing.assert_allclose(forward(view), direction, atol=1e-5)
        assert (eye(view) - start)[1] > 0.1
        touch(view, [[(x - 40, y), (x + 40, y)], [(x - 60, y), (x + 60, y)], [(x - 80, y), (x + 80, y)]])
        view.settle()
        travelled = (eye(view) - start) @ direction
        np.testing.assert_allclose(travelled, 1.5, atol=0.05)


def test_keys_turn_walk_zoom_and_reset(desktop):
    page, start = desktop.page, eye(desktop)

    def hold(key: str) -> None:
        before = eye(desktop)
        page.keyboard.down(key)
        desktop.until(lambda: np.linalg.norm(eye(desktop) - before) > 0.3)
        page.keyboard.up(key)
        desktop.settle()

    page.locator("#picture").focus()
    hold("ArrowRight")
    turned = eye(desktop)
    assert np.cross(start - scene.CENTER, turned - scene.CENTER)[1] > 0.3
    hold("w")
    assert (eye(desktop) - turned) @ forward(desktop) > 0.2
    walked = eye(desktop)
    hold("d")
    assert (eye(desktop) - walked) @ np.array(camera(desktop)["R"][:3]) > 0.2
    walked, distance = eye(desktop), forward(desktop)
    hold("+")
    assert (eye(desktop) - walked) @ distance > 0.2
    page.keyboard.press("r")
    desktop.settle()
    np.testing.assert_allclose(eye(desktop), start, atol=1e-6)


def test_fly_looks_around_from_where_one_stands(view):
    view.tab("view")
    view.page.get_by_role("radio", name="Fly").click()
    view.settle()
    start, direction = eye(view), forward(view)
    view.drag(60, 0)
    view.settle()
    np.testing.assert_allclose(eye(view), start, atol=1e-6)
    assert np.cross(direction, forward(view))[1] > 0.05  # the picture went right: the view turned left
    view.page.mouse.move(*view.middle())
    view.page.mouse.wheel(0, -200)
    view.settle()
    assert (eye(view) - start) @ forward(view) > 0.2


def test_snap_to_a_camera_takes_its_very_pose(view):
    view.tab("cameras")
    view.page.locator("#cameras").get_by_role("button", name="cam02").click()
    view.settle()
    wanted = scene.rig()["cameras"][2]
    np.testing.assert_allclose(camera(view)["R"], wanted["R"], atol=1e-6)
    np.testing.assert_allclose(camera(view)["T"], wanted["T"], atol=1e-6)
    view.page.keyboard.press("n")
    view.settle()
    np.testing.assert_allclose(eye(view), scene.rig()["cameras"][3]["center"], atol=1e-6)


def test_reset_button_and_field_of_view(view):
    start = eye(view)
    view.drag(50, 10)
    view.tab("view")
    view.page.locator("#fov").fill("30")
    view.settle()
    look = view.server.looks[-1]
    assert np.linalg.norm(eye(view) - start) > 0.1
    narrow = look["camera"]["fy"] / look["height"]
    view.page.get_by_role("button", name="Reset the view").click()
    view.settle()
    look = view.server.looks[-1]
    np.testing.assert_allclose(eye(view), start, atol=1e-6)
    ratio = np.tan(np.deg2rad(45 / 2)) / np.tan(np.deg2rad(15))
    np.testing.assert_allclose(narrow / (look["camera"]["fy"] / look["height"]), ratio, rtol=1e-3)
