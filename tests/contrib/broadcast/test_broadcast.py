"""One viewer controls the broadcast view, all watchers get the same video, and it is made only while it is watched."""

import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from io import BytesIO

import numpy as np
import pytest
import torch
from live.live_servers import PIPELINE, WAIT_S, FakeClock, get, running, wait_until
from reference.ball import ring

from viewmend.contrib.broadcast import extension as broadcast_module
from viewmend.contrib.broadcast.extension import (
    Broadcast,
    BroadcastSession,
    add_query,
    broadcast_extension,
    centred_camera,
    choose_fps,
)
from viewmend.contrib.broadcast.hls import (
    INIT,
    KEPT_SEGMENTS,
    LISTED_SEGMENTS,
    MIN_SEGMENTS,
    PLAYLIST,
    HlsSegmenter,
)
from viewmend.live.client import Client
from viewmend.live.frame_source import Span
from viewmend.live.poses import home_view, view_camera
from viewmend.live.protocol import Camera, Look
from viewmend.live.push import LiveSource
from viewmend.live.renderer import Renderer, RenderResult
from viewmend.live.server import ServerConfig
from viewmend.live.service import RenderService
from viewmend.live.sessions import PlaybackState
from viewmend.live.video import video_codecs
from viewmend.models.base import State
from viewmend.models.smooth_fill import SmoothFill
from viewmend.utils.timing import StageTimes

av = pytest.importorskip("av")
pytestmark = pytest.mark.skipif("h264" not in video_codecs(), reason="PyAV has no x264 here")
RED, GREEN, BLUE = "c80000", "00c800", "0000c8"
SIZE = (96, 64)
HOME = home_view(ring(4), torch.zeros(3), None)


def broadcasting(size=SIZE, **options):
    """A server with a broadcast of this size."""
    return running(extensions=(partial(Broadcast, size_px=size),), **options)


@pytest.fixture(scope="module")
def on_air():
    with broadcasting() as server:
        yield server


def fetch(server, path, token=None):
    """Status, headers and body."""
    return get(server.url + path, {"Authorization": f"Bearer {token}"} if token else {})


def playlist(server):
    return fetch(server, "/broadcast/live.m3u8")[2].decode()


def last_image(server):
    """The last image of the last segment."""
    last = playlist(server).split()[-1]
    data = b"".join(fetch(server, f"/broadcast/{name}")[2] for name in ("init.mp4", last))
    with av.open(BytesIO(data)) as container:
        return list(container.decode(video=0))[-1].to_ndarray(format="rgb24")


def wait_for_background(server, colour):
    """Wait until the broadcast view has this background."""
    rgb = np.array(list(bytes.fromhex(colour)))
    wait_until(lambda: np.abs(last_image(server)[:4, :4].mean((0, 1)) - rgb).max() < 25)


def wait_for_state(viewer, **expected):
    """Wait for a state with these values."""
    while any(viewer.messages.get("state", {}).get(key) != value for key, value in expected.items()):
        viewer.wait_for("state")


@pytest.mark.slow
def test_the_viewer_on_air_controls_the_broadcast_view(on_air):
    with Client(on_air.ws) as first, Client(on_air.ws) as second:
        assert first.messages["welcome"]["broadcast"] is True
        first.frame(first.look(width=48, height=48, background=RED))
        second.frame(second.look(width=48, height=48, background=GREEN))
        first.on_air()  # with the look that it has already
        wait_for_state(first, on_air=True)
        wait_for_state(second, on_air=False)
        wait_for_background(on_air, RED)
        assert last_image(on_air).shape == (*SIZE[::-1], 3)
        wait_for_state(first, watched=True)
        first.look(width=48, height=48, background=BLUE)
        wait_for_background(on_air, BLUE)
        second.on_air()
        wait_for_state(first, on_air=False)
        wait_for_background(on_air, GREEN)
        first.frame(first.look(width=48, height=48, background=RED))
        second.look(width=48, height=48, background=GREEN, moving=True)
        second.on_air(False)
        wait_for_state(second, on_air=False)
        (extension,) = on_air.live.extensions
        assert extension.session.wanted_look.moving is False
    wait_for_background(on_air, GREEN)  # the last view stays after its viewer has left


def test_a_viewer_that_reconnects_is_on_air_again(on_air):
    with Client(on_air.ws, reconnect_s=WAIT_S) as viewer:
        viewer.frame(viewer.look(width=48, height=48))
        viewer.on_air()
        wait_for_state(viewer, on_air=True)
        for connection in list(on_air.connections):
            connection.get_extra_info("socket").shutdown(2)
        while viewer.connections < 2:
            viewer.frame()
        wait_for_state(viewer, on_air=True)


