"""What comes from an address: when each picture was taken, and which are whole."""

import threading
from collections import Counter
from contextlib import closing
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from io import BytesIO
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from reference.films import picture, set_matrix, write_film

from viewmend.contrib.live_rig import frame_readers, frame_times
from viewmend.contrib.live_rig.frame_readers import DamageFilter, Playback, read_images
from viewmend.contrib.live_rig.frame_times import DriverTimes, ImageTimes, SenderTimes
from viewmend.contrib.live_rig.rig_file import read_rig
from viewmend.contrib.live_rig.sender_clock import SenderClock
from viewmend.data.video_clock import Timecode, Track
from viewmend.data.videos import to_rgb

FPS = 10


class Clock:
    """Time that passes only when somebody waits."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def wait(self, seconds: float) -> bool:
        self.now += max(0.0, seconds)
        return False


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(frame_readers, "time", clock)
    monkeypatch.setattr(frame_times, "time", clock)
    return clock


@pytest.fixture
def camera(ball_rig):
    return read_rig(ball_rig / "rig.toml").cameras[0]


def shade(frame):
    """Which of the ball's frames it is: they grow darker."""
    return int(frame.to_ndarray(format="rgb24").max())


@pytest.fixture
def playback(clock):
    """Of eight frames, from now on."""
    playback = Playback(8 / FPS)
    playback.start_s = clock.now
    return playback


def test_a_recording_is_played_in_time_over_and_over(camera, clock, playback):
    with closing(read_images(camera, Counter(), playback, clock.wait)) as played:
        taken = [next(played) for _ in range(20)]
    assert [round(FPS * (p.taken_s - 1000)) for p in taken] == list(range(20))
    shades = [shade(p.frame) for p in taken]
    assert shades[8:16] == shades[:8] and shades[:8] == sorted(set(shades[:8]), reverse=True)


def test_a_recording_is_joined_where_the_others_are_and_what_is_past_is_left_out(camera, clock, playback):
    clock.now += 8 / FPS + 0.31
    with closing(read_images(camera, Counter(), playback, clock.wait)) as played:
        assert next(played).taken_s == pytest.approx(1000 + 1.2)
        clock.now += 0.25  # somebody was slow
        assert next(played).taken_s == pytest.approx(1000 + 1.4)


def test_recordings_keep_the_times_at_which_they_started():
    def track(name, start_s, frames):
        return Track(name, "images", start_s + np.arange(frames) / 10, 10.0)

    playback = Playback()
    playback.synchronise([track("a", 5.0, 10), track("b", 5.3, 7)])
    assert playback.length_s == pytest.approx(1.0)
    assert playback.shifts_s == {"a": pytest.approx(-5.0), "b": pytest.approx(-5.0)}
    playback.synchronise([track("a", 5.0, 10), track("b", 5.0, 9), track("c", 100.0, 10)])  # no common time
    assert playback.length_s == pytest.approx(0.9) and playback.shifts_s["c"] == pytest.approx(-100.0)


def test_recordings_are_played_by_their_timecodes_and_this_is_said():
    def track(name, clock_frames):
        return Track(name, "images", np.arange(10) / 10, 10.0, timecode=Timecode(clock_frames, 10))

    playback = Playback()
    said = playback.synchronise([track("a", 36_000), track("b", 36_003)])
    assert playback.shifts_s == {"a": pytest.approx(0.0), "b": pytest.approx(0.3)}
    assert said is not None and "0.30 s apart (first 'a', last 'b'); they are matched by timecode" in said


def test_a_recording_follows_when_another_one_changes_the_timeline(camera, clock, playback):
    """A shorter recording is added: laps get shorter, and a reader that joins now is where this one is."""
    with closing(read_images(camera, Counter(), playback, clock.wait)) as played:
        for _ in range(11):  # the second lap begins with the ninth
            next(played)
        playback.length_s = 6 / FPS
        with closing(read_images(camera, Counter(), playback, clock.wait)) as joined:
            for _ in range(12):
                own = next(played)
                clock.now = own.taken_s
                other = next(joined)
                assert own.taken_s == pytest.approx(other.taken_s)
                assert shade(own.frame) == shade(other.frame)


