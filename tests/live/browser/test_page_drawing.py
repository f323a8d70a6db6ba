"""The page draws moving views by itself; the server's picture of a view at rest appears over it."""

import contextlib
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from live.browser.conftest import SCREENSHOT_S, View, opened
from live.live_servers import CAMERAS, Running, running, wait_until
from reference.ball import photograph

from viewmend.cli import serve
from viewmend.live.client import Publisher
from viewmend.live.connection import ClosingError
from viewmend.live.encoding import draw_mode
from viewmend.live.poses import view_camera
from viewmend.live.protocol import CloseCode
from viewmend.live.push import PushSource
from viewmend.live.renderer import RenderRequest
from viewmend.models.base import RenderQuality

pytestmark = pytest.mark.slow

MIN_DB, MIN_BALL_DB = 35.0, 32.0
"""Of a real scene; and of the ball, whose texture is as fine as its images of 48 pixels, which JPEG costs more."""
COUNT_PAINTS = """() => {
  window.paints = 0;
  const clear = WebGL2RenderingContext.prototype.clear;
  WebGL2RenderingContext.prototype.clear = function (mask) { window.paints += 1; clear.call(this, mask); };
}"""
STUDIO = {"source": "studio", "size": 256, "frames": 2, "cameras": 8}


@contextlib.contextmanager
def silent(server: Running) -> Iterator[None]:
    """The server renders no views, and its renderer may be used here."""
    server.service.serve_next = lambda: False
    try:
        yield
    finally:
        del server.service.serve_next


def drawn(view: View, time: int = 0) -> np.ndarray:
    """The canvas, once all cameras' images are there and the view rests."""
    session = view.server.live.registry.sessions
    view.until(
        lambda: view.data("drawn") == str(time) and session and session[0].wanted_look is not None,
        SCREENSHOT_S,
    )
    view.page.wait_for_timeout(300)
    return view.picture()


def rendered(server: Running, time: int, mode: str = "rendered") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the server renders for the page's last look: the picture, its holes and its mask."""
    look = server.live.registry.sessions[0].wanted_look
    renderer = server.service.renderer
    camera = view_camera(look.camera, renderer.home, (look.width, look.height))
    result = renderer.render(RenderRequest(time, (camera,), RenderQuality(mend=mode == "completed")), None)
    view = result.completed[0].view
    picture = draw_mode(result.completed[0], mode, look.background or "000000")
    return picture.astype(int), view.holes.numpy(), view.mask.numpy() > 0


