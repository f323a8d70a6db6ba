"""A small scene for the tests of the default model."""

import pytest

from viewmend.models.views.config import ViewsConfig
from viewmend.models.views.model import ViewSynthNet
from viewmend.models.views.pyramids import SourceCameras
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.studio.stage import Studio, StudioConfig


@pytest.fixture(scope="session")
def small_views():
    return ViewsConfig(num_views=4, width=8, sample_channels=4, features=8, fine_features=8)


@pytest.fixture(scope="module")
def scene(small_views):
    """A stream without one camera, the view of that camera with error rule `all`, and four source cameras."""
    studio = Studio(StudioConfig(seed=7, cameras=7, frames=1, size_px=(96, 83)))
    frame = studio.read(0)
    held, net = frame.cameras.names[2], ViewSynthNet(small_views)
    stream = Stream(net, StreamConfig(render=RenderConfig(error_rule="all"), memory_mb=None))
    cached = stream.add_frame(frame.without([held]))
    view = stream.render(frame.cameras.select([held]))
    return stream, view, SourceCameras.of(cached.context(view.closest_views(4)), view.silhouettes)
