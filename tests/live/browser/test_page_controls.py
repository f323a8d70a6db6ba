"""Every control does what it says, in a real browser: pictures, quality, time, overlays."""

import cv2
import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import opened
from live.browser.stand_in import StandIn

pytestmark = pytest.mark.slow


def share(pixels: np.ndarray, colour: tuple[int, int, int], tolerance: int = 60) -> float:
    return float((np.abs(pixels - np.array(colour)).max(-1) < tolerance).mean())


def choose(view, name: str) -> None:
    view.page.locator("#modes").get_by_role("radio", name=name).click()
    view.settle()


def test_modes_show_their_pictures(view):
    seen = {}
    shown = {
        "Completed": "completed",
        "Rendered": "rendered",
        "Holes": "holes",
        "Depth": "depth",
        "Source cameras": "coverage",
    }
    for name, mode in shown.items():
        choose(view, name)
        assert view.server.looks[-1]["modes"] == [mode]
        seen[name] = view.picture()
    assert share(seen["Holes"], scene.PINK) > 0.004 > share(seen["Completed"], scene.PINK)
    black = {name: (pixels.max(-1) < 20).mean() for name, pixels in seen.items()}
    assert black["Rendered"] > black["Completed"] + 0.004
    depth = seen["Depth"][seen["Depth"].max(-1) > 60]
    assert np.abs(depth[:, 0] - depth[:, 2]).max() < 30
    for colour in scene.COLOURS:
        assert share(seen["Source cameras"], tuple(colour)) > 0.01


def test_every_picture_can_be_chosen_and_all_are_seen_at_once_on_a_large_screen(view, desktop):
    assert desktop.page.locator("#modes").evaluate("e => e.scrollWidth <= e.clientWidth")
    strip = view.page.locator("#modes").get_by_role("radio")
    assert strip.count() == 9
    strip.last.scroll_into_view_if_needed()
    box, width = strip.last.bounding_box(), view.page.viewport_size["width"]
    assert box["x"] >= 0 and box["x"] + box["width"] <= width


DIGITS = ["rendered", "holes", "completed", None, "depth", "coverage", "confidence", "hull", "points"]


def test_digits_choose_modes(desktop):
    for digit, mode in zip("123456789", DIGITS, strict=True):
        desktop.page.keyboard.press(digit)
        desktop.settle()
        assert desktop.server.looks[-1]["modes"] == ([mode] if mode else ["rendered", "completed"])


def test_side_by_side_has_a_divider_that_is_dragged(view):
    choose(view, "Side by side")
    view.tab("view")
    view.page.locator("#split-left").select_option("holes")
    view.page.locator("#split-right").select_option("coverage")
    view.settle()
    assert view.server.looks[-1]["modes"] == ["holes", "coverage"]
    view.tab("view")
    split = view.page.locator("#divider")
    box = split.bounding_box()
    middle = int(box["x"] + box["width"] / 2)
    shown = view.picture()
    blue = tuple(scene.COLOURS[1])
    assert share(shown[:, :middle], scene.PINK) > 0.002
    assert share(shown[:, middle:], scene.PINK) == 0
    assert share(shown[:, middle:], tuple(scene.COLOURS[0])) + share(shown[:, middle:], blue) > 0.01
    y = view.middle()[1]
    view.page.mouse.move(middle, y)
    view.page.mouse.down()
    view.page.mouse.move(middle - 150, y, steps=3)
    view.page.mouse.up()
    view.until(lambda: split.bounding_box()["x"] < box["x"] - 145)
    assert share(view.picture()[:, middle - 120 :], scene.PINK) == 0
    at = float(split.get_attribute("aria-valuenow"))
    split.focus()
    view.page.keyboard.press("ArrowRight")
    view.until(lambda: float(split.get_attribute("aria-valuenow")) == pytest.approx(at + 2, abs=1))


def test_the_error_rule_is_one_of_the_servers(view):
    assert view.server.looks[-1]["error_rule"] == "all", "the one that the server was started with"
    view.tab("quality")
    rules = view.page.locator("#error-rule")
    assert rules.locator("option").all_inner_texts() == ["only holes", "the whole subject", "yours"]
    rules.select_option("holes")
    view.settle()
    assert view.server.looks[-1]["error_rule"] == "holes"


def test_a_model_that_tells_no_confidence_is_named(desktop):
    desktop.page.keyboard.press("7")
    desktop.settle()
    assert share(desktop.picture(), (253, 231, 36)) > 0.05 and not desktop.page.locator("#pill").is_visible()
    desktop.server.confidence = None
    desktop.page.keyboard.press("r")
    desktop.page.keyboard.press("3")
    desktop.settle()
    assert not desktop.page.locator("#pill").is_visible(), "nobody asked"
    desktop.page.keyboard.press("7")
    desktop.settle()
    assert desktop.page.locator("#pill").inner_text() == "No confidence"


