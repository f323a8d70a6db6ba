"""Everybody's frames: aligned on the input cameras alone, and no larger than wanted."""

import threading
from dataclasses import replace

import pytest
import torch
from reference.ball import AwayBall, BallCapture, camera_at, photograph, ring

from viewmend.data import prepare as preparing
from viewmend.data.errors import CaptureError
from viewmend.data.prepare import first_with_subject, prepare
from viewmend.data.source import FRAMES_AHEAD, limit_size, prefetch
from viewmend.geometry.cameras import concatenate_cameras

SHIFT_PX = 0.8


class Shifted(BallCapture):
    """A rig that states principal points next to the true ones."""

    def __init__(self):
        heights = (0.3, 0.0, 1.2, -0.8, 0.6, 1.4, -1.0)
        self.true_cameras = concatenate_cameras(
            [camera_at(51 * n, f"c{n}", size=96, height_m=height) for n, height in enumerate(heights)]
        )
        super().__init__(self.true_cameras.moved(-SHIFT_PX, 0.0))

    def read(self, time):
        return replace(photograph(self.true_cameras, time), cameras=self.cameras, depth=None)


def test_a_shift_of_all_images_is_undone_for_inputs_and_the_camera_left_out():
    capture = Shifted()
    prepared = prepare(capture, capture.cameras.names[1:])
    moved = prepared.cameras.K[:, 0, 2] - capture.cameras.K[:, 0, 2]
    assert moved.tolist() == pytest.approx([SHIFT_PX] * 7, abs=0.35)
    assert torch.equal(prepared.read(1).cameras.K, prepared.cameras.K)
    assert torch.equal(prepare(capture, align=False).cameras.K, capture.cameras.K)


def test_colours_are_matched_where_the_moved_cameras_look(monkeypatch):
    """At full size, by the inputs' images alone."""
    looked = []
    monkeypatch.setattr(preparing, "match_colours", lambda frame, bounds, odd: looked.append(frame))
    capture = Shifted()
    prepared = prepare(capture, capture.cameras.names[1:], max_image_size=48)
    [frame] = looked
    assert prepared.colours is None and frame.cameras.names == capture.cameras.names[1:]
    x_px, y_px = prepared.alignment.offset_px
    expected = capture.cameras.select(frame.cameras.names).moved(x_px, y_px)
    assert x_px > 0.4 and torch.equal(frame.cameras.K, expected.K) and frame.rgb.shape[-1] == 96


def test_images_are_reduced_with_their_cameras_and_never_enlarged():
    sizes = torch.tensor([[48, 48], [40, 48], [48, 30], [20, 24]])
    cameras = replace(ring(4), size_px=sizes)
    frame = replace(photograph(cameras), cameras=cameras)
    small = limit_size(frame, 24)
    assert small.cameras.size_px.tolist() == [[24, 24], [20, 24], [24, 15], [20, 24]] and small.depth is None
    assert int(small.rgb[1, :, :, 20:].max()) == 0 and int(small.mask[2, 15:].max()) == 0
    assert torch.equal(small.rgb[3, :, :24, :20], frame.rgb[3, :, :24, :20])
    like = photograph(small.cameras[0])
    assert float((like.rgb[0].float() - small.rgb[0].float()).abs().mean()) < 5
    assert limit_size(frame, None) is frame and limit_size(frame, 48) is frame
    assert limit_size(replace(frame, mask=None), 24).mask is None


def test_a_reduced_capture_states_the_cameras_of_its_frames():
    prepared = prepare(BallCapture(ring(6)), max_image_size=32, align=False)
    frame = prepared.read(0)
    assert frame.rgb.shape == (6, 3, 32, 32) and prepared.cameras.max_size_px == (32, 32)
    assert torch.equal(frame.cameras.K, prepared.cameras.K)


@pytest.mark.parametrize(
    "inputs, message",
    [
        ("c1", r"expected inputs as a list of names, got the string 'c1'"),
        (["c0", "c1", "cO2"], r"expected cameras among \[.*\], got \['cO2'\]; check the spelling"),
    ],
)
def test_unknown_inputs_are_refused_before_frames_are_read(inputs, message, monkeypatch):
    capture = BallCapture(ring(6))
    monkeypatch.setattr(capture, "read", lambda time: pytest.fail("a frame was read"))
    with pytest.raises(ValueError, match=message):
        prepare(capture, inputs)


