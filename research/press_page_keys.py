"""Press every pair of keys on the live page, from every mode: python research/press_page_keys.py [--modes 1 5].

The page of a stand-in server is opened in Chromium. In each mode, a sequence of keys is pressed that has every pair of
`KEYS`, one after the other, and twice the same. After each key, no half of the picture may stay empty. Keys that walk
are left out, since they may walk away from the subject, and so are those that open a dialog or save a file. Prints for
each mode how many pairs were tried, and which failed.
"""

import argparse
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests"))

from live.browser.conftest import find_chromium, opened
from live.browser.stand_in import StandIn
from live.browser.test_page_keys import is_filled, pairs
from playwright.sync_api import TimeoutError as PlaywrightTimeout
from playwright.sync_api import sync_playwright

KEYS = ("n", "b", "x", "r", "f", "g", "t", "h", "l", "Space", ",", ".", "[", "]", "c")
"""The keys that act once and leave the subject in view."""
MODES = range(1, 10)
"""The keys that choose what is shown."""
WAIT_S = 15.0
"""An empty half counts as a failure after this time, seconds."""


def main() -> None:
    """Press the keys, and print what was tried."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--modes", nargs="+", type=int, default=MODES, help="the number keys of the modes")
    options = parser.parse_args()
    tried = 0
    failed: list[tuple[int, str, str]] = []
    with sync_playwright() as control:
        browser = control.chromium.launch(executable_path=find_chromium(), args=["--no-sandbox"])
        for mode in options.modes:
            sequence = pairs(KEYS)
            empty = press(browser, mode, sequence)
            tried += len(sequence) - 1
            failed += empty
            print(f"mode {mode}: {len(sequence) - 1} pairs, {len(empty)} failures {empty}", flush=True)
        browser.close()
    print(f"{tried} pairs of {len(KEYS)} keys in {len(options.modes)} modes, {len(failed)} failures")


def press(browser, mode: int, sequence: list[str]) -> list[tuple[int, str, str]]:
    """The pairs of a sequence after which a half of the picture stayed empty, or no picture came, with the mode."""
    failed = []
    with StandIn() as server, opened(browser, server) as view:
        view.settle()
        before = str(mode)
        view.page.keyboard.press(before)
        for key in sequence:
            view.page.keyboard.press(key)
            try:
                view.until(lambda: is_filled(view), WAIT_S)
            except (AssertionError, PlaywrightTimeout):
                failed.append((mode, before, key))
            before = key
    return failed


if __name__ == "__main__":
    main()