def test_quality_and_resolution_sliders(view):
    view.tab("quality")
    assert view.server.looks[-1]["top_k"] is None
    view.page.locator("#quality").fill("2")
    view.page.locator("#side").fill("512")
    view.settle()
    look = view.server.looks[-1]
    width, height = view.page.viewport_size["width"], view.page.viewport_size["height"]
    assert look["top_k"] == 256
    assert look["width"] * look["height"] == pytest.approx(512**2, rel=0.05)
    assert look["width"] / look["height"] == pytest.approx(width / height, rel=0.03)
    assert view.page.locator("#side-value").inner_text() == f"{look['width']} × {look['height']}"
    assert "256" in view.page.locator("#quality-value").inner_text()


def test_moving_may_cost_pixels_or_not(desktop):
    sizes = []
    for adaptive in (True, False):
        desktop.page.locator("#adaptive").set_checked(adaptive)
        desktop.settle()
        start = len(desktop.server.looks)
        desktop.drag(120, 0, steps=12)
        desktop.settle()
        looks = desktop.server.looks[start:]
        assert any(look["moving"] and look["adaptive"] == adaptive for look in looks)
        sizes.append(desktop.data("full"))
    assert sizes == ["true", "true"]


def test_pause_seek_step_speed_and_live(view):
    page, server = view.page, view.server
    still = view.picture()
    page.locator("#seek").fill("20")
    view.until(lambda: view.data("time") == "20")
    assert (np.abs(still - view.picture()).max(-1) > 60).mean() > 0.001
    assert page.locator("#time").inner_text() == f"21 / {scene.FRAMES}"
    page.locator("#picture").focus()
    page.keyboard.press(".")
    view.until(lambda: view.data("time") == "21")
    page.keyboard.press(",")
    view.until(lambda: view.data("time") == "20")
    assert page.locator("#live").get_attribute("aria-pressed") == "false"
    page.get_by_role("button", name="Play", exact=True).click()
    view.until(lambda: view.data("time") not in ("20", "21"))
    page.get_by_role("button", name="Pause", exact=True).click()
    view.until(lambda: server.clocks and server.clocks[-1].get("playing") is False)
    page.locator("#speed").select_option("2")
    view.until(lambda: server.clocks[-1].get("speed") == 2)
    page.keyboard.press("Escape")
    page.locator("#picture").focus()
    page.keyboard.press("[")
    view.until(lambda: server.clocks[-1].get("speed") == 1)
    page.locator("#live").click()
    view.until(lambda: server.clocks[-1].get("live") is True)
    view.until(lambda: page.locator("#live").get_attribute("aria-pressed") == "true")
    page.locator("#picture").focus()
    page.keyboard.press("Space")
    view.until(lambda: server.clocks[-1] == {"type": "clock", "playing": False})


def test_steps_and_clicks_start_from_what_is_shown(desktop):
    page, server = desktop.page, desktop.server
    line = page.locator("#seek")
    box = line.bounding_box()
    at = {"position": {"x": 0.4 * box["width"], "y": box["height"] / 2}}
    line.click(**at)
    desktop.until(lambda: server.clocks and "seek" in server.clocks[-1])
    sought = server.clocks[-1]["seek"]
    away = lambda: abs(int(desktop.data("time")) - sought) > 2  # noqa: E731
    desktop.until(lambda: not away())
    page.keyboard.press("Space")  # the timeline has the focus, and no use for it
    for _ in range(2):
        desktop.until(away)
        count = len(server.clocks)
        line.click(**at)  # where it was clicked before
        desktop.until(lambda count=count: {"type": "clock", "seek": sought} in server.clocks[count:])
        desktop.until(lambda: not away())
    desktop.until(away)
    page.keyboard.press("Space")
    desktop.until(lambda: server.clocks[-1].get("playing") is False)
    desktop.settle()
    shown = int(desktop.data("time"))
    page.keyboard.press(".")
    desktop.until(lambda: server.clocks[-1].get("seek") is not None)
    assert server.clocks[-1]["seek"] == min(shown + 1, scene.FRAMES - 1)


def test_what_the_address_asks_for_must_make_sense(browser, server):
    with opened(browser, server, "desktop", "?sharp=0&mode=foo&left=split&size=big") as view:
        view.settle()
        assert server.looks[-1]["modes"] == ["completed"]


