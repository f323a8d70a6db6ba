"""Films: every frame once, upright, at its time, whatever the container claims."""

import gc
import multiprocessing
import os
import threading

import av
import numpy as np
import pytest
from reference.films import MATRICES, SIZE, picture, set_matrix, write_film

from viewmend.data import videos
from viewmend.data.errors import CaptureError
from viewmend.data.videos import VideoFile, decode, to_rgb, video_properties

FRAMES = [picture(number) for number in range(12)]
B_FRAMES = {"bf": "2", "crf": "8"}
GROUPS = {"g": "4", "bf": "2", "crf": "8"}
INTRA = {"g": "1", "crf": "8"}
FRAGMENTS = {"movflags": "frag_keyframe+empty_moov"}
FILMS = {
    "MP4 with B-frames": ("a.mp4", {"options": B_FRAMES}),
    "Matroska": ("a.mkv", {"options": B_FRAMES}),
    "AVI with B-frames, which has no right times": ("a.avi", {"options": B_FRAMES}),
    "MPEG-TS": ("a.ts", {"options": B_FRAMES}),
    "fragments without a length": ("a.mp4", {"options": GROUPS, "container": FRAGMENTS}),
    "a browser's recorder without a length": (
        "a.webm",
        {"codec": "libvpx", "container": {"live": "1"}, "options": {"b:v": "4M", "deadline": "realtime"}},
    ),
    "VP8 with hidden frames": (
        "a.webm",
        {"codec": "libvpx", "options": {"b:v": "4M", "auto-alt-ref": "1", "lag-in-frames": "8"}},
    ),
    "Motion JPEG": ("a.avi", {"codec": "mjpeg", "pix_fmt": "yuvj420p", "options": {"q:v": "2"}}),
    "MPEG-4": ("a.mp4", {"codec": "mpeg4", "options": {"q:v": "2", "bf": "2"}}),
    "ProRes of 10 bit": ("a.mov", {"codec": "prores_ks", "pix_fmt": "yuv422p10le"}),
}


@pytest.mark.parametrize(("name", "how"), FILMS.values(), ids=FILMS.keys())
def test_every_frame_of_a_film_is_read_once_at_its_time(tmp_path, name, how):
    path = write_film(tmp_path / name, FRAMES, **how)
    video = video_properties(path)
    assert (video.width, video.height, video.frames, video.fps) == (*SIZE, 12, 30.0)
    assert video.times_s == pytest.approx(np.arange(12) / 30, abs=1e-3)
    film = VideoFile(path)
    for index in [*range(12), 11, 3, 7, 0]:
        read = film.read(index, "here").astype(int)
        assert int(np.argmin([np.abs(read - frame).mean() for frame in FRAMES])) == index


@pytest.mark.parametrize("name", MATRICES)
def test_display_matrices_are_obeyed(tmp_path, name):
    path = set_matrix(write_film(tmp_path / "a.mp4", FRAMES[:2]), name)
    a, b, c, d = MATRICES[name]
    video = video_properties(path)
    assert (video.width, video.height) == (SIZE if a else SIZE[::-1])
    stored = to_rgb(next(decode(video_properties(write_film(tmp_path / "b.mp4", FRAMES[:2]))))[1])
    shown = VideoFile(path).read(0, "here")
    for y, x in ((3, 5), (40, 60)):
        to_x, to_y = a * x + c * y, b * x + d * y  # below 0: counted from the far side, which is at -1
        assert (shown[to_y - (min(b, d) < 0), to_x - (min(a, c) < 0)] == stored[y, x]).all()


def test_an_edit_list_hides_frames(tmp_path):
    dark = [np.zeros_like(FRAMES[0])] * 6
    video = video_properties(
        write_film(tmp_path / "a.mp4", dark + FRAMES, hidden=6, options={"g": "250", "bf": "0"})
    )
    assert video.frames == 12 and video.times_s[0] == pytest.approx(0, abs=1e-3)
    shown = [to_rgb(frame) for _, frame in decode(video)]
    assert len(shown) == 12 and np.abs(shown[0].astype(int) - FRAMES[0]).mean() < 12


@pytest.mark.parametrize(("name", "how"), [("a.mp4", {}), ("a.mkv", {}), ("a.avi", {"codec": "mpeg4"})])
def test_lost_frames_leave_gaps_in_time(tmp_path, name, how):
    times = [0, 1, 2, 6, 7, 8] if name == "a.avi" else [3, 4, 5, 9, 10, 11]  # AVI starts with its first frame
    video = video_properties(write_film(tmp_path / name, FRAMES[:6], times=times, **how))
    assert video.times_s == pytest.approx(np.array(times) / 30, abs=1e-3)
    assert video.fps == pytest.approx(30, abs=0.1)


