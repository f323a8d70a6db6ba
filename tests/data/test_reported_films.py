"""Faults that users of other tools reported in public: what films declare of colours, fields and clocks."""

from fractions import Fraction

import av
import numpy as np
import pytest
from reference.films import SIZE, picture, write_film

from viewmend.data.video_clock import Timecode, Track, match_tracks, parse_timecode, video_track
from viewmend.data.video_colours import BT2020, DISPLAY_P3, HLG, PQ, to_srgb
from viewmend.data.videos import VideoFile, video_properties


@pytest.mark.parametrize(
    ("transfer", "value", "expected"),
    [
        (HLG, 0.75, 255),
        (HLG, 0.9, 255),
        (HLG, 0.0, 0),
        (HLG, 0.5, 153),
        (PQ, 0.5807, 255),
        (PQ, 0.0, 0),
        (1, 0.5, 128),
    ],
)
@pytest.mark.parametrize("primaries", [1, BT2020, DISPLAY_P3])
def test_grey_has_the_brightness_of_srgb(transfer, value, expected, primaries):
    pixel = np.full((1, 1, 3), round(65535 * value), np.uint16)
    assert np.abs(to_srgb(pixel, primaries, transfer).astype(int) - expected).max() <= 1


def write_grey(path, value, trc, primaries):
    """A film of 10 bits with one grey value, tagged with a transfer function and primaries."""
    with av.open(str(path), "w") as film:
        stream = film.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p10le"
        stream.options = {"crf": "1"}
        for owner in (stream.codec_context,):
            owner.color_trc, owner.color_primaries, owner.colorspace, owner.color_range = trc, primaries, 9, 1
        frame = av.VideoFrame(*SIZE, "yuv420p10le")
        for plane, level in zip(frame.planes, (round(64 + 876 * value), 512, 512), strict=True):
            plane.update(np.full(plane.buffer_size // 2, level, np.uint16).tobytes())
        frame.color_trc, frame.color_primaries, frame.colorspace, frame.color_range = trc, primaries, 9, 1
        film.mux(stream.encode(frame))
        film.mux(stream.encode(None))


@pytest.mark.parametrize(("trc", "value", "expected"), [(18, 0.75, 255), (18, 0.5, 153), (16, 0.5807, 255)])
def test_hdr_films_are_read_as_srgb(tmp_path, trc, value, expected):
    write_grey(tmp_path / "hdr.mp4", value, trc, 9)
    image = VideoFile(tmp_path / "hdr.mp4").read(0, "film")
    assert image is not None and np.abs(image.astype(int) - expected).max() <= 3


def write_interlaced(path, first_field, count=12):
    """A film that gets brighter: the second field of each frame is half a frame later than the first."""
    frames = []
    for number in range(count):
        frame = np.full((SIZE[1], SIZE[0], 3), 40 + 12 * number, np.uint8)
        later = frame[1::2] if first_field == "tff" else frame[0::2]
        later += 6
        frames.append(frame)
    options = {"crf": "1", "x264-params": f"{first_field}=1", "flags": "+ildct+ilme"}
    return write_film(path, frames, options=options, fps=15)


@pytest.mark.parametrize("order", [range(12), (7, 2, 11, 1)])
@pytest.mark.parametrize("first_field", ["tff", "bff"])
@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
def test_interlaced_films_show_the_first_field(tmp_path, order, first_field, suffix):
    path = write_interlaced(tmp_path / f"fields.{suffix}", first_field)
    assert video_properties(path).is_interlaced and video_properties(path).frames == 12
    film = VideoFile(path)
    for number in order:
        image = film.read(number, "film")
        assert image is not None and abs(float(image.mean()) - (40 + 12 * number)) < 2
        assert abs(float(image[0::2].mean() - image[1::2].mean())) < 3


@pytest.mark.parametrize(
    ("text", "fps", "expected"),
    [
        ("00:00:10:12", 24.0, 10.5),
        ("01:00:00:00", 25.0, 3600),
        ("01:00:00;00", 30000 / 1001, 3600),
        ("00:01:00;02", 30000 / 1001, 60.06),
        ("nonsense", 25.0, None),
    ],
)
def test_timecodes_are_counts_of_frames(text, fps, expected):
    found = parse_timecode(text, fps)
    assert (None if found is None else found.frames / fps) == (
        None if expected is None else pytest.approx(expected, abs=0.005)
    )


def clocked(camera, count, clock_s, kind="images", fps=30.0):
    timecode = None if clock_s is None else Timecode(round(30 * clock_s), 30)
    return Track(camera, kind, np.arange(count) / fps, fps, timecode=timecode)


def test_films_are_matched_by_timecode():
    clock = match_tracks([clocked("a", 30, 100.0), clocked("b", 39, 99.7), clocked("b", 39, None, "masks")])
    assert clock.frames["b", "images"][0] - clock.frames["a", "images"][0] == 9
    assert (clock.frames["b", "masks"] == clock.frames["b", "images"]).all()
    assert (
        "0.30 s apart (first 'b', last 'a'); they are matched by timecode" in clock.issues(["a", "b"])[0].text
    )


def test_timecodes_over_midnight_fit_together():
    clock = match_tracks([clocked("a", 30, 0.1), clocked("b", 39, 86399.8)])
    assert clock.frames["b", "images"][0] - clock.frames["a", "images"][0] == 9


def test_masks_that_begin_after_midnight_keep_their_time():
    images = clocked("a", 39, 86399.8)
    clock = match_tracks([images, clocked("a", 30, 0.1, "masks"), clocked("b", 30, 0.1)])
    assert not clock.moved
    assert clock.frames["a", "images"][0] - clock.frames["a", "masks"][0] == 9


def test_measured_rates_do_not_move_timecodes():
    clock = match_tracks([clocked("a", 30, 39599.1, fps=29.98), clocked("b", 39, 39598.8, fps=29.99)])
    assert clock.frames["b", "images"][0] - clock.frames["a", "images"][0] == 9
    assert "they are matched by timecode" in clock.issues(["a", "b"])[0].text


@pytest.mark.parametrize(("other_s", "text"), [(None, "'c' has none"), (5000.0, "no time at which all run")])
def test_timecodes_that_do_not_fit_are_named_and_not_used(other_s, text):
    clock = match_tracks([clocked("a", 30, 100.0), clocked("b", 30, 99.7), clocked("c", 30, other_s)])
    assert (clock.frames["a", "images"] == clock.frames["b", "images"]).all()
    assert text in clock.issues(["a", "b", "c"])[0].text


@pytest.mark.parametrize("name", ["a.mov", "a.mp4", "a.mkv"])
def test_the_timecode_of_a_film_is_read(tmp_path, name):
    with av.open(str(tmp_path / name), "w") as film:
        stream = film.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        (film if name == "a.mkv" else stream).metadata["timecode"] = "10:59:59:05"
        frame = av.VideoFrame.from_ndarray(picture(0), format="rgb24")
        frame.pts, frame.time_base = 0, Fraction(1, 25)
        film.mux(stream.encode(frame))
        film.mux(stream.encode(None))
    assert video_track("a", "images", tmp_path / name).timecode == Timecode(39599 * 25 + 5, 25)


def test_films_without_times_follow_the_others(tmp_path):
    raw = write_film(tmp_path / "raw.h264", [picture(n) for n in range(6)], options={"bf": "0"}, fps=30)
    assert not video_properties(raw).is_timed
    untimed = video_track("a", "images", raw)
    clock = match_tracks([untimed, clocked("b", 6, None)])
    assert (clock.frames["a", "images"] == np.arange(6)).all() and clock.fps == 30
    assert any("'a' have no times in their files" in issue.text for issue in clock.issues(["a", "b"]))
