"""One clock for all films of a capture: lost frames, other rates, offsets, and films of masks."""

import json

import numpy as np
import pytest
from reference.ball import BallCapture, photograph, ring
from reference.films import write_film, write_film_capture

from viewmend.cli import main
from viewmend.data.capture_folder import open_capture
from viewmend.data.errors import CaptureError
from viewmend.data.native_writer import write_capture
from viewmend.data.video_clock import ABSENT, Track, match_tracks


def tracks(**times):
    """Tracks of images; masks are named a_masks. Times are numbers of frames, 30 per second or at a given rate."""
    found = []
    for name, given in sorted(times.items(), key=lambda item: "_" in item[0]):
        numbers, fps = given if isinstance(given, tuple) else (given, 30)
        camera, _, kind = name.partition("_")
        found.append(Track(camera, kind or "images", np.array(numbers) / fps, float(fps)))
    return found


def said(clock):
    return [issue.text for issue in clock.issues(("a", "b", "c", "d"))]


def test_films_in_step_are_matched_one_to_one():
    clock = match_tracks(tracks(a=range(9), b=range(9), c=range(9)))
    assert (len(clock.times_s), clock.end, clock.fps, said(clock)) == (9, 9, 30.0, [])
    assert all(index.tolist() == list(range(9)) for index in clock.frames.values())


def test_a_camera_is_absent_where_it_lost_frames_and_in_step_afterwards():
    lost = [0, 1, 2, 3, 7, 8]
    clock = match_tracks(tracks(a=range(9), b=lost, c=range(9)))
    assert clock.frames["b", "images"].tolist() == [0, 1, 2, 3, ABSENT, ABSENT, ABSENT, 4, 5]
    assert said(clock) == [
        "the images of camera 'b' lack 3 frames from 0.13 s on, by the video's own times; the camera is absent there"
    ]


def test_frames_that_the_reference_lost_are_kept():
    clock = match_tracks(tracks(a=[0, 1, 2, 6, 7, 8], b=[0, 1, 2, 3, 4, 7, 8], c=[0, 1, 4, 5, 6, 7, 8]))
    assert np.rint(30 * clock.times_s).tolist() == [0, 1, 2, 4, 6, 7, 8]  # 3 and 5: one camera alone


