"""A published folder in Chromium, served by `python -m http.server` below a path, and in an iframe."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from live.browser.conftest import SCREENSHOT_S, SIZES, View
from published_ball import FRAMES, published  # noqa: F401

from viewmend.live.assets import COMPLETED_SOURCES

pytestmark = pytest.mark.slow

FRAME = """<link rel="icon" href="data:,"><body style="margin:1000px 0 0">
<iframe src="some/ball/index.html#time=0" style="width:900px;height:600px;border:0"></iframe>"""
DRAWN = """Array.from([window, window[0] ?? window]).some(
  page => page.document.querySelector("#picture")?.dataset.drawn !== undefined)"""
STEPPED_CLOCK = """(() => {
  const refresh = window.requestAnimationFrame.bind(window);
  let now = 0;
  performance.now = () => now;
  window.requestAnimationFrame = react => refresh(() => react(now += 25));
  window.shown = [];
  window.addEventListener("framedrawn", ({ target: { dataset } }) => {
    if (Number(dataset.drawn) !== shown.at(-1)) shown.push(Number(dataset.drawn));
  }, true);
})()"""
"""Lets time pass by a quarter of a frame at each refresh, and lists the frames that the page shows."""
SLOW_REFRESHES = """(() => {
  const refresh = window.requestAnimationFrame.bind(window);
  window.requestAnimationFrame = react => refresh(now => react(10 * now));
})()"""
"""Lets the page find its refreshes too slow."""


@pytest.fixture(scope="module")
def host(published):  # noqa: F811
    """The address of the folder two above the performance, which has a page with an iframe, too."""
    root = published.parents[1]
    (root / "frame.html").write_text(FRAME)
    command = [
        sys.executable,
        "-u",
        "-m",
        "http.server",
        "--bind",
        "127.0.0.1",
        "--directory",
        str(root),
        "0",
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        assert server.stdout is not None
        yield re.findall(r"http://[\d.]+:\d+/", server.stdout.readline())[0]
        server.terminate()


class Performance(View):
    """The published page; all its requests and errors are recorded.

    `routes` answer requests, by pattern; `script` is JavaScript that runs before the page's own.
    """

    def __init__(self, browser, url, size="desktop", routes=None, script="", drawn=DRAWN) -> None:
        width, height = SIZES[size]
        touch = {"has_touch": True, "is_mobile": True} if size == "phone" else {}
        self.context = browser.new_context(viewport={"width": width, "height": height}, **touch)
        self.context.set_default_timeout(1000 * SCREENSHOT_S)
        self.context.add_init_script(script)
        super().__init__(self.context.new_page(), None, [])
        self.drawn = drawn
        for pattern, answer in (routes or {}).items():
            self.page.route(pattern, answer)
        self.asked: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        self.page.goto(url)

    def __enter__(self):
        self.until(self.drawn, SCREENSHOT_S)
        return self

    def __exit__(self, *_):
        self.context.close()
        assert not self.errors, self.errors

    def paused(self, time: int) -> np.ndarray:
        """The canvas with this frame, at rest."""
        self.until(lambda: self.data("drawn") == str(time), SCREENSHOT_S)
        self.page.wait_for_timeout(500)
        return self.picture()


class LateFrames:
    """Answers the requests for the files of a frame once it is released."""

    def __init__(self) -> None:
        self.asked: set[int] = set()
        self.released: set[int] = set()
        self.held: list = []

    def __call__(self, route) -> None:
        time = int(re.findall(r"/frames/(\d+)/", route.request.url)[0])
        self.asked.add(time)
        if time in self.released:
            route.continue_()
        else:
            self.held.append(route)

    def release(self, time: int) -> None:
        self.released.add(time)
        held, self.held = self.held, []
        for route in held:
            self(route)


def middle_of(picture: np.ndarray) -> np.ndarray:
    """The pixels around the subject."""
    height, width, _ = picture.shape
    return picture[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]


def test_the_first_picture_appears_and_orbiting_changes_it(browser, host):
    with Performance(browser, f"{host}some/ball/#time=0") as page:
        shown = page.paused(0)
        assert (middle_of(shown).max(-1) > 60).mean() > 0.05, "the ball"
        assert page.page.locator("#poster").count() == 0 and page.page.locator("#cover").is_hidden()
        assert page.page.title() == "A <ball>"
        page.drag(160, 0)
        page.until(lambda: np.abs(page.picture() - shown).mean() > 1)
        page.until(lambda: "pose=" in page.page.url)
        page.page.evaluate(SLOW_REFRESHES)
        page.page.keyboard.down("ArrowRight")
        page.until("picture.width < innerWidth")
        page.page.keyboard.up("ArrowRight")
        page.until("picture.width === innerWidth")
        assert all(url.startswith((f"{host}some/ball/", "blob:", "data:")) for url in page.asked), (
            "nothing else is asked for"
        )
        assert page.page.locator("#modes button").all_inner_texts() == [
            "Rendered",
            "Holes",
            "Completed",
            "Side by side",
        ]


def test_a_link_restores_pose_frame_and_mode(browser, host):
    with Performance(browser, f"{host}some/ball/#time=2&mode=rendered") as page:
        home = page.paused(2)
        page.drag(90, 40)
        page.until(lambda: "pose=" in page.page.url and "time=2" in page.page.url)
        page.page.wait_for_timeout(500)
        shown, link = page.picture(), page.page.url
    with Performance(browser, link) as page:
        assert np.abs(page.paused(2) - shown).mean() < 0.2
        assert page.page.locator("#modes [aria-checked=true]").inner_text() == "Rendered"
        page.page.evaluate("location.hash = 'time=2&mode=rendered'")
        page.until(lambda: np.abs(page.picture() - home).mean() < 0.2)
        page.page.evaluate("location.hash = 'mode=split&left=holes&right=rendered'")
        page.until("picture.dataset.drawn !== '2'")  # it plays
        assert page.page.locator("#left-name").inner_text() == "Holes"
        assert page.page.locator("#right-name").inner_text() == "Rendered"


def test_links_to_what_a_performance_does_not_have_show_what_it_has(browser, host):
    with Performance(browser, f"{host}some/ball/#time=5") as page:
        last = page.paused(FRAMES - 1)
        page.page.wait_for_timeout(1200)
        assert page.data("drawn") == str(FRAMES - 1)
        page.page.evaluate("location.hash = 'time=3&mode=depth'")
        page.page.wait_for_timeout(300)
        assert np.abs(page.picture() - last).mean() < 0.2
        assert page.page.locator("#modes [aria-checked=true]").inner_text() == "Completed"


def test_the_time_line_plays_and_seeks(browser, host):
    scene: list = []

    def hold(route) -> None:
        scene.append(route)

    routes = {"**/scene.json": hold}
    with Performance(browser, f"{host}some/ball/", routes=routes, drawn="true") as page:
        page.page.keyboard.press("Space")
        page.page.locator("#speed").select_option("2")
        page.until(lambda: scene)
        scene[0].continue_()
        page.until("picture.dataset.drawn === '0'")
        play = page.page.locator("#play")
        assert play.get_attribute("aria-label") == "Play", "paused before the performance had loaded"
        assert page.page.locator("#speed").input_value() == "2"
        play.click()
        seen = set()

        def all_played() -> bool:
            seen.add(page.data("drawn"))
            return seen >= {str(time) for time in range(FRAMES)}

        page.until(all_played, SCREENSHOT_S)
        page.page.locator("#seek").fill("3")
        page.page.keyboard.press("Space")
        page.page.locator("#seek").fill("1")
        page.paused(1)
        assert page.page.locator("#time").inner_text() == f"2 / {FRAMES}"


def test_playback_waits_for_late_frames(browser, host):
    frames = LateFrames()
    routes = {"**/frames/**": frames}
    url = f"{host}some/ball/"
    with Performance(browser, url, routes=routes, script=STEPPED_CLOCK, drawn="true") as page:

        def shown_later() -> list[int]:
            """The frames that were shown until half a second from now, the time of five frames."""
            later = page.page.evaluate("performance.now()") + 500
            page.until(f"performance.now() > {later}")
            return page.page.evaluate("shown")

        page.until(lambda: frames.asked)
        assert shown_later() == []
        assert frames.asked == {0}
        frames.release(0)
        page.until("shown.length > 0")
        assert shown_later() == [0]
        assert page.page.locator("#pill").inner_text() == "Waiting for frames"
        page.page.locator("#seek").fill("3")
        frames.release(3)
        page.until("shown.length > 1")
        frames.release(1)
        assert shown_later() == [0, 3]
        frames.release(2)
        page.until("shown.length > 9")
        assert page.page.evaluate("shown.slice(0, 10)") == [0, 3, 0, 1, 2, 3, 0, 1, 2, 3]
        assert page.page.locator("#pill").is_hidden()


def test_completed_views_are_used_for_completed_and_not_for_rendered(browser, host, published):  # noqa: F811
    for mode, uses in (("completed", True), ("rendered", False)):
        with Performance(browser, f"{host}some/ball/#time=0&mode={mode}") as page:
            page.paused(0)
            first = [url for url in page.asked if "/frames/0/" in url and "shape" not in url][:3]
            completed = [int(re.findall(r"/(\d+)\.bin", url)[0]) >= 6 for url in first]
            assert any(completed) == uses
            versions = {re.findall(r"\?v=(\w+)$", url)[0] for url in page.asked if "/frames/" in url}
            scene = json.loads((published / "scene.json").read_text())
            assert versions == {scene["rig"]["assets"]}, (
                "no file of an earlier performance comes from a cache"
            )


def test_it_works_in_an_iframe(browser, host):
    with Performance(browser, f"{host}frame.html") as page:
        inside = page.page.frames[1]
        inside.wait_for_function("document.querySelector('#picture').dataset.drawn !== undefined")
        assert page.page.evaluate("scrollY") == 0, "the reader scrolls to it"
        page.page.evaluate("scrollTo(0, 1000)")  # as far as possible: the frame is at the bottom
        page.page.wait_for_timeout(500)
        shown = page.pixels()[-600:, :900]
        assert (middle_of(shown).max(-1) > 60).mean() > 0.05
        page.page.mouse.move(450, 500)
        page.page.mouse.wheel(0, 300)
        page.page.wait_for_timeout(500)
        assert np.abs(page.pixels()[-600:, :900] - shown).mean() < 0.1, "the page around it keeps the wheel"
        page.page.mouse.click(450, 500)
        page.page.mouse.wheel(0, 300)
        page.until(lambda: np.abs(page.pixels()[-600:, :900] - shown).mean() > 0.5)


def test_a_path_becomes_a_film_without_a_server(browser, host, tmp_path):
    with Performance(browser, f"{host}some/ball/#time=0") as page:
        page.paused(0)
        page.page.keyboard.press("h")
        page.page.locator("#path-seconds").fill("1")
        page.page.locator("#path-time").select_option("still")
        page.page.locator("#path-turntable").click()
        page.until(lambda: page.page.locator("#path-export").is_enabled())
        images: list[str] = []
        held: list = []
        released: list = []

        def hold_fill(route) -> None:
            """Hold the images that only fill holes: they are requested after those that colour the view."""
            images.append(route.request.url)
            if released or len(images) <= COMPLETED_SOURCES:
                route.continue_()
            else:
                held.append(route)

        is_of_frame = re.compile(r"/frames/0/\d+\.bin")
        page.until(lambda: len(set(filter(is_of_frame.search, page.asked))) == 10)
        page.page.route(is_of_frame, hold_fill)
        with page.page.expect_download(timeout=1000 * SCREENSHOT_S) as waiting:
            page.page.locator("#path-export").click()
            page.until(lambda: held)
            assert " of 31 views" not in page.page.locator("#path-text").inner_text()
            released.extend(held)
            for route in released:
                route.continue_()
        film = tmp_path / "film.mp4"
        waiting.value.save_as(film)
    import av

    with av.open(str(film)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 30
    assert len(frames) == 31 and frames[0].shape == (480, 480, 3)
    assert all((middle_of(frame).max(-1) > 60).mean() > 0.05 for frame in frames)
    assert np.abs(frames[0].astype(int) - frames[15]).mean() > 1, "the other side"
    assert np.abs(frames[0].astype(int) - frames[30]).mean() < 2, "a whole turn"


def test_a_missing_file_that_the_view_does_not_need_changes_nothing(browser, host):
    images: list[str] = []

    def lose_last(route) -> None:
        """The host has only the images that are requested first, and not that of the farthest camera."""
        url = route.request.url
        if url not in images[:9]:
            images.append(url)
        if url in images[:9]:
            route.continue_()
        else:
            route.fulfill(status=404)

    is_image = re.compile(r"/frames/0/\d+\.bin")
    with Performance(browser, f"{host}some/ball/#time=0", routes={is_image: lose_last}) as page:
        cover = page.page.locator("#cover")
        page.until(lambda: len(images) > 12 or cover.is_visible())  # requested four times
        assert cover.is_hidden()
        assert (middle_of(page.picture()).max(-1) > 60).mean() > 0.05
        page.errors.clear()


def test_missing_files_are_reported_and_requested_again(browser, host):
    with Performance(browser, f"{host}some/ball/#time=0") as page:
        page.paused(0)
        page.page.route("**/frames/**", lambda route: route.abort())
        page.page.locator("#seek").fill("2")
        cover = page.page.locator("#cover")
        page.until(lambda: "missing" in cover.inner_text() and "Retrying" in cover.inner_text(), 60)
        assert (middle_of(page.picture()).max(-1) > 60).mean() > 0.05, "the last picture stays"
        page.page.unroute("**/frames/**")
        page.paused(2)
        page.until(cover.is_hidden)
        page.errors.clear()


@pytest.mark.parametrize("size", ["phone"])
def test_the_page_fits_a_phone(browser, host, size):
    with Performance(browser, f"{host}some/ball/#time=0", size) as page:
        page.paused(0)
        page.tab("path")
        assert page.page.locator("#path-turntable").is_visible()
        assert page.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