class Absent(BallCapture):
    """A rig of which camera `c1` has nothing at time 1."""

    def read(self, time):
        frame = super().read(time)
        return frame.without(["c1"]) if time == 1 else frame


def test_a_camera_without_a_file_is_said_once_and_is_absent_there(caplog):
    prepared = prepare(Absent(ring(6)), align=False)
    assert [len(prepared.read(time).cameras) for time in (0, 1, 1)] == [6, 5, 5]
    said = [record.getMessage() for record in caplog.records if "'c1'" in record.getMessage()]
    assert (
        len(said) == 1
        and "has no image or no mask in this frame and is absent; viewmend check lists all gaps" in said[0]
    )


def test_a_camera_that_is_no_input_may_be_absent(caplog):
    names = [name for name in ring(6).names if name != "c1"]
    assert len(prepare(Absent(ring(6)), names, align=False).read(1).cameras) == 5
    assert not [record for record in caplog.records if "'c1'" in record.getMessage()]


# Reading ahead: frames in order, errors in place, no thread left behind.


class Recorder:
    """A source that records which frames are read."""

    frame_ids = tuple("0123456789")
    name = cameras = fps = up = bounds = None

    def __init__(self, fails_at=None):
        self.started, self.fails_at = [], fails_at
        self.idle = threading.Semaphore(0)

    def read(self, index):
        self.started.append(index)
        self.idle.release()
        if index == self.fails_at:
            raise CaptureError(f"frame {index}")
        return index


def test_frames_come_in_order():
    source = Recorder()
    assert list(prefetch(source, [3, 1, 4, 1, 5])) == [3, 1, 4, 1, 5]
    assert list(prefetch(source)) == list(range(10))


def test_a_limited_number_of_frames_is_read_ahead():
    source = Recorder()
    frames = prefetch(source)
    assert source.started == []
    next(frames)
    for _ in range(1 + FRAMES_AHEAD):
        assert source.idle.acquire(timeout=10)
    assert source.started == [0, 1, 2] and not source.idle.acquire(blocking=False)
    frames.close()


def test_errors_are_raised_in_place_of_their_frame():
    frames = prefetch(Recorder(fails_at=2))
    assert [next(frames), next(frames)] == [0, 1]
    with pytest.raises(CaptureError, match="frame 2"):
        next(frames)
    assert list(frames) == []


def test_closing_leaves_no_thread():
    before = threading.active_count()
    frames = prefetch(Recorder())
    assert next(frames) == 0 and threading.active_count() == before + 1
    frames.close()
    assert threading.active_count() == before


class Entering(BallCapture):
    """The ball, which no camera sees at first, then one, then all."""

    def read(self, time):
        frame = super().read(time)
        return replace(frame, mask=frame.mask * (torch.arange(6) < (0, 1, 6)[time])[:, None, None])


def test_a_capture_is_checked_where_most_cameras_see_the_subject():
    capture = Entering(ring(6), frames=3)
    assert first_with_subject(capture).time == 2
    assert prepare(capture).read(0).has_subject is False
    assert first_with_subject(AwayBall(ring(6), 3, {1, 2}), first=1).time == 0, "the last before"


def test_frames_without_a_subject_are_read_and_a_capture_without_any_is_refused():
    prepared = prepare(AwayBall(ring(6), 4, {0, 2}), last=3)
    assert [prepared.read(time).has_subject for time in range(4)] == [False, True, False, True]
    assert len(prepared.read(2).cameras) == 6
    with pytest.raises(CaptureError, match=r"ball: expected foreground .* none in 4 frames"):
        prepare(AwayBall(ring(6), 4, {0, 1, 2, 3}))
    blind = Entering(ring(6), frames=2)
    with pytest.raises(CaptureError, match=r"in a mask of the input cameras, got none in 2 frames"):
        prepare(blind, blind.cameras.names[1:])
