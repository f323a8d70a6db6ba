"""Turntables: options in one text, and the frame of each view."""

import pytest

from viewmend.data.camera_path import STATIC_VIEWS, Turntable, parse_turntable


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
