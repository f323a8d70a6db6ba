"""The page and `viewmend serve` together: a small studio scene, from the command line to pixels."""

import re
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from live.browser.conftest import SIZES, THREE_REFRESHES, View, opened

pytestmark = pytest.mark.slow
KEEP_LOOKS = (
    "(() => { const post = Worker.prototype.postMessage;"
    " Worker.prototype.postMessage = function (command, ...rest) {"
    "   const message = command.send ? JSON.parse(command.send) : {};"
    "   if (message.type === 'look') window.lastLook = message;"
    "   return post.call(this, command, ...rest); }; })()"
)
"""JavaScript that keeps the last look that the page sends to the server."""
ANSWERED = (
    "(() => { const look = window.lastLook, shown = document.querySelector('#picture').dataset;"
    " return look && !look.moving && shown.look === String(look.id) && shown.full === 'true'; })()"
)
"""JavaScript: whether the picture is the full answer to that look, at rest."""
SCENE = ("studio", "--size", "128", "--frames", "5", "--cameras", "6", "--port", "0", "--budget-ms", "0")


@pytest.fixture(scope="module")
def served() -> Iterator[SimpleNamespace]:
    command = [sys.executable, "-m", "viewmend", "serve", *SCENE]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            said = []
            for line in process.stdout:
                said.append(line)
                if found := re.search(r"http://\S+", line):
                    yield SimpleNamespace(url=found.group())
                    break
            else:
                pytest.fail("".join(said))
        finally:
            process.terminate()


@pytest.fixture(params=list(SIZES))
def view(browser, served, request) -> Iterator[View]:
    # The server's pictures are what these tests are about.
    query = "?side=256&sharp=0&render=server"
    with opened(browser, served, request.param, query, script=KEEP_LOOKS) as view:
        view.page.wait_for_selector("#picture[data-frame]", timeout=120_000)
        view.page.locator("#play").click()
        rest(view)
        yield view


def rest(view: View) -> None:
    """Wait until the picture is the full answer to the page's last look, and the view rests."""
    view.page.evaluate(THREE_REFRESHES)
    view.page.wait_for_timeout(60)
    view.until(ANSWERED)
    view.page.wait_for_timeout(200)
    view.until(ANSWERED)


def test_pictures_answer_to_pose_mode_and_time(view):
    first = view.picture()
    assert (first.max(-1) > 40).mean() > 0.01
    middle = np.argwhere(first.max(-1) > 40).mean(0)[::-1]
    assert np.abs(middle - view.middle()).max() < 120
    view.drag(120, 0)
    rest(view)
    turned = view.picture()
    assert np.abs(first - turned).mean() > 0.3
    shown = {}
    for name in ("Rendered", "Holes", "Depth", "Source cameras", "Completed"):
        view.page.locator("#modes").get_by_role("radio", name=name).click()
        rest(view)
        shown[name] = view.picture()
    np.testing.assert_allclose(np.abs(shown["Completed"] - turned).mean(), 0, atol=0.1)
    for name in ("Rendered", "Holes", "Depth", "Source cameras"):
        assert np.abs(shown[name] - turned).mean() > 0.005, name
    now = int(view.data("time"))
    view.page.locator("#seek").fill(str((now + 2) % 5))
    view.until(lambda: view.data("time") == str((now + 2) % 5))
    rest(view)
    assert np.abs(view.picture() - turned).mean() > 0.05


def test_the_re_projected_picture_is_nearly_what_the_server_then_answers(view):
    """Its messages are held back for a while: the page shows the new pose from the old picture."""
    before = view.picture()
    view.page.evaluate(
        "(() => { const post = Worker.prototype.postMessage, kept = [];"
        " Worker.prototype.postMessage = function (order) { kept.push([this, order]); };"
        " document.body.addEventListener('release', () => { Worker.prototype.postMessage = post;"
        "   for (const [worker, order] of kept) post.call(worker, order); }); })()"
    )
    view.drag(50, 0)
    view.page.wait_for_timeout(600)
    guessed = view.picture()
    view.page.evaluate("document.body.dispatchEvent(new Event('release'))")
    rest(view)
    answered = view.picture()
    # The scene is coarse: outlines, which are sharp, are off by a depth pixel, which is four of the picture's.
    assert np.abs(guessed - answered).mean() < 0.92 * np.abs(before - answered).mean()


def test_a_film_of_a_path_plays(view, tmp_path):
    view.tab("path")
    for dx in (0, 60):
        view.drag(dx, 0)
        view.page.wait_for_timeout(300)
        view.page.get_by_role("button", name="Add view").click()
    with view.page.expect_download(timeout=120_000) as waiting:
        view.page.get_by_role("button", name="Export MP4").click()
    path = tmp_path / "film.mp4"
    waiting.value.save_as(path)
    film, frames = cv2.VideoCapture(str(path)), []
    while (read := film.read())[0]:
        frames.append(read[1].astype(int))
    assert len(frames) == 61
    assert frames[0].shape == (480, 480, 3)
    assert (frames[0].max(-1) > 40).mean() > 0.01
    assert np.abs(frames[0] - frames[-1]).mean() > 0.5