def test_a_phone_that_is_turned_upright_has_its_tabs(browser, server):
    with opened(browser, server, "phone") as view:
        view.page.set_viewport_size({"width": 844, "height": 390})
        view.page.reload()
        view.settle()
        view.page.set_viewport_size({"width": 390, "height": 844})
        view.tab("quality")
        assert view.page.locator("#quality").is_visible()


def test_the_rig_is_drawn_and_the_cameras_in_use_stand_out(view):
    before = view.picture()
    view.page.get_by_role("button", name="Show the cameras").click()
    view.settle()
    assert (np.abs(before - view.picture()).max(-1) > 30).sum() > 300
    assert view.page.locator("#labels button", has_text="cam").count() == scene.CAMERAS
    view.tab("cameras")
    used = view.page.locator("#cameras button[data-used]").all_inner_texts()
    assert used == scene.INPUTS
    assert view.page.locator("#camera-count").inner_text() == "3 of 4 used for this view"
    view.page.locator("#rig").set_checked(False)
    view.settle()
    assert view.page.locator("#labels").is_hidden()


def test_a_label_in_the_picture_leads_to_its_camera(desktop):
    desktop.page.keyboard.press("g")
    desktop.settle()
    labels = desktop.page.locator("#labels button:visible")
    names = [label.inner_text() for label in labels.all()]
    label = next(
        one for one in labels.all() if 40 < one.bounding_box()["x"] < 900 and one.bounding_box()["y"] > 60
    )
    place = names.index(label.inner_text())
    wanted = next(c for c in scene.rig()["cameras"] if c["name"] == names[place])
    label.click()
    desktop.settle()
    np.testing.assert_allclose(desktop.server.looks[-1]["camera"]["R"], wanted["R"], atol=1e-6)


def test_statistics_are_shown(view):
    view.tab("stats")
    view.page.locator("#play").click()
    view.until(lambda: float(view.page.locator("#figure-fps").inner_text().replace("–", "0")) > 1)
    for name in ("latency", "holes", "kb", "dropped", "size", "repaints"):
        assert view.page.locator(f"#figure-{name}").inner_text() != "–"
    assert view.page.locator("#stages").inner_text().count("ms") == 7
    drawn = view.page.evaluate(
        "(() => { const p = document.querySelector('#plot');"
        " return new Set(p.getContext('2d').getImageData(0, 0, p.width, p.height).data).size })()"
    )
    assert drawn > 10


@pytest.mark.parametrize("how", ["button", "key"])
def test_a_screenshot_is_what_is_seen(desktop, tmp_path, how):
    with desktop.page.expect_download() as waiting:
        if how == "key":
            desktop.page.keyboard.press("p")
        else:
            desktop.page.get_by_role("button", name="Save a screenshot").click()
    path = tmp_path / waiting.value.suggested_filename
    waiting.value.save_as(path)
    assert path.name == "viewmend-0000.png"
    saved = cv2.imread(str(path))[..., ::-1].astype(int)
    assert np.abs(saved - desktop.picture()).mean() < 1


def test_help_opens_and_closes(view):
    view.page.get_by_role("button", name="Help").click()
    help_ = view.page.get_by_role("dialog")
    assert help_.is_visible()
    assert "orbit around the subject" in help_.inner_text()
    view.page.get_by_role("button", name="Close the help").click()
    assert help_.is_hidden()
    view.page.locator("#picture").focus()
    view.page.keyboard.press("?")
    assert help_.is_visible()


def test_the_panel_makes_room(desktop):
    x, _ = desktop.middle()
    desktop.page.keyboard.press("h")
    desktop.settle()
    assert desktop.page.locator("#panel").is_hidden()
    assert desktop.middle()[0] > x + 100


@pytest.mark.parametrize("codec", ["vp9", "h264"])
def test_video_is_decoded_when_both_sides_can(desktop, codec):
    if codec not in desktop.server.hellos[0]["codecs"]:
        pytest.skip(f"this Chromium has no {codec}")
    before = desktop.picture()
    desktop.page.locator("#codec").select_option(codec)
    desktop.settle()
    assert desktop.server.looks[-1]["codec"] == codec
    assert np.abs(desktop.picture() - before).mean() < 4
    desktop.drag(100, 0)
    desktop.settle()
    assert np.abs(desktop.picture() - before).mean() > 2


def test_a_browser_without_video_is_offered_jpeg_alone(browser):
    with StandIn(video=False) as server, opened(browser, server) as view:
        view.settle()
        assert view.page.locator("#codec").is_hidden()
        assert view.server.looks[-1]["codec"] == "jpeg"
