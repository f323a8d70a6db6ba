"""What the pictures lie upon, light and dark, and the camera's own image beside ours."""

import numpy as np
import pytest
from live.browser import scene

pytestmark = pytest.mark.slow


def corner(view) -> list[int]:
    """The colour of the empty stage."""
    return view.picture()[120:140, 20:40].reshape(-1, 3).mean(0).round().astype(int).tolist()


def test_the_background_has_the_colour_that_was_chosen(desktop):
    before = desktop.picture()
    assert corner(desktop) == [0, 0, 0]
    desktop.page.locator("#background").fill("#3060c0")
    desktop.settle()
    assert desktop.server.looks[-1]["background"] == "3060c0"
    assert corner(desktop) == [0x30, 0x60, 0xC0]
    after = desktop.picture()
    ball = before.max(-1) > 100
    assert np.median(np.abs(before - after).max(-1)[ball]) < 6, "the subject stays"
    desktop.drag(60, 0)
    desktop.settle()
    assert corner(desktop) == [0x30, 0x60, 0xC0]


def test_the_light_page_is_light_and_is_kept(view):
    view.tab("view")
    view.page.locator("#theme").select_option("light")
    view.settle()
    assert corner(view) == [0xF2, 0xF4, 0xF6]
    shown = view.pixels()
    assert (shown.min(-1) > 180).mean() > 0.6
    view.page.reload()
    view.settle()
    assert view.server.looks[-1]["background"] == "f2f4f6"
    view.tab("view")
    view.page.locator("#theme").select_option("dark")
    view.settle()
    assert corner(view) == [0, 0, 0]


def test_pictures_lie_upon_what_the_model_paints_upon_until_somebody_chooses(desktop):
    desktop.server.ground = "ffffff"
    desktop.page.reload()
    desktop.settle()
    assert desktop.server.looks[-1]["background"] == "ffffff" and corner(desktop) == [255, 255, 255]
    desktop.page.locator("#background").fill("#204020")
    desktop.settle()
    assert corner(desktop) == [0x20, 0x40, 0x20]


def test_text_of_the_light_page_can_be_read(desktop):
    desktop.page.locator("#theme").select_option("light")
    colours = (
        "[...document.querySelectorAll('.panel h2, .field, .switch, .panel .button, #time, .modes button')]"
        ".map(e => getComputedStyle(e).color.match(/[\\d.]+/g).slice(0, 3).map(Number))"
    )
    assert len(desktop.page.evaluate(colours)) > 20
    # dark letters on white, once the colours have faded over
    desktop.until(lambda: np.max(desktop.page.evaluate(colours)) < 160)


def test_the_cameras_own_image_is_beside_ours_until_the_view_moves(view):
    card = view.page.locator("#original")
    assert card.is_hidden()
    view.tab("cameras")
    view.page.locator("#cameras").get_by_role("button", name="cam02").click()
    view.settle()
    view.until(card.is_visible)
    assert view.server.originals[-1] == {"name": "cam02", "time": "0"}
    assert view.page.locator("#original-name").inner_text() == "cam02, original"
    box = view.page.locator("#original-image").bounding_box()
    x, y, w, h = (int(box[side]) for side in ("x", "y", "width", "height"))
    green = np.abs(view.pixels()[y : y + h, x : x + w] - (20, 160, 60)).max(-1) < 30
    share = (np.abs(scene.original("cam02", 0).astype(int) - (20, 160, 60)).max(-1) < 30).mean()
    assert abs(green.mean() - share) < 0.05
    view.page.locator("#seek").fill("9")
    view.until(lambda: view.server.originals[-1]["time"] == "9")
    view.tab("cameras")
    view.page.locator("#originals").set_checked(False)
    view.until(card.is_hidden)
    view.page.locator("#originals").set_checked(True)
    view.until(card.is_visible)
    view.drag(40, 0)
    view.settle()
    assert card.is_hidden()
