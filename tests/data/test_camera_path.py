"""Turntables: options in one text, and the frame of each view; files of poses."""

import json

import pytest
import torch

from viewmend.data.camera_path import (
    STATIC_VIEWS,
    CameraPath,
    Turntable,
    pair_with_frames,
    parse_turntable,
    read_camera_path,
)
from viewmend.studio.rigs import orbit


def test_options_follow_the_word():
    assert parse_turntable("path.json") is None and parse_turntable("orbit") == Turntable()
    given = parse_turntable("orbit:arc=90, seconds=2,size=640x360,loop=repeat,background=white")
    assert given == Turntable(arc=90, seconds=2, size="640x360", loop="repeat", background="white")
    assert given.size_px == (640, 360)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("arc=400", "arc: expected a number <= 360"),
        ("second=3", "second"),
        ("size=big", "size: expected"),
        ("loop=twice", "expected bounce or repeat"),
        ("seconds", "seconds: expected"),
    ],
)
def test_wrong_options_are_refused(options, words):
    with pytest.raises(ValueError, match=words) as raised:
        parse_turntable(f"orbit:{options}")
    assert str(raised.value).startswith(f"--path orbit:{options}: ")


def test_a_short_motion_plays_back_and_forth_or_again():
    frames = [3, 4, 5]
    assert Turntable(seconds=1.0).times(frames, 8.0) == [3, 4, 5, 4, 3, 4, 5, 4]
    assert Turntable(seconds=1.0, loop="repeat").times(frames, 8.0) == [3, 4, 5, 3, 4, 5, 3, 4]
    assert Turntable(seconds=0.5, fps=16.0).times(frames, 8.0) == [3, 3, 4, 4, 5, 5, 4, 4]
    assert Turntable().times([7], None) == [7] * STATIC_VIEWS
    assert Turntable().times(list(range(100)), 25.0) == list(range(100)), "as long as the motion"


@pytest.mark.parametrize(
    "stated", [{}, {"K": True}, {"width": 80, "height": 40}, {"K": True, "width": 80, "height": 40}]
)
def test_a_path_shows_the_same_in_reduced_images(tmp_path, stated):
    """Intrinsics and size in the file are those of unreduced images; a size that it states is kept."""
    full = orbit([0.3], (64, 48))
    if "K" in stated:
        stated = stated | {"K": (full.K[0] * torch.tensor([[1.5], [1.5], [1.0]])).tolist()}
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"world_from_camera": full.world_from_camera.tolist(), **stated}))
    whole = read_camera_path(file, full).cameras
    small = read_camera_path(file, full.resized(16, 12), full_size_px=(64, 48)).cameras
    assert small.max_size_px == ((80, 40) if "width" in stated else (16, 12))
    torch.testing.assert_close(small.resized(*whole.max_size_px).K, whole.K)
    assert torch.equal(read_camera_path(file, full, full_size_px=(64, 48)).cameras.K, whole.K)


def test_frames_of_a_path_are_those_that_it_names():
    cameras = orbit([0.1, 0.2, 0.3], (64, 48))
    recorded = CameraPath(cameras, (4, 4, 2), 30.0)
    assert [time for time, _ in pair_with_frames(recorded, range(6))] == [4, 4, 2]
    assert [time for time, _ in pair_with_frames(recorded, range(1, 2))] == [1, 1, 1], "one frame, all poses"
    with pytest.raises(ValueError, match=r"among 3 frames \(0 to 2\), got 4; choose frames"):
        pair_with_frames(recorded, range(3))
    assert [time for time, _ in pair_with_frames(CameraPath(cameras, None, None), range(3))] == [0, 1, 2]
    with pytest.raises(ValueError, match="one pose or one per frame"):
        pair_with_frames(CameraPath(cameras, None, None), range(4))


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"times": [0]}, "one of 'times' for each pose, got 1 for 2 poses"),
        ({"times": [0, -1]}, "-1"),
        ({"fps": 0}, "fps"),
    ],
)
def test_wrong_times_of_a_path_are_refused(tmp_path, more, said):
    poses = orbit([0.3, 0.4], (64, 48)).world_from_camera.tolist()
    (tmp_path / "path.json").write_text(json.dumps({"world_from_camera": poses, **more}))
    with pytest.raises(ValueError, match=said):
        read_camera_path(tmp_path / "path.json", orbit([0.3], (64, 48)))