def test_all_watchers_get_the_same_bytes(on_air):
    playlist(on_air)

    def watch(_):
        files = {}
        while len(files) < 4:
            names = [line for line in playlist(on_air).split() if line[0] != "#"]
            files |= {name: fetch(on_air, f"/broadcast/{name}")[2] for name in names if name not in files}
        return files

    with ThreadPoolExecutor(6) as watchers:
        videos = list(watchers.map(watch, range(6)))
    files = {item for video in videos for item in video.items()}
    assert len({data for _, data in files}) == len({name for name, _ in files})
    assert len(on_air.service._sessions) == 1, "one view is rendered for all"


def test_http_headers_metrics_and_missing_files(on_air):
    _, headers, content = fetch(on_air, "/broadcast/live.m3u8")
    assert (
        headers["content-type"] == "application/vnd.apple.mpegurl" and headers["cache-control"] == "max-age=1"
    )
    _, headers, segment = fetch(on_air, f"/broadcast/{content.decode().split()[-1]}")
    assert headers["content-type"] == "video/mp4" and headers["cache-control"] == "max-age=60" and segment
    assert fetch(on_air, "/broadcast/1.m4s")[0] == 404
    assert fetch(on_air, "/broadcast/..%2Fserver.py")[0] == 404
    metrics = fetch(on_air, "/metrics")[2]
    lines = dict(line.rsplit(" ", 1) for line in metrics.decode().splitlines() if not line.startswith("#"))
    assert lines["viewmend_broadcast_watched"] == "1"
    assert float(lines['viewmend_broadcast_files_total{kind="segments"}']) >= 1
    assert float(lines["viewmend_broadcast_bytes_total"]) > len(segment)
    assert b"watch.js" in fetch(on_air, "/watch")[2]


def encoders():
    return [thread for thread in threading.enumerate() if thread.name == "broadcast"]


@pytest.mark.slow
def test_nothing_is_rendered_or_encoded_while_nothing_is_watched():
    others = encoders()
    with broadcasting(size=(64, 48)) as server:
        (extension,) = server.live.extensions
        assert extension._thread is None and server.service.counts["frames"] == 0
        first = playlist(server).split()[-1]
        assert extension._thread.is_alive() and len(server.service._sessions) == 1
        extension._requested_at -= broadcast_module.UNWATCHED_S
        wait_until(lambda: not extension._thread.is_alive())
        assert not server.service._sessions and extension.session.image is None
        assert fetch(server, f"/broadcast/{first}")[0] == 404
        again = playlist(server)  # a new video, whose segments are numbered on
        assert "#EXT-X-DISCONTINUITY" in again and int(again.split()[-1].removesuffix(".m4s")) > int(
            first[:-4]
        )
    wait_until(lambda: set(encoders()) <= set(others))


PLAYBACK = PlaybackState(Span(0, 1, 1), 0.0, HOME, lambda index: True, 1)


def idle_service(clock=None):
    """A service whose threads are not started."""
    source = LiveSource()
    return RenderService(Renderer(source, SmoothFill(), PIPELINE), source, clock or FakeClock())


def test_an_image_that_is_rendered_while_the_video_ends_is_dropped(ball_view):
    """Otherwise the next video would begin with it."""
    session = BroadcastSession(idle_service(), SIZE, None)
    result = RenderResult(0, (ball_view,), State(), StageTimes())
    session.open()
    request = session.next_request(0.0, PLAYBACK)
    session.deliver(request, result)
    assert session.image is not None
    session.close()
    session.deliver(request, result)  # was begun before
    assert session.image is None
    session.open()
    assert session.image is None
    session.deliver(request, result)
    assert session.image is not None


def test_the_view_that_was_shown_before_is_shown_again():
    """Nothing has changed since the last watcher left, in a capture of one frame."""
    session = BroadcastSession(idle_service(), SIZE, None)
    session.open()
    first = session.next_request(0.0, PLAYBACK)
    assert session.next_request(0.0, PLAYBACK) is None
    session.close()
    session.open()
    again = session.next_request(0.0, PLAYBACK)
    assert first is not None and again is not None and again.time == first.time


def test_a_failing_encoder_is_started_again(monkeypatch, caplog):
    add, failures = HlsSegmenter.add, []

    def fail_once(self, image, index):
        if index >= 4 and not failures and self._size_px == (64, 48):
            failures.append(index)
            raise RuntimeError("no more")
        add(self, image, index)

    monkeypatch.setattr(HlsSegmenter, "add", fail_once)
    with broadcasting(size=(64, 48)) as server, Client(server.ws) as viewer:
        assert playlist(server).startswith("#EXTM3U")
        assert failures and "while encoding the broadcast" in caplog.text
        assert viewer.frame(viewer.look(width=48, height=48)).header["width"] == 48


