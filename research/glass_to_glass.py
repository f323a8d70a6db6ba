"""Glass to glass of a live rig: python research/glass_to_glass.py [--cameras 8] [--size 320].

A process pushes frames of the studio to `viewmend serve live` in real time. The subject of each has one colour of 27,
which tells the frame in the page of a headless Chromium (software WebGL): the centre of the canvas is read back right
after each paint. Prints the time from handing a frame to `Publisher.push` until its pixels are on the canvas, and the
frames shown per second. Cameras and displays add their own delays, which are not part of this. Needs playwright.
"""

import argparse
import json
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.connection import Connection

import benchmarks_path  # noqa: F401
import torch
from measure import summarise
from playwright.sync_api import sync_playwright

from viewmend.live.client import Publisher
from viewmend.studio.stage import Studio, StudioConfig

NAMES = ("chromium", "chromium-browser", "google-chrome")
LEVELS = (40, 140, 240)
CODES = [(r, g, b) for r in LEVELS for g in LEVELS for b in LEVELS]
STEP = 10
"""Between the codes of successive frames, so that they differ in more than one channel."""
WATCH = """
window.seen = [];
const getContext = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (...given) {
  const context = getContext.apply(this, given);
  if (given[0] === "webgl2" && this.id === "picture") window.gl = context;
  return context;
};
const request = window.requestAnimationFrame;
const pixel = new Uint8Array(4);
window.requestAnimationFrame = (work) => request.call(window, (now) => {
  work(now);
  const gl = window.gl;
  if (!gl) return;
  gl.readPixels(gl.drawingBufferWidth / 2, gl.drawingBufferHeight / 2, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
  const at = performance.timeOrigin + performance.now();
  if (pixel[0] + pixel[1] + pixel[2]) window.seen.push([at / 1000, ...pixel.subarray(0, 3)]);
});
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


def send(address: str, options: argparse.Namespace, results: Connection) -> None:
    """Push frames for some seconds; gives the time at which each was handed over."""
    studio = Studio(
        StudioConfig(seed=10021, cameras=options.cameras, size_px=options.size, fps=options.fps, frames=8)
    )
    frames = [studio.read(n) for n in range(8)]
    colours = torch.tensor(CODES, dtype=torch.uint8)
    sent: list[float] = []
    with Publisher(studio.cameras, address, fps=options.fps, up=studio.up, bounds=studio.bounds) as rig:
        results.send("ready")
        begun = time.monotonic()
        while (now := time.monotonic() - begun) < options.seconds:
            time.sleep(max(0.0, len(sent) / options.fps - now))
            n = len(sent)
            frame, colour = frames[n % len(frames)], colours[STEP * n % len(CODES)]
            assert frame.mask is not None
            sent.append(time.time())
            rig.push(replace(frame, rgb=colour.view(1, 3, 1, 1) * (frame.mask > 0).unsqueeze(1)))
    results.send(sent)


def latencies(sent: list[float], seen: list[list[float]]) -> list[float]:
    """Milliseconds from a frame's sending to its first paint, of the frames that were shown."""
    first: dict[int, float] = {}
    for at, *rgb in seen:
        code = min(
            range(len(CODES)), key=lambda n: max(abs(a - b) for a, b in zip(rgb, CODES[n], strict=True))
        )
        newest = max(
            (n for n, time_s in enumerate(sent) if time_s <= at and STEP * n % len(CODES) == code),
            default=None,
        )
        if newest is not None:
            first.setdefault(newest, at)
    return [1000 * (at - sent[n]) for n, at in first.items()]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cameras", type=int, default=8)
    parser.add_argument("--size", type=int, default=320, help="side of the cameras' images")
    parser.add_argument("--fps", type=float, default=15.0)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--page", type=int, nargs=2, default=(1440, 900), help="size of the browser's window")
    options = parser.parse_args()
    chromium = os.environ.get("VIEWMEND_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)))
    context = multiprocessing.get_context("spawn")
    with served(["live"]) as address, sync_playwright() as control:
        ours, theirs = context.Pipe()
        rig = context.Process(target=send, args=(address.rstrip("/").replace("http", "ws"), options, theirs))
        rig.start()
        ours.recv()
        browser = control.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": options.page[0], "height": options.page[1]})
        page.add_init_script(WATCH)
        page.goto(address)
        while not ours.poll():
            page.wait_for_timeout(200)
        sent, seen = ours.recv(), page.evaluate("window.seen")
        rig.join()
        browser.close()
    settled = [row for row in seen if row[0] > seen[0][0] + 5]
    taken = latencies(sent, settled)
    shown_per_s = len(taken) / (settled[-1][0] - settled[0][0])
    pushed_per_s = (len(sent) - 1) / (sent[-1] - sent[0])
    rates = {"pushed_per_s": round(pushed_per_s, 1), "shown_per_s": round(shown_per_s, 1)}
    print(json.dumps(vars(options) | rates | summarise(taken) | {"load": round(os.getloadavg()[0], 1)}))


if __name__ == "__main__":
    main()
