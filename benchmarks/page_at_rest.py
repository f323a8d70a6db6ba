"""Seconds until a view at rest is completed: python benchmarks/page_at_rest.py ADDRESS [--turns 10] [--shot FILE].

ADDRESS is the page of a running `viewmend serve`. Chromium opens it at 1440 x 900, turns the view with the pointer,
and measures from its release until the page shows the server's completed picture. Start the server some time before:
it makes its completed virtual cameras first, which takes about 40 s for the capture wd2.
"""

import argparse
import json
import statistics
import time
from pathlib import Path

from live_chromium import chromium
from measure import write

SIZE_PX = {"width": 1440, "height": 900}
"""The window."""
START_PX = (500, 300)
"""Where the pointer begins to drag."""
END_PX = (560, 300)
"""Where it stops."""
TURN_STEPS = 6
"""Movements of the pointer in between."""
WAIT_MS = 120_000
"""A view may take this long, milliseconds."""
COMPLETED = "document.getElementById('picture')?.dataset.full === 'true'"
NOT_COMPLETED = "document.getElementById('picture').dataset.full === 'false'"


def main() -> None:
    """Turn the view, and wait."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("address", help="the address that `viewmend serve` prints")
    parser.add_argument("--turns", type=int, default=10, help="how often the view is turned")
    parser.add_argument("--shot", type=Path, help="file for a screenshot of the last view")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    waits_s = []
    errors: list[str] = []
    with chromium() as browser:
        page = browser.new_page(viewport=SIZE_PX, bypass_csp=True)
        page.on("pageerror", lambda error: errors.append(str(error)))
        start_s = time.monotonic()
        page.goto(options.address, wait_until="commit")
        page.wait_for_function(COMPLETED, timeout=WAIT_MS)
        first_s = time.monotonic() - start_s
        for _ in range(options.turns):
            page.mouse.move(*START_PX)
            page.mouse.down()
            page.mouse.move(*END_PX, steps=TURN_STEPS)
            page.wait_for_function(NOT_COMPLETED, timeout=WAIT_MS)
            page.mouse.up()
            start_s = time.monotonic()
            page.wait_for_function(COMPLETED, timeout=WAIT_MS)
            waits_s.append(time.monotonic() - start_s)
        if options.shot is not None:
            page.screenshot(path=str(options.shot))
    result = {
        "first_s": round(first_s, 2),
        "median_s": round(statistics.median(waits_s), 2),
        "longest_s": round(max(waits_s), 2),
        "errors": errors,
    }
    print(json.dumps(result))
    if options.write:
        print(write("page_at_rest", "cpu", {"turns": options.turns}, result))


if __name__ == "__main__":
    main()