def test_a_slow_encoder_leaves_frames_out(monkeypatch):
    clock, frames = FakeClock(), []
    made = Broadcast(idle_service(clock), ServerConfig(budget_ms=None), SIZE)
    made._requested_at = clock()

    start_s, own = clock(), threading.get_ident()

    def add_slowly(film, image, index):
        if threading.get_ident() != own:  # a broadcast of an earlier test that is still ending
            return
        frames.append((index, clock() - start_s))
        clock.advance(0.25)
        if len(frames) == 12:
            made._stopped.set()

    monkeypatch.setattr(HlsSegmenter, "add", add_slowly)
    monkeypatch.setattr(made._stopped, "wait", clock.advance)
    made.session.image = np.zeros((64, 96, 3), np.uint8)
    made._encode(10)
    assert [index for index, _ in frames] == sorted({index for index, _ in frames})
    assert all(-1e-6 <= shown_s - index / 10 < 0.1 for index, shown_s in frames), "in step with time"
    assert frames[-1][0] >= 30, "of every three frames, two are left out"


def test_a_video_that_does_not_begin_is_an_error(monkeypatch):
    monkeypatch.setattr(broadcast_module, "START_S", 0.5)
    monkeypatch.setattr(HlsSegmenter, "add", lambda self, image, index: None)
    with broadcasting(size=(64, 48)) as server:
        status, _, text = fetch(server, "/broadcast/live.m3u8")
        assert status == 503 and b"did not begin in time" in text


def test_a_server_without_a_broadcast(ball):
    assert fetch(ball, "/broadcast/live.m3u8")[0] == 404
    with Client(ball.ws) as viewer:
        assert viewer.messages["welcome"]["broadcast"] is False
        viewer.on_air()
        assert "--broadcast" in viewer.wait_for("error")["message"]
        viewer.send("clock", playing=False)
        assert "on_air" not in viewer.wait_for("state")


def test_of_two_compared_modes_the_first_is_on_air():
    session = BroadcastSession(idle_service(), SIZE, None)
    session.look(Look(modes=("rendered", "completed"), moving=True, depth=True, scale=0.5))
    request = session.next_request(0.0, PLAYBACK)
    assert session.wanted_look.modes == ("rendered",) and not request.quality.mend
    assert tuple(request.cameras[0].size_px[0].tolist()) == SIZE


def test_the_token_is_added_to_all_names_in_the_playlist():
    token = "0123456789abcdef&="
    with broadcasting(token=token) as server:
        assert fetch(server, "/broadcast/live.m3u8")[0] == 401
        plain = fetch(server, "/broadcast/live.m3u8", token)[2].decode()
        assert token not in plain and "?" not in plain
        with av.open(
            f"{server.url}/broadcast/live.m3u8?token=0123456789abcdef%26%3D", timeout=WAIT_S
        ) as container:
            assert next(container.decode(video=0)).width == SIZE[0]
    text = b'#EXTM3U\n#EXT-X-MAP:URI="init.mp4"\n#EXTINF:1.0,\n7.m4s\n#EXTINF:1.0,\n8.m4s\n'
    expected = b'#EXTM3U\n#EXT-X-MAP:URI="init.mp4?token=a"\n#EXTINF:1.0,\n7.m4s?token=a\n#EXTINF:1.0,\n8.m4s?token=a\n'
    assert add_query(text, "?token=a") == expected and add_query(text, "") == text


def test_the_video_has_the_viewers_vertical_field_of_view():
    camera = Camera(azimuth=20.0, fx=90.0, fy=100.0, cx=20.0, cy=70.0)
    seen = view_camera(camera, HOME, (160, 120))
    shown = view_camera(centred_camera(Look(camera=camera, width=160, height=120)), HOME, SIZE)
    assert float(shown.K[0, 1, 1]) / SIZE[1] == pytest.approx(float(seen.K[0, 1, 1]) / 120, rel=1e-5)
    assert shown.K[0, :2, 2].tolist() == [SIZE[0] / 2, SIZE[1] / 2]
    assert shown.camera_from_world[0].tolist() == seen.camera_from_world[0].tolist()
    assert centred_camera(Look(camera=Camera(azimuth=20.0, fov_y=33.0))).fov_y == 33.0
    assert centred_camera(Look(eyes=(Camera(azimuth=1.0), Camera(azimuth=2.0)))).azimuth == 1.0


