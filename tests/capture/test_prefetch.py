import threading
import time

import pytest
import torch

from viewmend.capture.errors import CaptureError
from viewmend.capture.plain import open_capture
from viewmend.capture.prefetch import prefetch


class Slow:
    """A source that notes what is read when, and in how many threads at once."""

    frame_ids = tuple("0123456789")
    name = cameras = fps = up = bounds = None

    def __init__(self, fails_at=None):
        self.begun, self.now, self.most, self.fails_at = [], 0, 0, fails_at
        self.lock = threading.Lock()

    def read(self, index):
        with self.lock:
            self.begun.append(index)
            self.now += 1
            self.most = max(self.most, self.now)
        time.sleep(0.002 * (index % 3))
        with self.lock:
            self.now -= 1
        if index == self.fails_at:
            raise CaptureError(f"frame {index}")
        return index


def test_frames_come_in_order_one_at_once():
    source = Slow()
    assert list(prefetch(source, [3, 1, 4, 1, 5])) == [3, 1, 4, 1, 5]
    assert list(prefetch(source)) == list(range(10))
    assert source.most == 1


def test_reads_ahead_but_no_further():
    source = Slow()
    frames = prefetch(source)
    assert source.begun == []
    next(frames)
    time.sleep(0.1)
    assert source.begun == [0, 1, 2]
    frames.close()


def test_an_error_comes_where_its_frame_would():
    frames = prefetch(Slow(fails_at=2))
    assert [next(frames), next(frames)] == [0, 1]
    with pytest.raises(CaptureError, match="frame 2"):
        next(frames)
    assert list(frames) == []


def test_leaving_the_loop_leaves_no_thread():
    before = threading.active_count()
    for frame in prefetch(Slow()):
        if frame == 1:
            break
    del frame
    deadline = time.monotonic() + 2
    while threading.active_count() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert threading.active_count() == before


def test_a_folder_read_ahead_is_the_folder(plain):
    capture = open_capture(plain.path)
    frames = list(prefetch(capture))
    assert [frame.time for frame in frames] == [0, 1]
    assert torch.equal(frames[1].rgb, capture.read(1).rgb)