def mean_around(picture: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean of the known pixels among the 9 x 9 taps of `draw/fill.js`, and their weight."""
    height, width = known.shape
    stride = max(2, round(2 * height / 768))
    total, weight = np.zeros(picture.shape), np.zeros(known.shape)
    for y in range(-4, 5):
        for x in range(-4, 5):
            rows, columns = np.arange(height) + stride * y, np.arange(width) + stride * x
            inside = ((rows >= 0) & (rows < height))[:, None] & (columns >= 0) & (columns < width)
            at = np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))
            share = np.exp(-(x * x + y * y) / 8) * (inside & known[at])
            total += share[..., None] * picture[at]
            weight += share
    return total / np.maximum(weight, 1e-9)[..., None], weight


def psnr_in_box(page: np.ndarray, server: np.ndarray, mask: np.ndarray, ignored: np.ndarray) -> float:
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    error = ((page - server)[box] ** 2)[~ignored[box]].mean()
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


def pose_text(home, center, azimuth: float, elevation: float = 10.0, nearer: float = 1.0) -> str:
    fov, distance = home["fov_y"], home["distance"] / nearer
    return ",".join(str(round(value, 3)) for value in (azimuth, elevation, 0.0, distance, fov, *center))


def compare(browser, server: Running, azimuths, time: int = 0) -> list[float]:
    """PSNR of the drawn against the server's rendered picture at these poses."""
    rig = server.service.renderer.rig_json
    found = []
    for azimuth in azimuths:
        pose = pose_text(rig["home"], rig["center"], azimuth)
        with silent(server), opened(browser, server, query=f"?mode=rendered&time={time}&pose={pose}") as view:
            page = drawn(view, time)
            picture, _, mask = rendered(server, time)
            found.append(psnr_in_box(page, picture, mask, np.zeros_like(mask)))
    return found


def test_the_page_draws_what_the_server_renders(browser, ball):
    assert min(compare(browser, ball, (20, 75, 200))) > MIN_BALL_DB


def test_holes_are_filled_marked_or_black(browser, ball):
    rig = ball.service.renderer.rig_json
    pose = pose_text(rig["home"], rig["center"], 300, 40)
    shown = {}
    for mode in ("completed", "holes", "rendered"):
        with silent(ball), opened(browser, ball, query=f"?mode={mode}&time=0&pose={pose}") as view:
            shown[mode] = drawn(view)
            _, holes, mask = rendered(ball, 0)
    inner = holes & mask
    assert inner.sum() > 100
    assert shown["rendered"][inner].mean() < 8
    assert np.abs(shown["holes"][inner] - np.array([255, 38, 140])).mean() < 8
    assert (shown["completed"][inner].max(-1) < 20).mean() < 0.01, "no black holes"
    assert np.abs(shown["completed"] - shown["rendered"])[~holes].mean() < 0.5
    around, weight = mean_around(shown["rendered"], mask & (shown["rendered"] == shown["holes"]).all(-1))
    among = inner & (weight > 8)
    assert among.sum() > 20
    assert np.abs(shown["completed"] - around)[among].mean() < 6, "holes continue what is around them"


def test_the_server_completes_a_view_at_rest_and_a_movement_cancels_it(browser, ball):
    with opened(browser, ball, query="?time=0") as view:
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        view.page.wait_for_timeout(500)
        shown = view.picture()
        with silent(ball):
            picture, _, mask = rendered(ball, 0, "completed")
            assert psnr_in_box(shown, picture, mask, np.zeros_like(mask)) > 30, "as JPEG"
        (session,) = ball.live.registry.sessions
        cancelled, cancel = [], session.cancel
        session.cancel = lambda: cancelled.append(True) or cancel()
        x, y = view.middle()
        view.page.mouse.move(x, y)
        view.page.mouse.down()
        view.page.mouse.move(x + 40, y)
        view.until(lambda: cancelled)
        looks, take = [], session.look
        session.look = lambda look: take(looks.append(look) or look)
        for step in range(10):
            view.page.mouse.move(x + 40 + 8 * step, y)
            view.page.wait_for_timeout(30)
        assert np.abs(view.picture() - shown).mean() > 0.2
        view.page.mouse.up()
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        assert looks and not any(look.moving for look in looks), "the page draws moving views alone"
        view.page.wait_for_timeout(500)
        again = view.picture()
        with silent(ball):
            picture, _, mask = rendered(ball, 0, "completed")
        again_db = psnr_in_box(again, picture, mask, np.zeros_like(mask))
        assert again_db > MIN_BALL_DB, "the completed view covers the drawn one after a movement, too"


def test_playing_costs_the_server_no_views(browser, ball):
    with opened(browser, ball, query="") as view:
        times = set()

        def seen() -> bool:
            times.add(view.data("drawn"))
            return times >= {"0", "1", "2"}

        view.until(seen, SCREENSHOT_S)
        wait_until(lambda: ball.live.registry.sessions[0].wanted_look is None)
        before = ball.service.counts["frames"]
        times.clear()
        view.until(seen, SCREENSHOT_S)
        assert ball.service.counts["frames"] == before
        view.page.keyboard.press("Space")
        view.until(lambda: view.data("full") == "true", SCREENSHOT_S)
        assert view.data("time") == view.data("drawn"), "it pauses at the frame that is shown"


def test_a_rigs_frames_are_drawn_as_they_come_and_painted_once(browser):
    with running(PushSource(), ready=False) as server, Publisher(CAMERAS, server.ws, fps=10.0) as rig:
        rig.push(photograph(CAMERAS))
        with opened(browser, server, query="") as view:
            for number in range(4):
                view.until(lambda: view.data("drawn") == str(number), SCREENSHOT_S)  # noqa: B023
                rig.push(photograph(CAMERAS))
            view.until(lambda: view.data("drawn") == "4", SCREENSHOT_S)
            view.page.wait_for_timeout(500)
            view.page.evaluate(COUNT_PAINTS)
            view.page.wait_for_timeout(500)
            assert view.page.evaluate("window.paints") == 0, "nothing is new"
            rig.push(photograph(CAMERAS))
            view.until("window.paints > 0", SCREENSHOT_S)


def test_the_server_draws_where_asked_to_and_where_assets_are_missing(browser, ball):
    requested = []

    def refuse(route):
        requested.append(route.request.url)
        route.fulfill(status=503, body="{}")

    with opened(browser, ball, query="?render=server", route=refuse) as view:
        view.until(lambda: view.data("frame") is not None, SCREENSHOT_S)
        assert not requested and view.data("drawn") is None
    with opened(browser, ball, query="", route=refuse) as view:
        view.until(lambda: view.data("frame") is not None, SCREENSHOT_S)
        assert requested and view.data("drawn") is None


def test_assets_are_fetched_again_where_the_server_was_too_busy(browser, ball):
    tries = Counter()

    def busy(route):
        tries[route.request.url] += 1
        if tries[route.request.url] == 1:
            route.abort("connectionreset")
        elif tries[route.request.url] == 2:
            route.fulfill(status=503, body="{}")
        else:
            route.continue_()

    with opened(browser, ball, query="", route=busy) as view:
        view.until(lambda: view.data("drawn") is not None, SCREENSHOT_S)
    assert max(tries.values()) >= 3


def test_a_paused_frame_whose_assets_failed_is_fetched_again(browser, ball):
    tries = Counter()

    def fail_once(route):
        tries[route.request.url] += 1
        if tries[route.request.url] == 1:
            route.fulfill(status=404, body="{}")
        else:
            route.continue_()

    with opened(browser, ball, query="?time=0", route=fail_once) as view:
        view.until(lambda: view.data("drawn") == "0", SCREENSHOT_S)


def test_after_an_outage_a_new_connection_lets_the_page_draw_again(browser, ball):
    out = [True]

    def fail(route):
        if out[0]:
            route.fulfill(status=404, body="{}")
        else:
            route.continue_()

    with opened(browser, ball, query="?time=0", route=fail) as view:
        view.until(lambda: view.data("frame") is not None, SCREENSHOT_S)  # the server draws
        assert view.data("drawn") is None
        out[0] = False
        for connection in list(ball.live.registry.connections):
            error = ClosingError(CloseCode.TIMEOUT, "an outage")
            connection._loop.call_soon_threadsafe(connection.fail, error)
        view.until(lambda: view.data("drawn") == "0", SCREENSHOT_S)


@pytest.mark.parametrize("scene", ["wd2", "utrecht", "studio"])
def test_drawn_pictures_of_real_scenes_are_the_servers(browser, request, scene, record_property):
    if scene == "studio":
        options = serve.Options(**STUDIO)
    else:
        options = serve.Options(source=str(request.getfixturevalue("shared") / "captures" / scene))
    with running(serve.open_source(options)) as server:
        home = server.service.renderer.rig_json["home"]["azimuth"]
        found = compare(browser, server, [home + 45 * step for step in range(8)])
    record_property("psnr_db", found)
    print(scene, [round(db, 1) for db in found])
    assert min(found) > MIN_DB
