"""What tests of the live server share."""

from collections.abc import Iterator

import pytest
import torch
from live_servers import Running, running
from reference.ball import camera_at, photograph

from viewmend.views import CompletedView, IncompleteView


@pytest.fixture(scope="module")
def ball() -> Iterator[Running]:
    """One server for a file's tests; leave it as it was."""
    with running() as server:
        yield server


@pytest.fixture
def ball_view() -> CompletedView:
    """The ball with a square missing, mended."""
    camera = camera_at(10, "t")
    frame = photograph(camera)
    mask = (frame.mask[0] > 0).float()
    error = torch.zeros_like(mask)
    error[20:26, 20:26] = 1
    weights = torch.zeros(2, 48, 48)
    weights[0, :, :24], weights[1, :, 24:] = 1, 1
    rgb = frame.rgb[0] / 255
    view = IncompleteView(
        camera, rgb * (1 - error), mask, error, frame.depth[0], ("a", "b"), weights * mask * (1 - error), 0
    )
    return CompletedView(view, rgb)
