"""Going on air on one page, and watching on another: segment by segment, and with the browser's own player."""

import cv2
import numpy as np
import pytest
from live.browser.conftest import SCREENSHOT_S, View
from live.live_servers import running

from viewmend.live.client import Client
from viewmend.live.server import load_extension
from viewmend.live.video import video_codecs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif("h264" not in video_codecs(), reason="PyAV has no x264 here"),
]
SIZE = "160x120"
NO_SEGMENTS = "delete window.MediaSource"
MOVES = "document.querySelector('#film').currentTime > {}"
PAUSE_FAR_BEHIND = """new Promise(done => {
  const film = document.querySelector('#film');
  const wait = window.setTimeout;
  const positions = [];
  window.setTimeout = (...wanted) => {
    film.pause();
    const ranges = { length: 1, start: () => 0, end: () => film.currentTime + 100 };
    Object.defineProperty(SourceBuffer.prototype, 'buffered', { get: () => ranges, configurable: true });
    positions.push(film.currentTime);
    if (positions.length === 2) done(positions);
    return wait(...wanted);
  };
})"""
"""Pauses between two looks at the playlist, as if its end were far ahead; the position before and after the second."""


@pytest.fixture(scope="module")
def on_air():
    with running(extensions=(load_extension("broadcast", SIZE),)) as server:
        yield server


@pytest.fixture
def pages(browser):
    """Opens pages; none may fail in its scripts."""
    opened, errors = [], []

    def open_page(url, script="", **options):
        page = browser.new_page(viewport={"width": 800, "height": 600}, **options)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.add_init_script(script)
        page.goto(url)
        opened.append(page)
        return View(page, None, errors)

    yield open_page
    for page in opened:
        page.close()
    assert not errors


def ground(view):
    """The colour that what is on air lies upon, and that of the middle."""
    image = np.frombuffer(view.page.locator("#film").screenshot(), np.uint8)
    rgb = cv2.imdecode(image, cv2.IMREAD_COLOR)[..., ::-1].astype(int)
    return rgb[60:90, 200:230].mean((0, 1)), rgb[290:310, 390:410].mean((0, 1))


@pytest.mark.parametrize("script", ["", NO_SEGMENTS], ids=["segment by segment", "own player"])
def test_a_page_shows_what_is_on_air_and_goes_on(on_air, pages, script):
    with Client(on_air.ws) as director:
        director.look(width=48, height=48, background="00c800")
        director.on_air()
        view = pages(f"{on_air.url}/watch", script)
        view.until(MOVES.format(4), 40)
        assert view.page.locator("#said").is_hidden()
        outside, middle = ground(view)
        assert np.abs(outside - (0, 200, 0)).max() < 12 and np.abs(middle - (0, 200, 0)).max() > 40
        native = view.page.evaluate("document.querySelector('#film').currentSrc").startswith(on_air.url)
        assert native is (script == NO_SEGMENTS)
        behind = "const {buffered, currentTime} = document.querySelector('#film'); "
        behind += "return buffered.end(buffered.length - 1) - currentTime"
        assert view.page.evaluate(f"(() => {{ {behind} }})()") < 8
        if not native:
            before, after = view.page.evaluate(PAUSE_FAR_BEHIND)
            assert before == after


def test_a_film_that_stands_still_is_begun_anew(on_air, pages):
    view = pages(f"{on_air.url}/watch")
    view.until(MOVES.format(1), 40)
    view.page.evaluate("document.querySelector('#film').src = 'data:,'")
    view.until(MOVES.format(1) + " && document.querySelector('#film').src.startsWith('blob:')", 40)


def test_the_tool_puts_this_page_on_air_and_tells_who_took_over(on_air, pages):
    view = pages(f"{on_air.url}/?side=128&sharp=0&background=0000c8")
    tool = view.page.locator("#tool-air")
    view.page.wait_for_selector("#picture[data-drawn]", timeout=60_000)
    assert tool.is_visible() and tool.get_attribute("aria-pressed") == "false"
    tool.click()
    pressed = "document.querySelector('#tool-air').getAttribute('aria-pressed') === '{}'"
    view.until(pressed.format("true"))
    assert f"{on_air.url}/watch" in view.page.locator("#toasts").inner_text()
    watching = pages(f"{on_air.url}/watch")
    watching.until(MOVES.format(1), 40)
    watching.until(lambda: np.abs(ground(watching)[0] - (0, 0, 200)).max() < 12, SCREENSHOT_S)
    view.until("document.querySelector('#tool-air').dataset.watched === 'true'")
    sessions = on_air.live.registry.sessions
    loop, (before,) = on_air.server._uvicorn.servers[0].get_loop(), sessions
    for connection in list(on_air.server._uvicorn.server_state.connections):
        loop.call_soon_threadsafe(connection.transport.abort)
    view.until(lambda: before not in sessions, 20)
    view.until(
        lambda: sessions and on_air.live.extensions[0].state_json(sessions[0])["on_air"], 20
    )  # it has come back, and on air
    view.until(pressed.format("true"), 20)
    with Client(on_air.ws) as other:
        other.on_air()
        view.until(pressed.format("false"))
        view.until("document.querySelector('#toasts').innerText.includes('Another viewer')")
    tool.click()
    view.until(pressed.format("true"))
    tool.click()
    view.until(pressed.format("false"))


def test_without_a_broadcast_there_is_no_tool_and_the_page_says_why(ball, pages):
    view = pages(f"{ball.url}/?side=128")
    view.page.wait_for_selector("#picture[data-drawn]", timeout=60_000)
    assert view.page.locator("#tool-air").is_hidden()
    assert "without --broadcast" in pages(f"{ball.url}/watch").page.wait_for_selector(
        "#said:has-text('No broadcast')"
    ).inner_text()  # fmt: skip


def test_the_token_is_passed_on(pages):
    with running(extensions=(load_extension("broadcast", SIZE),), token="0123456789abcdef") as server:
        for script in ("", NO_SEGMENTS):
            view = pages(f"{server.url}/watch?token=0123456789abcdef", script)
            view.until(MOVES.format(1), 40)
        assert "needs a token" in pages(f"{server.url}/watch").page.wait_for_selector(
            "#said:has-text('token')"
        ).inner_text()  # fmt: skip
