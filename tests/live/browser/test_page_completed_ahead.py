"""A server's completed virtual cameras in Chromium: a moving view is drawn from them as soon as they are there."""

import re

import pytest
import torch
from live.browser.conftest import SCREENSHOT_S, opened
from live.browser.test_page_drawing import silent
from live.live_servers import CAMERAS, running

from viewmend.models.smooth_fill import SmoothFill
from viewmend.types import CompletedView

COUNT = 12


class Green(SmoothFill):
    """Completes the whole subject in green."""

    def step(self, view, context, state):
        completed, state = super().step(view, context, state)
        mask = completed.view.mask
        return CompletedView(completed.view, torch.stack([0 * mask, mask, 0 * mask])), state


@pytest.mark.parametrize("mode", ["completed", "rendered"])
def test_a_moving_view_is_drawn_from_completed_views_unless_it_is_shown_as_rendered(browser, mode):
    asked = set()
    with (
        running(inpainter=Green(), completed_cameras=COUNT) as server,
        opened(browser, server, query=f"?time=0&mode={mode}") as view,
    ):
        view.page.on("request", lambda request: asked.update(re.findall(r"assets/0/(\d+)", request.url)))
        completed = {str(len(CAMERAS) + n) for n in range(COUNT)}
        view.until(lambda: completed <= asked, SCREENSHOT_S)
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
