"""How strongly cameras are held is chosen by what the refinement has not seen."""

import numpy as np
import pytest

from viewmend.data.synthetic.stage import Studio, StudioConfig
from viewmend.preprocess.calibration import silhouettes as held_out
from viewmend.preprocess.calibration.silhouettes import HOLDS, HeldOutIou, Refinement, best_hold, missed_px


@pytest.fixture(scope="module")
def frames():
    capture = Studio(StudioConfig(seed=10002, cameras=6, frames=3, size_px=128))
    return [capture.read(time) for time in range(3)]


@pytest.mark.parametrize("best", HOLDS)
def test_of_several_times_those_left_out_choose(frames, best, monkeypatch):
    asked = []

    def missed(frames, left, bounds, hold):
        asked.append((left, hold))
        return 0.1 if hold == best else 0.2

    monkeypatch.setattr(held_out, "missed_px", missed)
    assert best_hold(frames, None) == best
    assert sorted(asked) == sorted((time, hold) for time in (0, 1) for hold in HOLDS)


@pytest.mark.parametrize("best", HOLDS)
def test_of_a_single_time_cameras_choose(frames, best, monkeypatch):
    judged = lambda frames, name, bounds, hold: HeldOutIou(name, 0.9, 0.95 if hold == best else 0.94)  # noqa: E731
    monkeypatch.setattr(held_out, "refined_without", judged)
    assert best_hold(frames[:1], None) == best


def test_the_time_that_is_left_out_is_not_refined_by(frames, monkeypatch):
    seen = []

    def refined(frames, bounds, hold):
        seen.extend(frame.time for frame in frames)
        return Refinement(frames[0].cameras, 0.0, 0.0)

    monkeypatch.setattr(held_out, "refined_all", refined)
    exact = missed_px(frames[:2], 1, None, HOLDS[0])
    assert seen == [0] and exact < 0.3

    def disturbed(frames, bounds, hold):
        pose = frames[0].cameras.camera_from_world.clone()
        pose[1, 1, 3] += 0.1
        cameras = frames[0].cameras
        return Refinement(type(cameras)(cameras.names, cameras.K, pose, cameras.size_px), 0.0, 0.0)

    monkeypatch.setattr(held_out, "refined_all", disturbed)
    assert missed_px(frames[:2], 1, None, HOLDS[0]) > exact + 0.3 and np.isfinite(exact)
