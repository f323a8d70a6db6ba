"""Reading ahead: frames in order, one at a time, errors in place, no thread left behind."""

import threading

import pytest
import torch

from viewmend.data.errors import CaptureError
from viewmend.data.native_capture import open_capture
from viewmend.data.source import FRAMES_AHEAD, prefetch


class Recorder:
    """A source that records which frames are read, and in how many threads at once."""

    frame_ids = tuple("0123456789")
    name = cameras = fps = up = bounds = None

    def __init__(self, fails_at=None):
        self.started, self.running, self.most, self.fails_at = [], 0, 0, fails_at
        self.idle = threading.Semaphore(0)

    def read(self, index):
        self.started.append(index)
        self.running += 1
        self.most = max(self.most, self.running)
        self.running -= 1
        self.idle.release()
        if index == self.fails_at:
            raise CaptureError(f"frame {index}")
        return index


def test_frames_come_in_order_one_at_a_time():
    source = Recorder()
    assert list(prefetch(source, [3, 1, 4, 1, 5])) == [3, 1, 4, 1, 5]
    assert list(prefetch(source)) == list(range(10))
    assert source.most == 1


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


def test_a_folder_is_read_ahead(plain):
    capture = open_capture(plain.path)
    frames = list(prefetch(capture))
    assert [frame.time for frame in frames] == [0, 1]
    assert torch.equal(frames[1].rgb, capture.read(1).rgb)