@pytest.mark.parametrize("rate", [15, 10])
def test_a_slower_camera_is_absent_in_between(rate):
    step = 30 // rate
    clock = match_tracks(tracks(a=range(12), b=range(12), c=(range(12 // step), rate)))
    assert clock.frames["c", "images"].tolist() == [n // step if n % step == 0 else ABSENT for n in range(12)]
    assert clock.end == 12 and f"have {rate} frames per second, not the others' 30" in said(clock)[0]


def test_one_fast_camera_does_not_set_the_pace():
    clock = match_tracks(tracks(a=(range(48), 120), b=range(12), c=range(12)))
    assert (
        clock.frames["a", "images"].tolist() == list(range(0, 48, 4))
        and clock.fps == 30.0
        and not said(clock)
    )


def test_half_of_the_cameras_being_slow_is_said():
    fast, slow = range(24), (range(12), 15)
    clock = match_tracks(tracks(a=fast, b=fast, c=slow, d=slow))
    assert clock.fps == 15.0 and clock.frames["a", "images"].tolist() == list(range(0, 24, 2))
    assert [
        "cameras 'a', 'b' have 30 frames per second, not the others' 15" in text for text in said(clock)
    ] == [True]


def test_variable_rates_and_drift_do_not_lose_frames():
    rng = np.random.default_rng(0)
    jitter = [np.arange(300) + rng.uniform(-0.2, 0.2, 300) + phase for phase in (0, 0.48, -0.3)]
    clock = match_tracks(tracks(a=jitter[0], b=jitter[1], c=jitter[2]))
    assert all(index.tolist() == list(range(300)) for index in clock.frames.values())
    drifting = match_tracks(tracks(a=range(900), b=range(900), c=np.arange(900) * 1.001))
    distance = drifting.times_s - np.arange(900)[drifting.frames["c", "images"]] * 1.001 / 30
    assert np.abs(distance).max() <= 0.5 / 30 + 1e-6


def test_masks_are_matched_by_time_or_one_to_one():
    films = {name: range(30) for name in "abc"}
    slower = match_tracks(tracks(**films, a_masks=(range(25), 25)))
    index = slower.frames["a", "masks"]
    assert (index == ABSENT).sum() == 5  # those halfway between two masks
    assert np.abs(index[index >= 0] / 25 - slower.times_s[index >= 0]).max() < 0.5 / 30
    assert "the masks of camera 'a' have 25 frames per second, not the images' 30" in said(slower)[0]
    lost = [n for n in range(30) if n not in (8, 9)]
    numbered = match_tracks(tracks(a=lost, b=range(30), c=range(30), a_masks=range(28)))
    assert (numbered.frames["a", "masks"] == numbered.frames["a", "images"]).all()
    assert "masks of camera 'a' have other times than the images, but as many frames" in said(numbered)[1]


def test_the_shortest_film_ends_the_capture():
    clock = match_tracks(tracks(a=range(24), b=range(24), a_masks=range(24), b_masks=range(20)))
    assert clock.end == 20 and "the masks of camera 'b' end 0.13 s before the images'" in said(clock)[0]


def test_a_camera_that_starts_late_is_said():
    clock = match_tracks(tracks(a=range(24), b=range(24), c=range(12, 24)))
    assert len(said(clock)) == 1 and "the images of camera 'c' start 0.40 s after" in said(clock)[0]


def test_films_without_a_common_time_start_together_and_this_is_said():
    clock = match_tracks(tracks(a=range(9), b=range(9), c=range(9000, 9009)))
    assert clock.frames["c", "images"].tolist() == list(range(9))
    assert said(clock) == [
        "the images of camera 'c' have no time in common with the others'; they are taken to start together"
    ]


def test_faults_of_several_cameras_are_one_issue():
    clock = match_tracks(tracks(a=range(9), b=range(9), a_masks=(range(5), 15), b_masks=(range(5), 15)))
    assert len(said(clock)) == 1 and "cameras 'a', 'b'" in said(clock)[0]


# Captures.

NAMES = ("c0", "c1", "c2", "c3")


def darkness(frame, camera):
    """Which time a camera of the capture shows: from time to time the ball grows darker by a tenth."""
    images = dict(zip(frame.cameras.names, frame.rgb.float(), strict=True))
    bright = photograph(ring(4)).rgb.float()
    return round(
        10 * (1 - float(images[camera].amax((1, 2)).sum() / bright[NAMES.index(camera)].amax((1, 2)).sum()))
    )


@pytest.fixture
def ball(tmp_path):
    """A capture of four films of eight frames and numbered masks, and the frames of each camera."""
    source = BallCapture(ring(4), 8)
    write_film_capture(source, tmp_path / "ball")
    return tmp_path / "ball", [source.read(time) for time in range(8)]


def rewrite(ball, camera, shown, **how):
    path, frames = ball
    images = [frames[time].rgb[NAMES.index(camera)].permute(1, 2, 0).numpy() for time in shown]
    how = {"fps": 10, "pix_fmt": "yuv444p", "options": {"crf": "8"}} | how
    write_film(path / f"video/{camera}.mp4", images, **how)


def edit(path, change):
    content = json.loads((path / "cameras.json").read_text())
    change(content)
    (path / "cameras.json").write_text(json.dumps(content))


def shown(capture):
    """The time that each camera shows in each frame."""
    frames = [capture.read(time) for time in range(len(capture.frame_ids))]
    return [{name: darkness(frame, name) for name in frame.cameras.names} for frame in frames]


def test_a_capture_is_read_by_the_times_of_its_films(ball, caplog):
    rewrite(ball, "c1", [0, 1, 2, 5, 6, 7], times=[0, 1, 2, 5, 6, 7])
    rewrite(ball, "c2", [0, 2, 4, 6], fps=5)
    rewrite(ball, "c3", [number // 2 for number in range(16)], fps=20)
    capture = open_capture(ball[0])
    for time, seen in enumerate(shown(capture)):
        assert set(seen.values()) == {time}
        assert ("c1" in seen) == (time not in (3, 4)) and ("c2" in seen) == (time % 2 == 0)
    assert capture.gaps[:2] == (("c1", "003"), ("c1", "004"))
    assert "camera 'c1' lack 2 frames from 0.30 s on" in caplog.text and "5 frames per second" in caplog.text


def test_films_of_cameras_that_are_not_selected_do_not_count(ball):
    rewrite(ball, "c2", range(0, 8, 2), fps=5)
    rewrite(ball, "c3", range(0, 8, 2), fps=5)
    assert len(open_capture(ball[0]).frame_ids) == 4
    assert [set(seen.values()) for seen in shown(open_capture(ball[0], NAMES[:2]))] == [{n} for n in range(8)]
    (ball[0] / "video/c3.mp4").write_bytes(b"damaged")
    with pytest.raises(CaptureError, match="camera 'c3': expected a video"):
        open_capture(ball[0])
    assert len(open_capture(ball[0], NAMES[:2]).frame_ids) == 8


def test_masks_may_be_numbered_like_the_frames_of_their_film(ball):
    path, _ = ball
    rewrite(ball, "c1", [0, 1, 4, 5, 6, 7], times=[0, 1, 4, 5, 6, 7])
    for time in (6, 7):
        (path / f"mask/c1/{time:03d}.png").unlink()
    assert [("c1" in seen, len(seen)) for seen in shown(open_capture(path))] == [
        (t not in (2, 3), 3 + (t not in (2, 3))) for t in range(8)
    ]


def test_an_offset_is_subtracted_from_the_times_of_a_camera(ball):
    path, _ = ball
    rewrite(ball, "c3", [0, 0, *range(6)])  # two frames late
    edit(path, lambda content: content["cameras"][3].update(offset_ms=200))
    capture = open_capture(path)
    assert all(set(seen.values()) == {time} for time, seen in enumerate(shown(capture)))
    assert "c3" not in capture.read(7).cameras.names and capture.clock.describe("c3")[0]["offset_ms"] == 200
    images = path.parent / "images"
    write_capture(BallCapture(ring(4), 8), images, images="png")
    edit(images, lambda content: content["cameras"][0].update(offset_ms=-100))
    assert [seen.get("c0") for seen in shown(open_capture(images))] == [None, 0, 1, 2, 3, 4, 5, 6]
    edit(images, lambda content: content["cameras"][0].update(offset_ms=200))
    pair = shown(open_capture(images, ["c0", "c1"]))
    assert pair == [{"c0": time + 2, "c1": time} for time in range(6)]


def test_masks_may_be_films_of_another_rate(ball):
    path, _ = ball
    white = [np.full((48, 48, 3), 20 + 25 * time, np.uint8) for time in range(8)]
    for name, step in (("c0", 1), ("c1", 2)):
        write_film(path / f"mask/{name}.mp4", white[::step], fps=10 // step, options={"crf": "4"})
    edit(path, lambda content: [content["cameras"][n].update(mask=f"mask/c{n}.mp4") for n in (0, 1)])
    capture = open_capture(path)
    assert "the masks of camera 'c1' have 5 frames per second, not the images' 10" in capture.issues[0].text
    for time in range(8):
        frame = capture.read(time)
        assert ("c1" in frame.cameras.names) == (time % 2 == 0)
        assert abs(float(frame.mask[0].float().mean()) - (20 + 25 * time)) < 6


def test_films_that_are_shorter_than_listed_shorten_the_capture(ball):
    for name in NAMES[1:]:
        rewrite(ball, name, range(5))
    capture = open_capture(ball[0])
    assert len(capture.frame_ids) == 5
    assert "expected 8 frames as listed, got videos with 5 common times" in capture.issues[0].text


def test_check_reports_the_times_of_each_film(ball, capsys):
    rewrite(ball, "c1", [0, 1, 2, 5, 6, 7], times=[0, 1, 2, 5, 6, 7])
    assert main(["check", str(ball[0]), "--json"]) == 0
    description = json.loads(capsys.readouterr().out)
    (film,) = description["cameras"][1]["films"]
    assert (film["kind"], film["frames"], film["fps"], film["gaps"][0][1]) == ("images", 6, 10.0, 2)
    assert "lack 2 frames" in description["findings"][0]
    assert main(["check", str(ball[0])]) == 0
    out = capsys.readouterr().out
    assert "c1  6 images, 10 fps, 0.00 to 0.80 s, 2 missing at 0.30 s, offset 0 ms" in out
    assert "c0  8 images, 10 fps, 0.00 to 0.80 s, no gaps, offset 0 ms" in out
