"""Open published pages in Chromium over a slow line: python benchmarks/published_page.py FOLDER ... [--shots OUT].

Each FOLDER, which `viewmend publish` wrote, is served below a path by the server of `python -m http.server`, whose
answers share a line of --mbit megabits per second. It is opened on a large screen, on a phone and in an iframe. The
script prints seconds and megabytes until the poster and until the first drawn picture, the painted views per second
while a pointer turns the view, and what the console reports, which should be nothing; and the browser's processor
seconds until the first picture and for each painted view, which other programs on the machine hardly change.
"""

import argparse
import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from live_chromium import chromium, processor_s
from measure import write

LATENCY_S = 0.04
"""Seconds before the answer to each request."""
BLOCK_BYTES = 16384
"""Bytes that are sent at a time."""
TURNING_S = 5.0
"""Seconds of turning the view to count the painted ones."""
WAIT_MS = 900_000
"""The first picture may take this long, milliseconds."""
SCREENS = {
    "desktop": ((1440, 900), False),
    "phone": ((390, 844), True),
    "iframe": ((1440, 900), False),
}
"""Width and height of each screen in pixels, and whether it is a touch screen."""
POSTER_SHOWN = """() => { const poster = document.getElementById("poster");
  return !poster || (poster.complete && poster.naturalWidth > 0); }"""
DRAWN = "document.getElementById('picture')?.dataset.drawn !== undefined"
COUNT_PAINTS = """() => { window.paints = 0; const { clear } = WebGL2RenderingContext.prototype;
  WebGL2RenderingContext.prototype.clear = function (mask) { window.paints += 1; clear.call(this, mask); }; }"""


@dataclass(frozen=True)
class Opening:
    """How a page opened."""

    poster_s: float
    poster_mb: float
    first_picture_s: float
    first_picture_mb: float
    paints_per_s: float
    """Calls that clear the canvas; one for each painted view."""
    first_picture_cpu_s: float
    """Processor seconds of the browser until the first drawn picture."""
    paint_cpu_s: float
    """Processor seconds of the browser for each painted view."""
    errors: list[str]


class Line:
    """A line of limited speed that all answers share."""

    def __init__(self, megabits_per_s: float) -> None:
        self._bytes_per_s = megabits_per_s * 1e6 / 8
        self._lock = threading.Lock()
        self._free_s = 0.0
        self.sent_bytes = 0

    def send(self, size: int) -> None:
        """Wait until a block has gone over the line."""
        with self._lock:
            now = time.monotonic()
            self._free_s = max(self._free_s, now) + size / self._bytes_per_s
            wait_s = self._free_s - now
            self.sent_bytes += size
        time.sleep(max(0.0, wait_s))


@contextmanager
def served(folder: Path, line: Line) -> Iterator[str]:
    """The address of a web server for a folder."""

    class Handler(SimpleHTTPRequestHandler):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, directory=str(folder), **options)

        def do_GET(self) -> None:
            time.sleep(LATENCY_S)
            if self.path.startswith("/framed/"):
                name = self.path.removeprefix("/framed/")
                body = f'<link rel="icon" href="data:,"><iframe src="/{name}/" width="1000" height="640"></iframe>'
                self.send_response(200)
                self.send_header("Content-Type", "text/html")
                self.end_headers()
                self.wfile.write(body.encode())
            else:
                super().do_GET()

        def copyfile(self, source: Any, outputfile: Any) -> None:
            with suppress(ConnectionError):  # the page was closed while it loaded the rest
                while block := source.read(BLOCK_BYTES):
                    line.send(len(block))
                    outputfile.write(block)

        def log_message(self, format: str, *values: Any) -> None:
            """Log nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()


def main() -> None:
    """Open every folder on every screen."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--mbit", type=float, default=20.0, help="speed of the line, megabits per second")
    parser.add_argument("--shots", type=Path, help="folder for a screenshot of each page")
    parser.add_argument("--write", action="store_true", help="write the result to benchmarks/results")
    options = parser.parse_args()
    results = {}
    with chromium() as browser:
        for folder in options.folders:
            for screen in SCREENS:
                name = f"{folder.name}, {screen}"
                shot = None if options.shots is None else options.shots / f"{folder.name}-{screen}.png"
                results[name] = asdict(open_page(browser, folder.resolve(), screen, options.mbit, shot))
                print(name, json.dumps(results[name]), flush=True)
    if options.write:
        print(write("published_page", "cpu", {"mbit": options.mbit}, results))


def open_page(browser: Any, folder: Path, screen: str, mbit: float, shot: Path | None) -> Opening:
    """Open a published page, and turn the view."""
    (width, height), has_touch = SCREENS[screen]
    line = Line(mbit)
    errors: list[str] = []
    with served(folder.parent, line) as address:
        context = browser.new_context(viewport={"width": width, "height": height}, has_touch=has_touch)
        page = context.new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        start_s = time.monotonic()
        start_cpu_s = processor_s()
        if screen == "iframe":
            page.goto(f"{address}framed/{folder.name}", wait_until="commit")
            page.wait_for_selector("iframe", state="attached")
            inside = page.frame_locator("iframe").locator("#picture")
            inside.wait_for(state="attached", timeout=WAIT_MS)
            shown = page.frames[1]
        else:
            page.goto(f"{address}{folder.name}/", wait_until="commit")
            shown = page
        shown.wait_for_function(POSTER_SHOWN, timeout=WAIT_MS)
        poster_s = time.monotonic() - start_s
        poster_bytes = line.sent_bytes
        shown.wait_for_function(DRAWN, timeout=WAIT_MS)
        picture_s = time.monotonic() - start_s
        picture_bytes = line.sent_bytes
        picture_cpu_s = processor_s() - start_cpu_s
        paints_per_s, paint_cpu_s = turn(page, shown, width, height)
        if shot is not None:
            shot.parent.mkdir(parents=True, exist_ok=True)
            page.screenshot(path=str(shot))
        context.close()
    return Opening(
        round(poster_s, 1),
        round(poster_bytes / 1e6, 2),
        round(picture_s, 1),
        round(picture_bytes / 1e6, 2),
        round(paints_per_s, 1),
        round(picture_cpu_s, 2),
        round(paint_cpu_s, 3),
        errors,
    )


def turn(page: Any, shown: Any, width: int, height: int) -> tuple[float, float]:
    """Turn the view with the pointer; returns painted views per second, and the browser's processor seconds of each."""
    shown.evaluate(COUNT_PAINTS)
    start_s = time.monotonic()
    start_cpu_s = processor_s()
    x = width // 3
    page.mouse.move(x, height // 3)
    page.mouse.down()
    while time.monotonic() - start_s < TURNING_S:
        x = (x + 7) % width
        page.mouse.move(x, height // 3)
        page.wait_for_timeout(16)
    page.mouse.up()
    paints = shown.evaluate("window.paints")
    return paints / (time.monotonic() - start_s), (processor_s() - start_cpu_s) / max(1, paints)


if __name__ == "__main__":
    main()
