"""One view for many: who is on air, what who watches gets, and that nothing is done while nobody does."""

import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from io import BytesIO

import numpy as np
import pytest
import torch
from live_servers import running, wait_until
from reference.ball import ring

from viewmend.live import broadcast, broadcast_answers, film_segments
from viewmend.live.broadcast import centred, frames_per_second
from viewmend.live.broadcast_answers import with_query
from viewmend.live.client import Client
from viewmend.live.clock import Span
from viewmend.live.poses import rig_frame, view_camera
from viewmend.live.protocol import Camera, Look
from viewmend.live.sessions import Playback
from viewmend.live.video import video_codecs

av = pytest.importorskip("av")
pytestmark = pytest.mark.skipif("h264" not in video_codecs(), reason="PyAV has no x264 here")
RED, GREEN = "c80000", "00c800"
SIZE = (96, 64)


@pytest.fixture(scope="module")
def on_air():
    with running(broadcast_px=SIZE) as server:
        yield server


def get(url, path, token=None):
    asked = urllib.request.Request(f"{url}{path}", headers={"Authorization": f"Bearer {token}"} if token else {})
    with urllib.request.urlopen(asked, timeout=30) as answer:
        return answer.headers, answer.read()


def refused(url, path, token=None):
    with pytest.raises(urllib.error.HTTPError) as error:
        get(url, path, token)
    return error.value.code, error.value.read().decode()


