"""What a server makes ahead, in Chromium: a moving view is drawn from it as soon as it is there."""

import re
import time

import pytest
import torch
from live.browser.conftest import SCREENSHOT_S, opened
from live.browser.test_page_drawing import silent
from live.live_servers import CAMERAS, SmallerFill, running

from viewmend.models.smooth_fill import SmoothFill
from viewmend.types import CompletedView
from viewmend.utils.cancellation import stop_if_cancelled

pytestmark = pytest.mark.slow

COUNT = 12


class Green(SmoothFill):
    """Completes the whole subject in green."""

    def step(self, view, context, state):
        completed, state = super().step(view, context, state)
        mask = completed.view.mask
        return CompletedView(completed.view, torch.stack([0 * mask, mask, 0 * mask])), state


@pytest.mark.parametrize("mode", ["completed", "rendered"])
def test_a_moving_view_is_drawn_from_completed_views_unless_it_is_shown_as_rendered(browser, mode):
    got = set()
    with (
        running(inpainter=Green(), completed_cameras=COUNT) as server,
        opened(browser, server, query=f"?time=0&mode={mode}") as view,
    ):
        view.page.on(
            "requestfinished", lambda request: got.update(re.findall(r"assets/0/(\d+)", request.url))
        )
        completed = {str(len(CAMERAS) + n) for n in range(COUNT)}
        view.until(lambda: completed <= got, SCREENSHOT_S)
        view.page.wait_for_timeout(500)
        with silent(server):
            for _ in range(4):
                view.drag(120, 0)
                view.page.wait_for_timeout(300)
                shown = view.picture()
                bright = shown.max(-1) > 60
                assert bright.mean() > 0.02
                # No colour of the ball, and what is left where a camera next to a virtual one counts, too.
                is_green = shown[..., 1] - shown[..., [0, 2]].max(-1) > 120
                share = is_green[bright].mean()
                assert share > 0.5 if mode == "completed" else share < 0.02, share


def complete_for_ever(*order):
    """A view that is never done, so that the page has a fused mesh and no completed view."""
    while True:
        stop_if_cancelled()
        time.sleep(0.01)


def shown_area(browser, server, mode: str, last_asset: str) -> float:
    """The share of the canvas that a moving view covers, once the page has the fused mesh and this asset."""
    got = set()
    with opened(browser, server, query=f"?time=0&mode={mode}") as view:
        view.page.on(
            "requestfinished", lambda request: got.update(re.findall(r"assets/0/(\w+)", request.url))
        )
        view.until(lambda: {"mesh", last_asset} <= got, SCREENSHOT_S)
        view.page.wait_for_timeout(500)
        with silent(server):
            view.drag(120, 0)
            view.page.wait_for_timeout(300)
            return float((view.picture().max(-1) > 60).mean())


@pytest.mark.parametrize("with_completed", [False, True])
def test_a_moving_view_is_drawn_on_the_fused_mesh_unless_it_is_shown_as_rendered(browser, with_completed):
    with running(inpainter=SmallerFill(), completed_cameras=COUNT) as server:
        last_asset = str(len(CAMERAS) + COUNT - 1)
        if not with_completed:
            server.service.renderer.complete_virtual_camera = complete_for_ever
            last_asset = "mesh"
        rendered = shown_area(browser, server, "rendered", last_asset)
        completed = shown_area(browser, server, "completed", last_asset)
    assert rendered > 0.02
    assert 0.1 * rendered < completed < 0.8 * rendered
