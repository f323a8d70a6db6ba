"""A published performance of the ball: four frames, seen by six cameras, with completed virtual ones."""

import pytest
from live.live_servers import CAMERAS, PIPELINE
from reference.ball import BallCapture

from viewmend.models.smooth_fill import SmoothFill
from viewmend.publishing import PublishConfig, PublishedSize, publish
from viewmend.stream import Stream

FRAMES = 4


def publish_ball(
    out, max_mb: float = 20.0, completed_cameras: int = 4, frames: int = FRAMES
) -> PublishedSize:
    """Write the ball's performance into a new folder."""
    capture = BallCapture(CAMERAS, frames)
    stream = Stream(SmoothFill(), PIPELINE)
    first = stream.add_frame(capture.read(0))
    config = PublishConfig(title="A <ball>", max_mb=max_mb, completed_cameras=completed_cameras, fps=10.0)
    read = (capture.read(time) for time in range(frames))
    out.mkdir(parents=True)
    return publish(read, frames, stream, first, capture.cameras, capture.up, out, config)


@pytest.fixture(scope="session")
def published(tmp_path_factory):
    """The folder, some way below the one that a host serves; leave it as it is."""
    out = tmp_path_factory.mktemp("host") / "some/ball"
    publish_ball(out)
    return out