def shown(server, wanted, seconds=20.0):
    """Look at the end of the film until there is such a picture."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        last = get(server.url, "/broadcast/live.m3u8")[1].decode().split()[-1]
        data = b"".join(get(server.url, f"/broadcast/{name}")[1] for name in ("init.mp4", last))
        with av.open(BytesIO(data)) as container:
            picture = list(container.decode(video=0))[-1].to_ndarray(format="rgb24")
        if wanted(picture):
            return picture
        time.sleep(0.1)
    raise AssertionError("no such picture was on air")


def ground(colour):
    """Whether a picture lies upon this colour."""
    rgb = np.array(list(bytes.fromhex(colour)))
    return lambda picture: np.abs(picture[:4, :4].mean((0, 1)) - rgb).max() < 25


def told(viewer, **wanted):
    """Wait for a state like this."""
    end = time.monotonic() + 10
    while any(viewer.wait_for("state").get(key) != value for key, value in wanted.items()):
        assert time.monotonic() < end


def test_who_watches_sees_what_the_viewer_on_air_looks_at(on_air):
    with Client(on_air.ws) as first, Client(on_air.ws) as second:
        assert first.messages["welcome"]["broadcast"] is True
        first.frame(first.look(width=48, height=48, background=RED))
        second.frame(second.look(width=48, height=48, background=GREEN))
        first.on_air()  # its look was there before
        told(first, on_air=True)
        told(second, on_air=False)
        assert shown(on_air, ground(RED)).shape == (*SIZE[::-1], 3)
        told(first, watched=True)
        first.look(width=48, height=48, background="0000c8")
        shown(on_air, ground("0000c8"))
        second.on_air()
        told(first, on_air=False)
        shown(on_air, ground(GREEN))
        first.frame(first.look(width=48, height=48, background=RED))
        second.look(width=48, height=48, background=GREEN, moving=True)
        second.on_air(False)
        told(second, on_air=False)
        assert on_air.live._broadcast._session.newest_look.moving is False
    picture = shown(on_air, lambda picture: True)  # the last view stays, whoever has gone
    assert ground(GREEN)(picture) and not ground(GREEN)(picture[22:, 38:])


def test_all_get_the_same_bytes_and_cost_no_view(on_air):
    get(on_air.url, "/broadcast/live.m3u8")
    before, start = on_air.service.counts["frames"], time.monotonic()

    def watch(_):
        got = {}
        while time.monotonic() < start + 3:
            names = [line for line in get(on_air.url, "/broadcast/live.m3u8")[1].decode().split() if line[0] != "#"]
            got |= {name: get(on_air.url, f"/broadcast/{name}")[1] for name in names if name not in got}
            time.sleep(0.3)
        return got

    with ThreadPoolExecutor(12) as watchers:
        films = list(watchers.map(watch, range(12)))
    rendered, took = on_air.service.counts["frames"] - before, time.monotonic() - start
    assert min(map(len, films)) >= 4
    assert len({data for film in films for data in film.values()}) == len({name for film in films for name in film})
    assert rendered <= 30 * took * 1.2  # the ball's frames at the film's pace, whoever watches


def test_caches_are_told_how_long_what_holds(on_air):
    headers, playlist = get(on_air.url, "/broadcast/live.m3u8")
    assert headers["content-type"] == "application/vnd.apple.mpegurl" and headers["cache-control"] == "max-age=1"
    headers, segment = get(on_air.url, f"/broadcast/{playlist.decode().split()[-1]}")
    assert headers["content-type"] == "video/mp4" and headers["cache-control"] == "max-age=60" and segment
    assert refused(on_air.url, "/broadcast/1.m4s")[0] == 404
    assert refused(on_air.url, "/broadcast/..%2Fserver.py")[0] == 404
    _, metrics = get(on_air.url, "/metrics")
    lines = dict(line.rsplit(" ", 1) for line in metrics.decode().splitlines() if not line.startswith("#"))
    assert lines["viewmend_broadcast_watched"] == "1"
    assert float(lines['viewmend_broadcast_files_total{kind="segments"}']) >= 1
    assert float(lines["viewmend_broadcast_bytes_total"]) > len(segment)
    assert b"watch.js" in get(on_air.url, "/watch")[1]


def test_nothing_is_done_while_nobody_watches(monkeypatch):
    monkeypatch.setattr(broadcast, "UNWATCHED_S", 1.0)
    others = [thread for thread in threading.enumerate() if thread.name == "broadcast"]
    encoders = lambda: [t for t in threading.enumerate() if t.name == "broadcast" and t not in others]  # noqa: E731
    with running(broadcast_px=SIZE) as server:
        time.sleep(0.3)
        assert not encoders() and server.service.counts["frames"] == 0
        first = get(server.url, "/broadcast/live.m3u8")[1].decode().split()[-1]
        assert len(encoders()) == 1
        wait_until(lambda: not encoders(), 10)
        time.sleep(0.2)  # a view may be in the making
        before = server.service.counts["frames"]
        time.sleep(0.4)
        assert server.service.counts["frames"] == before and not server.service._sessions
        assert refused(server.url, f"/broadcast/{first}")[0] == 404
        assert server.live._broadcast._session.picture is None, "the next film begins with a new one"
        again = get(server.url, "/broadcast/live.m3u8")[1].decode()  # who comes back finds a film that counts on
        assert "#EXT-X-DISCONTINUITY" in again and int(again.split()[-1].removesuffix(".m4s")) > int(first[:-4])
    assert not encoders()


def test_an_encoder_that_fails_is_begun_anew_and_no_viewer_feels_it(monkeypatch, caplog):
    whole, failures = film_segments.FilmSegments.add, []

    def add(self, picture, at):
        if at >= 4 and not failures and self._size_px == (64, 48):
            failures.append(at)
            raise RuntimeError("no more")
        whole(self, picture, at)

    monkeypatch.setattr(film_segments.FilmSegments, "add", add)
    with running(broadcast_px=(64, 48)) as server, Client(server.ws) as viewer:
        assert get(server.url, "/broadcast/live.m3u8")[1].startswith(b"#EXTM3U")
        assert failures and "while encoding the broadcast" in caplog.text
        assert viewer.frame(viewer.look(width=48, height=48)).header["width"] == 48


def test_a_slow_encoder_leaves_pictures_out_and_no_time(monkeypatch):
    at_times = []

    def slow(self, picture, at):
        if self._size_px == (64, 48):
            at_times.append((at, time.monotonic()))
            time.sleep(0.25)

    monkeypatch.setattr(film_segments.FilmSegments, "add", slow)
    monkeypatch.setattr(broadcast_answers, "FIRST_S", 1.5)
    with running(broadcast_px=(64, 48)) as server:
        fps = frames_per_second(server.service.supply.span.fps)
        assert refused(server.url, "/broadcast/live.m3u8") == (503, refusal_text())
        start = at_times[0][1]
        assert len(at_times) > 4
        assert all(0 <= seen - start - at / fps < 0.25 for at, seen in at_times[:8])
        assert [at for at, _ in at_times] == sorted({at for at, _ in at_times})


def refusal_text():
    return '{"error":"the film did not begin in time; see /health"}'


def test_without_a_broadcast_there_is_none_and_it_is_said(ball):
    assert refused(ball.url, "/broadcast/live.m3u8")[0] == 404
    with Client(ball.ws) as viewer:
        assert viewer.messages["welcome"]["broadcast"] is False
        viewer.on_air()
        assert "--broadcast" in viewer.wait_for("error")["message"]
        assert "on_air" not in viewer.wait_for("state")


def test_of_a_viewer_who_compares_the_first_picture_is_on_air(on_air):
    session = broadcast.BroadcastSession(on_air.service, SIZE, None)
    session.look(Look(modes=("rendered", "mended"), moving=True, depth=True, scale=0.5))
    playback = Playback(Span(0, 1, 1), 0.0, rig_frame(ring(4), torch.zeros(3), None), lambda time: True, 1)
    request = session.next_request(time.monotonic(), playback)
    assert session.newest_look.modes == ("rendered",) and not request.quality.mend, "nothing is mended for nobody"
    assert tuple(request.cameras[0].size_px[0].tolist()) == SIZE


def test_the_token_opens_the_film_and_goes_along():
    token = "0123456789abcdef&="
    with running(broadcast_px=SIZE, token=token) as server:
        assert refused(server.url, "/broadcast/live.m3u8")[0] == 401
        plain = get(server.url, "/broadcast/live.m3u8", token)[1].decode()
        assert token not in plain and "?" not in plain
        with av.open(f"{server.url}/broadcast/live.m3u8?token=0123456789abcdef%26%3D", timeout=20) as container:
            assert next(container.decode(video=0)).width == SIZE[0]


def test_a_query_is_put_behind_every_file_of_a_playlist():
    playlist = b'#EXTM3U\n#EXT-X-MAP:URI="init.mp4"\n#EXTINF:1.0,\n7.m4s\n#EXTINF:1.0,\n8.m4s\n'
    expected = b'#EXTM3U\n#EXT-X-MAP:URI="init.mp4?token=a"\n#EXTINF:1.0,\n7.m4s?token=a\n#EXTINF:1.0,\n8.m4s?token=a\n'
    assert with_query(playlist, "?token=a") == expected and with_query(playlist, "") == playlist


def test_who_loses_the_connection_is_on_air_again(on_air):
    with Client(on_air.ws, again_s=10.0) as viewer:
        viewer.frame(viewer.look(width=48, height=48))
        viewer.on_air()
        told(viewer, on_air=True)
        loop = on_air.server.servers[0].get_loop()
        for connection in list(on_air.server.server_state.connections):
            loop.call_soon_threadsafe(connection.transport.abort)
        while viewer.connections < 2:
            viewer.frame()
        told(viewer, on_air=True)


def test_the_film_shows_as_much_height_as_the_viewer_sees(on_air):
    frame = on_air.service.renderer.frame
    seen = view_camera(Camera(azimuth=20.0, fx=90.0, fy=100.0, cx=20.0, cy=70.0), frame, (160, 120))
    look = Look(camera=Camera(azimuth=20.0, fx=90.0, fy=100.0, cx=20.0, cy=70.0), width=160, height=120)
    film = view_camera(centred(look), frame, SIZE)
    assert float(film.K[0, 1, 1]) / SIZE[1] == pytest.approx(float(seen.K[0, 1, 1]) / 120, rel=1e-5)
    assert film.K[0, :2, 2].tolist() == [SIZE[0] / 2, SIZE[1] / 2]
    assert film.camera_from_world[0].tolist() == seen.camera_from_world[0].tolist()
    assert centred(Look(camera=Camera(azimuth=20.0, fov_y=33.0))).fov_y == 33.0
    left = Look(eyes=(Camera(azimuth=1.0), Camera(azimuth=2.0)))
    assert centred(left).azimuth == 1.0


@pytest.mark.parametrize(("source", "film"), [(0.0, 10), (1.0, 5), (14.985, 15), (25.0, 25), (240.0, 30)])
def test_a_film_has_as_many_frames_as_its_source_within_bounds(source, film):
    assert frames_per_second(source) == film
