"""A real Chromium, and pages of it that look at a stand-in server; skipped where there is none."""

import contextlib
import os
import shutil
import time
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from live.browser.stand_in import StandIn

SCREENSHOT_S = 300.0
"""How long a page may take on a busy machine, seconds."""
THREE_REFRESHES = (
    "new Promise(done => {"
    " const next = n => n ? requestAnimationFrame(() => next(n - 1)) : done(); next(3); })"
)
"""Waits for three refreshes: of two in a row, a page without a GPU may leave one out."""
SIZES = {"desktop": (1280, 800), "phone": (390, 844)}


def find_chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return os.environ.get("VIEWMEND_CHROMIUM") or next(filter(None, map(shutil.which, names)), None)


@pytest.fixture(scope="session")
def browser():
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs the extra: pip install 'viewmend[dev]'"
    )
    executable = find_chromium()
    if executable is None:
        pytest.skip("no Chromium: install the system's package, or name one in VIEWMEND_CHROMIUM")
    with playwright.sync_playwright() as control:
        opened = control.chromium.launch(executable_path=executable, args=["--no-sandbox"])
        yield opened
        opened.close()


class View:
    """A page and what a test does with it."""

    def __init__(self, page, server, errors: list[str]) -> None:
        self.page, self.server, self.errors = page, server, errors

    def until(self, condition: str | Callable[[], object], seconds: float = SCREENSHOT_S) -> None:
        """Wait for a JavaScript expression or a function to be true."""
        end = time.monotonic() + seconds
        while not (self.page.evaluate(condition) if isinstance(condition, str) else condition()):
            assert time.monotonic() < end, f"waited {seconds} s for {condition}"
            self.page.wait_for_timeout(20)

    def data(self, name: str) -> str | None:
        return self.page.locator("#picture").get_attribute(f"data-{name}")

    def settle(self) -> None:
        """Wait until the picture is the full answer to the last look, and the view rests."""
        self.page.evaluate(THREE_REFRESHES)  # until then, the last look may be that before what the test did
        self.page.wait_for_timeout(60)

        def answered() -> bool:
            looks = self.server.looks
            return bool(looks) and not looks[-1].get("moving") and self.data("look") == str(looks[-1]["id"])

        self.until(answered)
        self.page.wait_for_timeout(200)
        self.until(answered)

    def pixels(self) -> np.ndarray:
        """What a person sees, (height, width, 3) RGB."""
        screenshot = np.frombuffer(self.page.screenshot(), np.uint8)
        return cv2.imdecode(screenshot, cv2.IMREAD_COLOR)[..., ::-1].astype(int)

    def picture(self) -> np.ndarray:
        """The canvas alone, as it is painted."""
        controls = "header, aside, footer, nav, .labels, .divider, .corner, .cover, .toasts"
        hidden = f"{controls} {{ visibility: hidden !important }}"
        style = self.page.add_style_tag(content=hidden)
        shown = self.pixels()
        style.evaluate("e => e.remove()")
        return shown

    def drag(self, dx: int, dy: int, button: str = "left", steps: int = 4) -> None:
        x, y = self.middle()
        mouse = self.page.mouse
        mouse.move(x, y)
        mouse.down(button=button)
        mouse.move(x + dx, y + dy, steps=steps)
        mouse.up(button=button)

    def middle(self) -> tuple[float, float]:
        """Of the part of the page that nothing covers."""
        x, y = self.page.evaluate(
            "['--middle', '--centre'].map(n => parseFloat(document.body.style.getPropertyValue(n)))"
        )
        return x, y

    def tab(self, name: str) -> None:
        """Open a section of the controls where they lie behind tabs."""
        tab = self.page.locator(f"#tabs button[data-section={name}]")
        if tab.is_visible() and tab.get_attribute("aria-expanded") == "false":
            tab.click()


# Tests ask for small pictures at rest too, unless that is what they test: the stand-in traces each ray.
@contextlib.contextmanager
def opened(
    browser, server, size="desktop", query="?sharp=0", route=None, script="", **options
) -> Iterator[View]:
    """A page of a server or the stand-in, without errors.

    `route` answers its requests for assets, which may fail; `script` is JavaScript that runs before the page's own.
    """
    width, height = SIZES[size]
    touch = {"has_touch": True, "is_mobile": True} if size == "phone" else {}
    context = browser.new_context(viewport={"width": width, "height": height}, **touch, **options)
    context.set_default_timeout(1000 * SCREENSHOT_S)
    context.add_init_script(script)
    page = context.new_page()
    errors: list[str] = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda m: errors.append(m.text) if m.type == "error" and route is None else None)
    if route is not None:
        page.route("**/assets/**", route)
    page.goto(f"{server.url.rstrip('/')}/{query}")
    try:
        yield View(page, server, errors)
    finally:
        if browser.is_connected():  # without a browser, closing waits for ever
            context.close()
    assert not errors, errors


@pytest.fixture
def server() -> Iterator[StandIn]:
    with StandIn() as started:
        yield started


@pytest.fixture(params=list(SIZES))
def view(browser, server, request) -> Iterator[View]:
    """A page that shows its first full picture, at both sizes."""
    with opened(browser, server, request.param) as one:
        one.settle()
        yield one


@pytest.fixture
def desktop(browser, server) -> Iterator[View]:
    with opened(browser, server) as one:
        one.settle()
        yield one