def test_lost_frames_of_an_avi_with_b_frames_leave_a_gap(tmp_path):
    video = video_properties(write_film(tmp_path / "a.avi", FRAMES, times=[*range(6), *range(9, 15)]))
    steps = np.diff(video.times_s) * 30
    assert (video.timestamps, video.frames) == (None, 12)
    assert sorted(np.rint(steps).tolist()) == [1] * 10 + [4]


def test_a_film_that_was_cut_off_ends_with_its_last_whole_frame(tmp_path):
    path = write_film(tmp_path / "a.mkv", FRAMES, options=INTRA)
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    video = video_properties(path)
    assert 4 <= video.frames < 12
    assert [index for index, _ in decode(video)] == list(range(video.frames))


def test_decoding_starts_at_key_frames_and_gives_the_same_pixels(tmp_path):
    for name in ("a.mp4", "a.mkv", "a.ts"):
        video = video_properties(write_film(tmp_path / name, FRAMES * 4, options=GROUPS))
        everything = [to_rgb(frame) for _, frame in decode(video)]
        for start in (0, 17, 47):
            index, frame = next(decode(video, start))
            assert index == start and (to_rgb(frame) == everything[start]).all()


@pytest.mark.parametrize("full_range", [False, True])
@pytest.mark.parametrize("bt709", [False, True])
@pytest.mark.parametrize("pix_fmt", ["yuv444p", "yuv444p10le"])
def test_colours_are_those_that_the_film_declares(tmp_path, full_range, bt709, pix_fmt):
    """Against the definition of the matrices, from the planes."""
    path = write_film(tmp_path / "a.mkv", FRAMES[:1], pix_fmt=pix_fmt, full_range=full_range, bt709=bt709)
    _, frame = next(decode(video_properties(path)))
    bits, kind = (10, np.uint16) if pix_fmt.endswith("10le") else (8, np.uint8)
    planes = [np.frombuffer(bytes(p), kind).reshape(p.height, -1)[:, : p.width] for p in frame.planes]
    y, u, v = (plane.astype(float) / 2 ** (bits - 8) for plane in planes)
    black, luma, chroma = (0, 255, 255) if full_range else (16, 219, 224)
    y, u, v = (y - black) / luma, (u - 128) / chroma, (v - 128) / chroma
    red, blue = (0.2126, 0.0722) if bt709 else (0.299, 0.114)
    r, b = y + 2 * (1 - red) * v, y + 2 * (1 - blue) * u
    expected = 255 * np.stack([r, (y - red * r - blue * b) / (1 - red - blue), b], -1).clip(0, 1)
    assert np.abs(to_rgb(frame) - expected).max() < 3


def test_smaller_images_are_upright_too(tmp_path):
    path = set_matrix(write_film(tmp_path / "a.mp4", FRAMES[:1]), "turned by 90 degrees")
    _, frame = next(decode(video_properties(path)))
    assert to_rgb(frame, (24, 32)).shape == (32, 24, 3)
    assert (to_rgb(frame, SIZE[::-1]) == to_rgb(frame)).all()


def test_what_is_no_film_is_said(tmp_path):
    sound = tmp_path / "sound.mp4"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=48000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 48000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    (tmp_path / "text.mp4").write_text("hello" * 99)
    for name, got in (
        ("sound", " a file without one"),
        ("text", " a file that no decoder"),
        ("none", ": No such file"),
    ):
        with pytest.raises(CaptureError, match=rf"{name}.mp4: expected a video, got{got}"):
            video_properties(tmp_path / f"{name}.mp4")


def test_a_forked_process_needs_no_thread_of_its_parent(tmp_path, monkeypatch):
    """Workers of training are forked while validation may read the same films, and have none of its threads."""
    film = VideoFile(write_film(tmp_path / "a.mp4", FRAMES, options=B_FRAMES))
    parent = os.getpid()
    is_reading = threading.Event()
    may_end = threading.Event()

    def convert(frame):
        if os.getpid() == parent:
            is_reading.set()
            may_end.wait(60)
        return to_rgb(frame)

    monkeypatch.setattr(videos, "to_rgb", convert)
    reading = threading.Thread(target=film.read, args=(0, "here"))
    reading.start()
    is_reading.wait()
    gc.collect()  # decoders of earlier tests, which the child would wait for if it collected them
    fork = multiprocessing.get_context("fork")
    receiver, sender = fork.Pipe(duplex=False)
    child = fork.Process(target=lambda: sender.send_bytes(film.read(1, "here").tobytes()))
    child.start()
    try:
        assert receiver.poll(20), "the child waits for a thread of its parent"
        received = receiver.recv_bytes()
    finally:
        child.kill()
        may_end.set()
        reading.join()
    assert received == film.read(1, "here").tobytes()