def test_a_recording_follows_when_its_own_shift_changes(camera, clock, playback):
    playback.shifts_s = {camera.name: 0.3}
    with closing(read_images(camera, Counter(), playback, clock.wait)) as played:
        assert next(played).taken_s == pytest.approx(1000.3)
        playback.shifts_s = {camera.name: 0.0}
        image = next(played)
        assert image.taken_s == pytest.approx(1000.4)
    with closing(read_images(camera, Counter(), playback, clock.wait)) as joined:
        clock.now = 1000.4
        assert shade(next(joined).frame) == shade(image.frame)


def test_a_turned_recording_is_played_upright(tmp_path, camera, clock):
    frames = [picture(number) for number in range(3)]
    upright = write_film(tmp_path / "a.mp4", frames)
    turned = set_matrix(write_film(tmp_path / "b.mp4", frames), "turned by 90 degrees")
    shown = []
    for path in (upright, turned):
        with closing(
            read_images(replace(camera, url=str(path)), Counter(), Playback(), clock.wait)
        ) as played:
            shown.append(to_rgb(next(played).frame))
    assert (np.rot90(shown[0], -1) == shown[1]).all()


def test_an_offset_is_taken_off(camera, clock, playback):
    with closing(read_images(replace(camera, offset_s=0.03), Counter(), playback, clock.wait)) as played:
        assert next(played).taken_s == pytest.approx(1000 - 0.03)


@pytest.mark.parametrize(
    ("url", "said"), [("nowhere.mp4", "No such file"), ("http://127.0.0.1:9/x?token=s", "refused")]
)
def test_addresses_where_nothing_is_are_said_without_their_secrets(camera, url, said):
    with pytest.raises(OSError) as error:
        next(read_images(replace(camera, url=url), Counter(), Playback(), bool))
    assert said in str(error.value) and "token" not in str(error.value)


def frame_of(at_s, key=False, corrupt=False):
    return SimpleNamespace(time=at_s, pts=at_s and round(1000 * at_s), key_frame=key, is_corrupt=corrupt)


def packet_of(at_s):
    return SimpleNamespace(dts=round(1000 * at_s), time_base=0.001)


def test_the_senders_clock_is_learnt_from_packets_that_were_waited_for():
    times = SenderTimes()
    times.add_packet(packet_of(70.0), 5.0, False)  # lay in a queue: says nothing
    assert times.taken_s(frame_of(70.0), 5.0) is None
    times.add_packet(packet_of(70.1), 5.02, True)
    assert times.taken_s(frame_of(70.0), 5.0) == pytest.approx(4.92)


def test_a_packet_that_is_given_when_a_later_one_comes_came_before():
    times = SenderTimes(lag_packets=2)
    for n in range(4):  # that of 70.0 is given when that of 70.2 comes
        times.add_packet(packet_of(70 + n / 10), 5.2 + n / 10, True)
    assert times.taken_s(frame_of(70.3), 5.5) == pytest.approx(5.3)


def test_a_driver_that_keeps_the_kernels_time_is_believed(clock, monkeypatch):
    monkeypatch.setattr(clock, "time", lambda: 5e8, raising=False)
    times = DriverTimes()
    assert times.taken_s(frame_of(999.95), 1000.0) == 999.95
    assert times.taken_s(frame_of(5e8 - 0.04), 1000.0) == pytest.approx(999.96)
    assert times.taken_s(frame_of(3.0), 1000.0) is None, "of another clock, which is not known yet"


def test_a_picture_of_the_same_time_is_counted_once():
    times, counts = ImageTimes(), Counter()
    assert [times.is_new(frame_of(t), counts) for t in (0.1, 0.1, 0.2, None, None)] == [
        True,
        False,
        True,
        True,
        True,
    ]
    assert counts["duplicated"] == 1


def test_what_is_built_on_a_torn_picture_waits_for_a_key_picture():
    counts = Counter()
    damage = DamageFilter(counts)
    assert not damage.accepts(frame_of(0, corrupt=True), False, 0.0) and not counts["torn"], (
        "entered in its middle"
    )
    assert damage.accepts(frame_of(0, key=True), False, 0.1)
    assert not damage.accepts(frame_of(0, corrupt=True), False, 0.2)
    assert not damage.accepts(frame_of(0), False, 0.3)
    assert damage.accepts(frame_of(0, key=True), False, 0.4) and damage.accepts(frame_of(0), False, 0.5)
    assert not damage.accepts(frame_of(0), True, 0.6)
    assert damage.accepts(frame_of(0), False, 2.7), "some streams have no key pictures"
    assert counts["torn"] == 3


