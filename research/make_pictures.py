"""Makes the pictures of the README and the documents: python research/make_pictures.py [--only demo].

The contact sheet of `viewmend demo`, and photographs of the live page in Chromium, with the package as it is now.
Needs the extra `dev` and a Chromium.
"""

import argparse
import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
PAGE_PX = (1280, 800)
"""The page's width and height, pixels."""
QUALITY = 88
"""JPEG quality."""
TILE_PX = (260, 340)
"""An image of the demo's contact sheet has this width and height, pixels."""
DEMO_ROWS = 2
"""The demo's picture has this many frames of the contact sheet."""
DEMO_COLUMNS = (0, 1, 2, 3, 4, 5, 8)
"""The demo's picture has these columns of the contact sheet: inputs, rendered, holes, completed, true."""
DEMO_PX = 1600
"""The demo's picture has this width, pixels."""
STUDIO = ["--size", "512", "--cameras", "8", "--frames", "4"]
"""The synthetic scene that the page shows."""
PHOTOGRAPHS = {
    "live-page": ("?time=2&mode=completed", "n"),
    "live-page-light": ("?time=2&mode=split&left=rendered&right=completed&theme=light", ""),
    "live-page-hull": ("?time=2&mode=split&left=hull&right=points", ""),
}
"""The address and the key that give each picture of the page."""
SETTLED_MS = 5000
"""A completed view has replaced the drawn one after this time, milliseconds."""
WAIT_MS = 300_000
"""The page has this long for each step towards a completed view, milliseconds."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", choices=["demo", "page"], help="make these pictures only")
    parser.add_argument("--out", type=Path, default=PICTURES, help="folder for the pictures")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.only in (None, "demo"):
        photograph_demo(options.out)
    if options.only in (None, "page"):
        photograph_page(options.out)


def photograph_demo(out: Path) -> None:
    """The first frames of the demo's contact sheet, from the input cameras to the true view."""
    from viewmend.utils.contact_sheet import GAP_PX, LABEL_PX

    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "viewmend", "demo", "--out", f"{folder}/demo"]
        subprocess.run(command, check=True)
        sheet = cv2.imread(f"{folder}/demo/contact_sheet.png")
    width = TILE_PX[0] + GAP_PX
    height = DEMO_ROWS * (TILE_PX[1] + LABEL_PX + GAP_PX) + GAP_PX
    columns = [
        sheet[:height, GAP_PX + column * width : GAP_PX + (column + 1) * width] for column in DEMO_COLUMNS
    ]
    picture = np.hstack([sheet[:height, :GAP_PX], *columns])
    scale = DEMO_PX / picture.shape[1]
    write(out / "demo.jpg", cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))


def photograph_page(out: Path) -> None:
    """The live page in each of the states of `PHOTOGRAPHS`."""
    from playwright.sync_api import sync_playwright

    names = ("chromium", "chromium-browser", "google-chrome")
    executable = os.environ.get("VIEWMEND_CHROMIUM") or next(filter(None, map(shutil.which, names)), None)
    if executable is None:
        sys.exit("expected Chromium, found none; install it, or name it in VIEWMEND_CHROMIUM")
    with served() as address, sync_playwright() as control:
        browser = control.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        for name, (query, key) in PHOTOGRAPHS.items():
            page = browser.new_page(viewport={"width": PAGE_PX[0], "height": PAGE_PX[1]})
            page.set_default_timeout(WAIT_MS)  # the machine may be busy
            page.goto(address.rstrip("/") + "/" + query)
            page.wait_for_selector("#picture[data-look]")
            if key:
                page.keyboard.press(key)
            page.wait_for_timeout(2000)
            page.wait_for_selector("#picture[data-full=true]")
            page.wait_for_selector("#refining", state="hidden")
            page.wait_for_timeout(SETTLED_MS)
            with tempfile.TemporaryDirectory() as folder:
                page.screenshot(path=f"{folder}/page.png")
                write(out / f"{name}.jpg", cv2.imread(f"{folder}/page.png"))
            page.close()
        browser.close()


@contextlib.contextmanager
def served() -> Iterator[str]:
    """The address of a server that shows the synthetic scene."""
    command = [sys.executable, "-m", "viewmend", "serve", "studio", "--port", "0", *STUDIO]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        for line in server.stderr:
            if found := re.search(r"http://\S+", line):
                yield found.group()
                return
        sys.exit("expected the server's address, but it ended")
    finally:
        server.terminate()
        server.wait()


def write(file: Path, image) -> None:
    """Write a JPEG."""
    cv2.imwrite(str(file), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f"wrote {file}: {image.shape[1]} x {image.shape[0]}, {file.stat().st_size // 1024} KiB")


if __name__ == "__main__":
    main()