@pytest.mark.parametrize(("source", "video"), [(0.0, 10), (1.0, 5), (14.985, 15), (25.0, 25), (240.0, 30)])
def test_the_frame_rate_is_the_sources_within_bounds(source, video):
    assert choose_fps(source) == video


@pytest.mark.parametrize(
    ("text", "words"), [("1280", "WIDTHxHEIGHT"), ("1280x719", "even"), ("4096x4096", "2048")]
)
def test_invalid_sizes_are_refused(text, words):
    with pytest.raises(ValueError, match=words):
        broadcast_extension(text)
    assert broadcast_extension("96x64").keywords == {"size_px": (96, 64)}


# The film's segments, as a player finds them.


FPS = 5


def grey(level, width=64, height=48):
    return np.full((height, width, 3), level, np.uint8)


def listed(film):
    """Lines of the playlist: what it says, and the segments that it names."""
    lines = film.file(PLAYLIST).decode().split()
    return [line for line in lines if line.startswith("#")], [
        line for line in lines if not line.startswith("#")
    ]


def played(film, names):
    """What a player makes of these segments: times in frames, and pictures."""
    data = film.file(INIT) + b"".join(film.file(name) for name in names)
    with av.open(BytesIO(data)) as container:
        frames = list(container.decode(video=0))
    return [round(float(f.pts * f.time_base) * FPS) for f in frames], [
        f.to_ndarray(format="rgb24") for f in frames
    ]


def test_each_picture_comes_at_its_time_and_each_second_is_a_segment_of_its_own():
    with HlsSegmenter((64, 48), FPS) as film:
        for at in range(22):
            film.add(grey(10 * at), at)
        said, names = listed(film)
        assert "#EXT-X-TARGETDURATION:1" in said and "#EXT-X-INDEPENDENT-SEGMENTS" in said
        assert len(names) == 4 and [line for line in said if "EXTINF" in line] == ["#EXTINF:1.000000,"] * 4
        times, pictures = played(film, names)
        assert times == list(range(20))
        assert [round(p.mean() / 10) for p in pictures] == times and pictures[0].shape == (48, 64, 3)
        for n, name in enumerate(names):  # one by one: who joins begins anywhere
            times, pictures = played(film, [name])
            assert len(times) == FPS and abs(pictures[0].mean() - 50 * n) < 4


def test_where_pictures_are_left_out_the_others_keep_their_time():
    with HlsSegmenter((64, 48), FPS) as film:
        for at in (0, 1, 4, 7, 8, 12, 16, 21, 22):
            film.add(grey(10 * at), at)
        _, names = listed(film)
        times, pictures = played(film, names)
        assert times == [0, 1, 4, 7, 8, 12, 16] and [round(p.mean() / 10) for p in pictures] == times


def test_a_playlist_is_shown_when_it_is_long_enough_and_never_grows_longer():
    with HlsSegmenter((64, 48), FPS) as film:
        seen, known = 0, []
        for at in range(FPS * (KEPT_SEGMENTS + 8)):
            film.add(grey(at % 200), at)
            if film.file(PLAYLIST) is None:
                assert at <= FPS * MIN_SEGMENTS + 1
                continue
            said, names = listed(film)
            seen += 1
            assert MIN_SEGMENTS <= len(names) <= LISTED_SEGMENTS and all(film.file(name) for name in names)
            assert int(said[3].removeprefix("#EXT-X-MEDIA-SEQUENCE:")) == int(names[0].removesuffix(".m4s"))
            known += [name for name in names if name not in known]
        assert seen and len(known) == KEPT_SEGMENTS + 7 and known == sorted(known)
        assert sum(film.file(name) is not None for name in known) == KEPT_SEGMENTS
        assert film.file("../secret") is None


def test_pictures_of_any_size_fill_the_film():
    with HlsSegmenter((64, 48), FPS) as film:
        for at in range(FPS * MIN_SEGMENTS + 2):
            film.add(np.hstack([grey(30, 40 + at, 91), grey(220, 40 + at, 91)]), at)
        _, pictures = played(film, listed(film)[1])
        assert all(p.shape == (48, 64, 3) for p in pictures)
        assert all(p[:, :28].mean() < 45 and p[:, 36:].mean() > 205 for p in pictures)


def test_noise_does_not_make_segments_of_any_size():
    noise = np.random.default_rng(0)
    with HlsSegmenter((640, 360), 30) as film:
        for at in range(30 * MIN_SEGMENTS + 2):
            film.add(noise.integers(0, 255, (360, 640, 3), dtype=np.uint8), at)
        sizes = [len(film.file(name)) for name in listed(film)[1]]
        assert max(sizes) < 2_000_000 and max(sizes[1:]) < 1_200_000
