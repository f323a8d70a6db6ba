from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from viewmend.capture.errors import CaptureError
from viewmend.capture.plain import open_capture
from viewmend.capture.video_writer import VideoWriter
from viewmend.capture.videos import VideoFile

GREYS = [20 * index for index in range(12)]


@pytest.fixture
def video(plain):
    plain.put_video("grey.avi", [np.full((32, 40, 3), grey, np.uint8) for grey in GREYS])
    return VideoFile(plain.path / "grey.avi")


def grey_at(video, index):
    return round(float(video.read(index, "here").mean()))


@pytest.mark.parametrize("order", [range(12), [5, 5, 6, 2, 0, 11, 3], reversed(range(12))])
def test_each_index_gives_its_own_frame(video, order):
    for index in order:
        assert grey_at(video, index) == pytest.approx(GREYS[index], abs=2)


def test_many_threads_may_ask(video):
    with ThreadPoolExecutor(8) as pool:
        greys = list(pool.map(lambda index: grey_at(video, index), [*range(12), *range(12)]))
    assert greys == pytest.approx([*GREYS, *GREYS], abs=2)


def test_after_its_end_the_video_still_reads(video):
    with pytest.raises(CaptureError, match="here: expected at least 13 frames in the video, got 12"):
        video.read(12, "here")
    assert grey_at(video, 3) == pytest.approx(GREYS[3], abs=2)


def test_colours_are_rgb_and_masks_may_be_videos(plain):
    red, white = np.zeros((32, 40, 3), np.uint8), np.zeros((32, 40, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes BGR
    white[8:24, 8:24] = 255
    plain.put_video("red.avi", [red, red])
    plain.put_video("mask.avi", [white, 255 - white])
    plain.edit(lambda d: d["cameras"][0].update(video="red.avi", mask="mask.avi"))
    plain.edit(lambda d: d["cameras"][0].pop("image"))
    capture = open_capture(plain.path)
    frame = capture.read(1)
    assert (frame.rgb[0, 0] > 240).all() and (frame.rgb[0, 1:] < 15).all()
    expected = torch.ones(32, 40, dtype=torch.bool)
    expected[8:24, 8:24] = False
    assert torch.equal(frame.mask[0] > 127, expected)
    assert torch.equal(capture.read(0).mask[0] > 127, ~expected)


@pytest.mark.parametrize("faithful", [False, True])
def test_written_videos_keep_size_and_colour(tmp_path, faithful):
    rgb = np.zeros((33, 41, 3), np.uint8)
    rgb[:, :20] = (200, 30, 60)
    with VideoWriter(tmp_path / "new" / "clip.mp4", 25.0, faithful) as writer:
        for _ in range(3):
            writer.add(rgb)
    read = VideoFile(tmp_path / "new" / "clip.mp4").read(2, "here")
    assert read.shape == ((33, 41, 3) if faithful else (32, 40, 3))
    assert np.abs(read[5:25, 2:16].astype(int) - (200, 30, 60)).max() < 12
    assert read[:, 26:].max() < 12