def transport_stream(pictures_rgb, **options):
    import av

    file = BytesIO()
    with av.open(file, "w", format="mpegts") as container:
        given = {"g": "5", "crf": "10", "tune": "zerolatency"} | options
        stream = container.add_stream("libx264", rate=FPS, options=given)
        stream.height, stream.width, stream.pix_fmt = *pictures_rgb[0].shape[:2], "yuv420p"
        for rgb in pictures_rgb:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(stream.encode())
    return bytearray(file.getvalue())


def received_images(camera, stream, counts):
    """The images that a camera sends over HTTP until its stream ends."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Length", str(len(stream)))
            self.end_headers()
            self.wfile.write(bytes(stream))

        def log_message(self, *_):
            pass

    shown = []
    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}/"
        network = replace(camera, url=url, clock="arrival")
        with (
            pytest.raises(OSError, match="ended"),
            closing(read_images(network, counts, Playback(), bool)) as received,
        ):
            shown.extend(picture.to_rgb() for picture in received)
    return shown


@pytest.mark.parametrize("first_field", ["tff", "bff"])
def test_an_interlaced_stream_shows_its_first_field(camera, first_field):
    """Pictures get brighter; the second field of each is half a frame later than the first."""
    sent = [np.full((96, 96, 3), 40 + 12 * number, np.uint8) for number in range(10)]
    for image in sent:
        later = image[1::2] if first_field == "tff" else image[0::2]
        later += 6
    stream = transport_stream(sent, **{"x264-params": f"{first_field}=1", "flags": "+ildct+ilme"})
    shown = received_images(camera, stream, Counter())
    assert len(shown) >= 8
    for image in shown:
        first = float(image.mean())
        assert abs(first - 40 - 12 * round((first - 40) / 12)) < 2
        assert abs(float(image[0::2].mean() - image[1::2].mean())) < 2


def test_a_damaged_stream_shows_no_damaged_picture(camera):
    """Noise over HTTP, of which some packets are lost and others are garbage."""
    noise = np.random.default_rng(0)
    small = [noise.integers(0, 255, (12, 12, 3), np.uint8) for _ in range(30)]
    sent = [cv2.resize(image, (96, 96), interpolation=cv2.INTER_CUBIC) for image in small]
    stream = transport_stream(sent)
    for at in (9, 17):  # of the second and the fourth group
        start = len(stream) * at // 30 // 188 * 188
        del stream[start : start + 188]
        stream[start + 10 : start + 180] = noise.bytes(170)
    counts = Counter()
    shown = [image.astype(float) for image in received_images(camera, stream, counts)]
    assert counts["torn"] >= 2 and 10 <= len(shown) <= 26
    away = [min(np.abs(image - other).mean() for other in sent) for image in shown]
    assert max(away) < 12


# Where a sender's clock is.


FRAME_S = 1 / 15


def test_delays_do_not_move_a_picture():
    clock = SenderClock()
    for n in range(100):
        delay_s = 0.02 + (0.3 if n % 7 else 0.0)
        clock.add_packet(500 + n * FRAME_S, 7 + n * FRAME_S + delay_s)
        if n:
            assert abs(clock.to_local_s(500 + n * FRAME_S) - (7 + n * FRAME_S + 0.02)) < 1e-9


def test_a_clock_that_runs_wrong_is_followed():
    clock, ppm = SenderClock(), 200e-6
    for n in range(15 * 600):
        at_s = n * FRAME_S
        clock.add_packet(at_s * (1 + ppm), at_s + 0.01)
    assert abs(clock.to_local_s(at_s * (1 + ppm)) - (at_s + 0.01)) < 0.003  # of a drift of 120 ms


def test_a_sender_that_begins_anew_is_found_at_once():
    for restart_s in (0.0, 9000.0):
        clock = SenderClock()
        for n in range(30):
            clock.add_packet(100 + n * FRAME_S, n * FRAME_S)
        clock.add_packet(restart_s, 5.0)
        assert clock.to_local_s(restart_s) == 5.0


def test_a_stall_of_the_network_is_no_new_beginning():
    clock = SenderClock()
    for n in range(30):
        clock.add_packet(n * FRAME_S, n * FRAME_S)
    clock.add_packet(30 * FRAME_S, 30 * FRAME_S + 3.0)
    assert abs(clock.to_local_s(30 * FRAME_S) - 30 * FRAME_S) < 1e-9
