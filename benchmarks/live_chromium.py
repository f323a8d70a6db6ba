"""Chromium for benchmarks of the page; the name or path of another one is in VIEWMEND_CHROMIUM."""

import contextlib
import os
import shutil
import sys
from collections.abc import Iterator
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """A running browser."""
    from playwright.sync_api import sync_playwright

    executable = os.environ.get("VIEWMEND_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if executable is None:
        sys.exit("expected Chromium, found none; install it, or name it in VIEWMEND_CHROMIUM")
    with sync_playwright() as control:
        browser = control.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield browser
        browser.close()
