"""Latency of the live page in Chromium: PYTHONPATH=benchmarks python research/live_browser.py [--write].

`viewmend serve` and a headless Chromium (software WebGL) share this machine. A key is held so that the view orbits back
and forth. "Pose to pixel" is the time from sending a pose to drawing the image that answers it. Measured once while the
studio still generates its frames, and then with all frames available. Needs playwright.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from urllib.parse import urlencode

from measure import summarise, write
from playwright.sync_api import Page, sync_playwright

SIZES = ("320x320", "512x612")
CODECS = ("jpeg", "vp9", "h264")
NAMES = ("chromium", "chromium-browser", "google-chrome")
SWING_MS = 1500
COLLECT = """
() => {
  const canvas = document.querySelector('#picture');
  canvas.seen = [];
  canvas.addEventListener('framepainted', ({detail: {header, bytes, latency_ms}}) => canvas.seen.push(
    {now: performance.now(), latency: latency_ms, bytes, width: header.width, height: header.height,
     holes: header.holes, stages: header.stage_ms}));
}
"""


@contextmanager
def served(options: list[str]) -> Iterator[str]:
    """The address of `viewmend serve` in another process."""
    command = [sys.executable, "-m", "viewmend", "serve", "--port", "0", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            assert process.stdout is not None
            found = (re.search(r"http://\S+", line) for line in process.stdout)
            yield next(address.group() for address in found if address)
        finally:
            process.terminate()


def start(page: Page, address: str, since: float) -> dict[str, float]:
    """Seconds until the page, the first image, and the first image of another frame appear."""
    page.goto(address)
    taken = {"page_s": time.monotonic() - since}
    page.wait_for_selector("#picture[data-frame]", timeout=120_000)
    taken["first_picture_s"] = time.monotonic() - since
    if page.locator("#seek").get_attribute("max") == "0":  # nothing moves
        return {name: round(seconds, 1) for name, seconds in taken.items()}
    first = page.locator("#picture").get_attribute("data-time")
    page.wait_for_selector(f"#picture[data-time]:not([data-time='{first}'])", timeout=120_000)
    taken["moving_s"] = time.monotonic() - since
    return {name: round(seconds, 1) for name, seconds in taken.items()}


def wait_until_made(page: Page, address: str) -> None:
    """Wait until the source has generated all frames."""
    count = page.evaluate("+document.querySelector('#seek').max + 1")
    made = 0
    while made < count:
        page.wait_for_timeout(500)
        with urllib.request.urlopen(f"{address.rstrip('/')}/metrics", timeout=10) as answer:
            found = re.search(r"^viewmend_source_frames (\d+)", answer.read().decode(), re.MULTILINE)
        made = int(found[1]) if found else 0


def swing(page: Page, seconds: float) -> tuple[list[dict], list[float]]:
    """Orbit back and forth; the frames received, and repaints per second."""
    page.locator("#picture").focus()
    repaints = []
    for n in range(max(1, round(1000 * seconds / SWING_MS))):
        key = ("ArrowRight", "ArrowLeft")[n % 2]
        page.keyboard.down(key)
        page.wait_for_timeout(SWING_MS)
        page.keyboard.up(key)
        repaints.append(float(page.locator("#figure-repaints").inner_text()))
    return page.evaluate("document.querySelector('#picture').seen"), repaints[1:] or repaints


def rest(page: Page) -> dict[str, object]:
    """Time until a resting view has its final resolution."""
    page.locator("#picture").focus()
    page.keyboard.press("Space")  # the clock stops
    page.keyboard.down("ArrowRight")
    page.wait_for_timeout(SWING_MS)
    page.evaluate(COLLECT)
    page.keyboard.up("ArrowRight")
    still = page.evaluate("performance.now()")
    page.wait_for_timeout(6000)
    seen = page.evaluate("document.querySelector('#picture').seen")
    page.keyboard.press("Space")
    most = max(frame["height"] for frame in seen)
    return {
        "canvas": page.evaluate("(c => [c.width, c.height])(document.querySelector('#picture'))"),
        "largest": next([frame["width"], frame["height"]] for frame in seen if frame["height"] == most),
        "largest_after_s": round(next(f["now"] - still for f in seen if f["height"] == most) / 1000, 2),
        "last_after_s": round((seen[-1]["now"] - still) / 1000, 2),
    }


def figures(seen: list[dict], repaints: list[float]) -> dict[str, object]:
    latencies = [frame["latency"] for frame in seen if frame["latency"] is not None]
    seconds = (seen[-1]["now"] - seen[0]["now"]) / 1000
    stages = seen[0]["stages"]
    mean = lambda values: round(sum(values) / len(values), 2)  # noqa: E731
    return {
        "frames": len(seen),
        "pose_to_pixel": summarise(latencies),
        "fps": round((len(seen) - 1) / seconds, 1),
        "repaints_per_s": mean(repaints),
        "kb_per_frame": mean([frame["bytes"] / 1000 for frame in seen]),
        "width_mean": mean([frame["width"] for frame in seen]),
        "height_mean": mean([frame["height"] for frame in seen]),
        "holes_mean": round(sum(frame["holes"] for frame in seen) / len(seen), 4),
        "stage_ms": {name: mean([frame["stages"][name] for frame in seen]) for name in stages},
    }


def measure(page: Page, address: str, query: dict[str, object], seconds: float) -> dict[str, object]:
    page.goto(f"{address}?{urlencode(query)}")
    page.wait_for_selector("#picture[data-frame]", timeout=120_000)
    offered = page.locator("#codec option").evaluate_all("all => all.map(e => e.value)")
    if query["codec"] not in offered:
        return {"skipped": f"unsupported codec {query['codec']}"}
    page.wait_for_timeout(2000)
    swing(page, 2 * SWING_MS / 1000)  # warms up
    page.evaluate(COLLECT)
    seen, repaints = swing(page, seconds)
    return figures(seen, repaints)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", help="a capture instead of the studio")
    parser.add_argument("--seconds", type=float, default=20, help="duration per size and codec")
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="WIDTHxHEIGHT, or 'page' for the page's own size")
    parser.add_argument("--page", default="1280x800", help="size of the browser window")
    parser.add_argument("--codecs", nargs="+", default=CODECS)
    parser.add_argument("--mode", default="mended")
    parser.add_argument("--model", default="views")
    parser.add_argument("--budget-ms", type=float, default=100, help="time budget of the server; 0 for full quality")
    parser.add_argument("--full-size", action="store_true", help="full resolution while moving")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    chromium = os.environ.get("VIEWMEND_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)))
    results: dict[str, object] = {}
    since = time.monotonic()
    served_with = [*filter(None, [options.source]), "--model", options.model, "--budget-ms", str(options.budget_ms)]
    with served(served_with) as address, sync_playwright() as control:
        browser = control.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        width, height = map(int, options.page.split("x"))
        page = browser.new_page(viewport={"width": width, "height": height})
        results["start"] = start(page, address, since)
        print("start", json.dumps(results["start"]), flush=True)
        cases = [(f"{size} {codec}", size, codec) for size in options.sizes for codec in options.codecs]
        first = (f"{cases[0][0]}, first seconds", *cases[0][1:])
        for label, size, codec in (first, *cases):
            query = {"codec": codec, "mode": options.mode, "adaptive": int(not options.full_size)}
            query |= {} if size == "page" else {"size": size}
            results[label] = measure(page, address, query, options.seconds)
            if size == "page":
                results[label]["rest"] = rest(page)
            print(label, json.dumps(results[label]), flush=True)
            wait_until_made(page, address)
        browser.close()
    if options.write:
        print(write("live_browser", "cpu", vars(options), results))


if __name__ == "__main__":
    main()
