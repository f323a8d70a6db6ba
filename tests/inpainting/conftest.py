"""What the tests of the reader of whole views look at."""

import pytest

from viewmend.inpainting.sweep.config import SweepConfig
from viewmend.inpainting.sweep.pyramids import Rig
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig


@pytest.fixture(scope="session")
def small_sweep():
    return SweepConfig(num_views=4, width=8, place_channels=4, features=8, fine_features=8)


@pytest.fixture(scope="module")
def scene(small_sweep):
    """A stream with one camera left out, its view by the rule `all`, and what four cameras saw."""
    studio = Studio(StudioConfig(seed=7, cameras=7, frames=1, size_px=(96, 83)))
    frame = studio.read(0)
    held, net = frame.cameras.names[2], SweepNet(small_sweep)
    stream = Stream(net, StreamConfig(render=RenderConfig(error_rule="all"), memory_mb=None, fit_rig=False))
    observation = stream.push(frame.without([held]))
    view = stream.render(frame.cameras.select([held]))
    seen = observation.context(view.closest_views(4))
    return stream, view, Rig.of(seen, view.silhouettes)
