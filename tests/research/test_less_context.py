"""The shipped `paper-small` with less context."""

from pathlib import Path

import pytest

from viewmend import Stream, Studio, StudioConfig
from viewmend.models.paper.context import window_times
from viewmend.models.registry import make_method

FILE = Path(__file__).parents[2] / "research/less_context.py"


@pytest.mark.parametrize(
    ("name", "num_cameras", "times"),
    [("present", 3, (30,)), ("one_camera", 1, (30, 29, 28, 27, 20, 10, 0)), ("no_cameras", 0, None)],
)
def test_methods_have_less_context(name, num_cameras, times):
    model = make_method(f"{FILE}:{name}")
    studio = Studio(StudioConfig(seed=10002, cameras=6, frames=1, size_px=96))
    held, *inputs = studio.cameras.names
    stream = Stream(model, bounds=studio.bounds)
    stream.add_frame(studio.read(0).select(inputs))
    completed = stream.view(studio.cameras.select([held])).completed
    assert bool(completed.rgb.isfinite().all())
    assert len(model.source_names(completed.view)) == num_cameras
    if times is not None:
        assert window_times(30, model.config) == times
