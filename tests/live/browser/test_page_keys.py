"""Sequences of keys: whatever a person presses, neither half of the picture is empty."""

import itertools

import numpy as np
import pytest
from live.browser import scene
from live.browser.conftest import View, opened
from live.browser.stand_in import StandIn

pytestmark = pytest.mark.slow

KEYS = ("n", "b", "x", "r", "f", "g", "Space")
"""Keys that go to a camera, leave it out, or change how the view moves; `research/press_page_keys.py` presses more."""
MIN_FRACTION = 0.01
"""A half of the picture shows at least this fraction of pixels that are not background."""
BRIGHT = 40
"""Brighter pixels are not background."""
SEND_KEY = "([type, init]) => window.dispatchEvent(new KeyboardEvent(type, init))"
ALT_GR = ("ctrlKey", "altKey", "modifierAltGraph")
"""What browsers on Windows report while AltGr is held."""


def pairs(keys: tuple[str, ...]) -> list[str]:
    """A sequence of keys that has every pair of them, one after the other (de Bruijn)."""
    sequence: list[str] = []
    for n, key in enumerate(keys):
        sequence.append(key)
        for other in keys[n + 1 :]:
            sequence += [key, other]
    return [*sequence, keys[0]]


def fractions(view: View) -> list[float]:
    """The fraction of each half of the picture that shows something; of one half where there is no divider."""
    divider = view.page.locator("#divider")
    box = view.page.evaluate("Object.assign({}, document.querySelector('#divider').dataset)")
    left = round(float(box["left"]))
    right = round(left + float(box["width"]))
    shown = view.picture()[:, left:right].max(-1) > BRIGHT
    if divider.is_hidden():
        return [float(shown.mean())]
    return [float(half.mean()) for half in np.array_split(shown, 2, axis=1)]


def is_filled(view: View) -> bool:
    return min(fractions(view)) >= MIN_FRACTION


def test_the_sequence_has_every_pair():
    sequence = pairs(KEYS)
    assert len(set(itertools.pairwise(sequence))) == len(KEYS) ** 2


@pytest.mark.parametrize("mode", range(1, 10))
def test_no_pair_of_keys_leaves_half_of_the_picture_empty(browser, mode, record_property):
    with StandIn() as server, opened(browser, server) as view:
        view.settle()
        pressed = [str(mode), *pairs(KEYS)]
        for key in pressed:
            view.page.keyboard.press(key)
            view.until(lambda: is_filled(view))
    record_property("pairs_of_keys", len(pressed) - 2)
    print(f"mode {mode}: {len(pressed) - 2} pairs of keys, 0 failures")


def test_the_comparison_ends_where_it_began(browser, desktop):
    """Go to a camera, leave it out, use it again, and go home: the comparison with its image has ended."""
    for key in "nxxr":
        desktop.page.keyboard.press(key)
    desktop.settle()
    assert desktop.page.locator("#divider").is_hidden()
    assert desktop.page.locator("#modes [aria-checked=true]").get_attribute("data-value") == "completed"


def test_without_an_original_its_half_shows_the_completed_view_and_says_so(browser, desktop):
    for key in "nxr":
        desktop.page.keyboard.press(key)
    desktop.until(lambda: "only at a camera" in desktop.page.locator("#right-name").inner_text())
    desktop.until(lambda: is_filled(desktop))


def test_keys_between_two_repaints_act_on_the_newest_pose(browser, desktop):
    """A busy browser paints late: X leaves out the camera that N has just gone to, and none after R."""
    press = "codes => codes.forEach(code => window.dispatchEvent(new KeyboardEvent('keydown', { code })))"
    desktop.page.evaluate(press, ["KeyN", "KeyX", "KeyR", "KeyX"])
    desktop.until(lambda: desktop.server.looks[-1]["without"] == ["cam00"])
    desktop.until(lambda: "only at a camera" in desktop.page.locator("#right-name").inner_text())


def test_characters_act_wherever_the_keyboard_has_them(browser, desktop):
    """A German keyboard has "?" on the key of "-", "+" on that of "]", and "[" on that of "8", with AltGr."""
    page, server = desktop.page, desktop.server

    def send(event: str, key: str, code: str, alt_gr: bool = False) -> None:
        page.evaluate(SEND_KEY, [event, {"key": key, "code": code, **dict.fromkeys(ALT_GR, alt_gr)}])

    def distance() -> float:
        camera = server.looks[-1]["camera"]
        return float(np.linalg.norm(np.reshape(camera["R"], (3, 3)) @ scene.CENTER + camera["T"]))

    before = distance()
    desktop.until(f"document.querySelector('#seek').max === '{scene.FRAMES - 1}'")  # it has a clock
    send("keydown", "?", "Minus")
    assert page.get_by_role("dialog").is_visible()
    page.get_by_role("button", name="Close the help").click()
    send("keydown", "[", "Digit8", alt_gr=True)
    desktop.until(lambda: server.clocks)
    assert server.clocks[0]["speed"] < 1
    send("keydown", "+", "BracketRight")
    desktop.until(lambda: distance() < before - 0.1)
    send("keyup", "*", "BracketRight")  # shift was pressed meanwhile
    desktop.until(lambda: not server.looks[-1]["moving"])
    assert len(server.clocks) == 1 and server.looks[-1]["modes"] == ["completed"]


def test_a_view_at_rest_has_no_frame_rate_and_says_when_it_is_refined(browser, server):
    with opened(browser, server) as view:
        view.settle()
        view.until(lambda: view.page.locator("#readout").inner_text() == "")
        server.hold = True
        view.drag(80, 0)
        view.until(lambda: view.page.locator("#refining").is_visible())
        view.until("document.getElementById('refining-progress').value > 0.2")
        server.hold = False
        view.until(lambda: view.page.locator("#refining").is_hidden())
