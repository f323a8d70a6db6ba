"""Sequences of keys: whatever a person presses, neither half of the picture is empty."""

import itertools

import numpy as np
import pytest
from live.browser.conftest import View, opened
from live.browser.stand_in import StandIn

pytestmark = pytest.mark.slow

KEYS = ("n", "b", "x", "r", "f", "g", "Space")
MIN_FRACTION = 0.01
"""A half of the picture shows at least this fraction of pixels that are not background."""
BRIGHT = 40
"""Brighter pixels are not background."""


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
def test_no_pair_of_keys_leaves_half_of_the_picture_empty(browser, mode):
    with StandIn() as server, opened(browser, server) as view:
        view.settle()
        pressed = [f"Digit{mode}"]
        for key in (str(mode), *pairs(KEYS)):
            view.page.keyboard.press(key)
            pressed.append(key)
            view.until(lambda: is_filled(view))


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
    desktop.settle()
    assert "only at a camera" in desktop.page.locator("#right-name").inner_text()
    assert is_filled(desktop)


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
