"""The server over real sockets: what is asked for comes, to whom asked."""

import http.client
import io
import json
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from live_servers import CAMERAS, running, wait_until
from reference.ball import BallCapture, photograph

from viewmend.live.client import Client
from viewmend.live.frames import ReadAhead
from viewmend.live.poses import view_camera
from viewmend.live.protocol import Camera, Limits
from viewmend.rendering.error_rules import ERROR_RULES


def get(url, headers=None, data=None):
    """Status, headers and body, whatever the status."""
    request = urllib.request.Request(url, data=data, headers=headers or {})
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read()


def decoded(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)


def truth(frame, size, **camera):
    """What a camera there sees of the ball."""
    asked = view_camera(Camera(**camera), frame, size)
    return photograph(asked).rgb[0].movedim(0, -1).numpy()


def test_health_and_metrics(ball):
    status, _, body = get(f"{ball.url}/health")
    health = json.loads(body)
    assert status == 200 and health["status"] == "ok" and health["source"] == "ready" and health["name"] == "ball"
    status, headers, body = get(f"{ball.url}/metrics")
    assert status == 200 and headers["content-type"].startswith("text/plain")
    lines = [line for line in body.decode().splitlines() if not line.startswith("#")]
    values = {line.rsplit(" ", 1)[0]: float(line.rsplit(" ", 1)[1]) for line in lines}
    assert values["viewmend_up"] == 1
    stages = [name.split('"')[1] for name in values if name.startswith("viewmend_stage_seconds_total")]
    assert stages == ["geometry", "context", "rendering", "inpainting", "encode"]
    if Path("/proc/self/statm").exists():
        assert 50e6 < values["process_resident_memory_bytes"] < 100e9


def test_a_picture_shows_the_subject_from_where_it_was_asked(ball):
    frame = ball.service.renderer.frame
    for azimuth in (20, 200):
        status, headers, body = get(f"{ball.url}/frame.jpg?azimuth={azimuth}&time=0&width=64&height=48&mode=mended")
        image = decoded(body)
        assert status == 200 and image.shape == (48, 64, 3) and headers["x-viewmend-time"] == "0"
        timing = dict(part.split(";dur=") for part in headers["server-timing"].split(", "))
        assert list(timing) == ["geometry", "context", "rendering", "inpainting"] and float(timing["rendering"]) > 0
        right = truth(frame, (64, 48), azimuth=float(azimuth), elevation=0.0)
        assert np.abs(image.astype(float) - right).mean() < 14
    _, _, rendered = get(f"{ball.url}/frame.jpg?azimuth=200&time=0&width=64&height=48&mode=holes")
    assert np.abs(decoded(rendered).astype(float) - image).mean() > 1.5


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("azimuth=x", "azimuth: expected a number"),
        ("width=99999", "from 16 to 2048"),
        ("mode=naked", "mode: expected rendered or holes"),
        ("error_rule=some", "error_rule: expected unseen or all"),
        ("time=soon", "time: expected"),
        ("distanse=3", "expected keys among"),
        ("elevation=90", "elevation: expected"),
        ("azimuth=nan", "azimuth: expected"),
    ],
)
def test_bad_pictures_are_refused(ball, query, words):
    status, _, body = get(f"{ball.url}/frame.jpg?{query}")
    assert status == 400 and words in json.loads(body)["error"]


def test_a_viewer_sees_what_it_asks_for_and_when(ball):
    with Client(ball.ws) as viewer:
        welcome = viewer.messages["welcome"]
        assert welcome["version"] == 1 and welcome["modes"][2] == "mended" and welcome["limits"]["viewers"] == 8
        rig = viewer.wait_for("rig")
        assert [camera["name"] for camera in rig["cameras"]] == list(CAMERAS.names) and rig["name"] == "ball"
        viewer.send("clock", playing=False, seek=0)
        look = viewer.look(
            camera={"azimuth": 200.0}, width=64, height=64, modes=["rendered", "mended"], depth=True, quality=95
        )
        shown = viewer.frame(look, full=True)
        assert set(shown.images) == {(0, "rendered"), (0, "mended")} and shown.header["time"] == 0
        right = truth(ball.service.renderer.frame, (64, 64), azimuth=200.0)
        errors = {mode: np.abs(image - right.astype(float)).mean() for (_, mode), image in shown.images.items()}
        assert errors["mended"] < 12 and errors["mended"] < errors["rendered"]
        assert shown.depth[0].shape == (64, 64) and 1.4 < shown.depth[0][32, 32] < 1.6
        assert 0 < shown.latency_ms < 20_000
        state = viewer.wait_for("state")
        assert state["playing"] is False and state["time"] == 0 and state["total"] == 3


def test_the_error_rule_is_the_viewers_choice(ball):
    with Client(ball.ws) as viewer:
        welcome = viewer.messages["welcome"]
        assert welcome["error_rules"] == list(ERROR_RULES) and welcome["error_rule"] == "unseen"
        viewer.send("clock", playing=False, seek=0)
        shown = {}
        for rule in (None, "unseen", "all"):
            look = viewer.look(width=64, height=64, error_rule=rule)
            shown[rule] = viewer.frame(look, full=True)
    own, unseen, whole = (frame.images[0, "mended"].astype(int) for frame in shown.values())
    assert (own == unseen).all()
    assert np.abs(whole - own).mean() > 5, "all of the ball is filled from about it: black"
    assert shown["all"].header.get("confidence") is None
    query = f"{ball.url}/frame.jpg?time=0&width=64&height=64&error_rule="
    unseen, whole = (decoded(get(query + rule)[2]).astype(int) for rule in ("unseen", "all"))
    assert np.abs(unseen - whole).mean() > 5


def test_stereo_is_two_eyes_of_one_time(ball):
    with Client(ball.ws) as viewer:
        eyes = [{"azimuth": 100.0}, {"azimuth": 103.0}]
        shown = viewer.frame(viewer.look(eyes=eyes, width=48, height=48, depth=True))
        assert set(shown.images) == {(0, "mended"), (1, "mended")} and set(shown.depth) == {0, 1}
        assert len(shown.header["cameras"]) == 2
        assert np.abs(shown.images[0, "mended"].astype(int) - shown.images[1, "mended"]).mean() > 0.5


def test_time_goes_on_by_itself_and_stops_when_asked(ball):
    with Client(ball.ws) as viewer:
        look = viewer.look(width=32, height=32, modes=["rendered"])
        times = {viewer.frame(look).header["time"] for _ in range(4)}
        assert len(times) >= 2
        viewer.send("clock", seek=1, playing=False)
        wait_until(lambda: (viewer.wait_for("state")["time"], viewer.messages["state"]["live"]) == (1, False))
        assert viewer.wait_for("state")["time"] == 1
        viewer.send("clock", live=True)
        wait_until(lambda: viewer.wait_for("state")["live"])
        wait_until(lambda: viewer.frame(look).header["time"] != 1)
        stats = viewer.wait_for("stats")
        assert stats["fps"] > 0 and set(stats["stage_ms"]) >= {"geometry", "rendering", "inpainting", "encode"}


def test_viewers_get_their_own_views_and_share_geometry(ball):
    seen: dict[int, list] = {}

    def watch(azimuth):
        with Client(ball.ws) as viewer:
            viewer.send("clock", seek=2, playing=False)
            look = viewer.look(camera={"azimuth": float(azimuth)}, width=48, height=48, modes=["rendered"], quality=95)
            seen[azimuth] = [viewer.frame(look, full=True).images[0, "rendered"]]
            seen[azimuth] += [
                viewer.frame(viewer.look(camera={"azimuth": float(azimuth)}, width=48, height=48, modes=["rendered"]))
                for _ in range(5)
            ]

    threads = [threading.Thread(target=watch, args=(azimuth,)) for azimuth in (0, 90, 180, 270)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    frame = ball.service.renderer.frame
    rights = {a: truth(frame, (48, 48), azimuth=float(a)) * (1 - 0.1 * 2) for a in seen}
    assert len(seen) == 4
    for azimuth, (image, *later) in seen.items():
        errors = {other: np.abs(image - right).mean() for other, right in rights.items()}
        assert min(errors, key=errors.get) == azimuth, "somebody else's view"
        assert sum(f.header["stage_ms"]["geometry"] == 0 for f in later) == len(later)


def test_too_many_viewers_are_turned_away():
    with running(limits=Limits(viewers=2)) as server, Client(server.ws), Client(server.ws):
        with pytest.raises(ConnectionError, match="at most 2 viewers"):
            Client(server.ws).__enter__()
        assert json.loads(get(f"{server.url}/health")[2])["viewers"] == 2
    with running(ready=False) as server:
        with Client(server.ws):
            pass
        wait_until(lambda: not server.live.registry.sessions)


def test_a_path_becomes_a_video(ball):
    av = pytest.importorskip("av")
    poses = [{"azimuth": 20.0 * n} for n in range(5)]
    body = {"poses": poses, "times": [0, 0, 1, 1, 2], "fps": 10, "width": 64, "height": 48, "mode": "mended"}
    status, headers, video = get(f"{ball.url}/path.mp4", data=json.dumps(body).encode())
    assert status == 200 and headers["content-type"] == "video/mp4", video
    with av.open(io.BytesIO(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].average_rate == 10
    assert len(frames) == 5 and frames[0].shape == (48, 64, 3)
    assert np.abs(frames[0].astype(int) - frames[4]).mean() > 3
    right = truth(ball.service.renderer.frame, (64, 48), azimuth=0.0)
    assert np.abs(frames[0] - right.astype(float)).mean() < 14


@pytest.mark.parametrize("body", [b"", b"[]", b'{"poses": []}', b'{"poses": [{}], "times": [1, 2]}', b"x" * 1_100_000])
def test_bad_paths_are_refused(ball, body):
    status, _, answer = get(f"{ball.url}/path.mp4", data=body)
    assert status in (400, 413) and "expected" in json.loads(answer)["error"]


def test_one_path_at_a_time(ball):
    pytest.importorskip("av")
    body = json.dumps({"poses": [{"azimuth": 20.0 * n} for n in range(4)], "width": 32, "height": 32}).encode()
    clients = [http.client.HTTPConnection("127.0.0.1", int(ball.url.rsplit(":", 1)[1]), timeout=20) for _ in range(3)]
    for client in clients:
        client.putrequest("POST", "/path.mp4")
        client.putheader("Content-Length", str(len(body)))
        client.endheaders()
    time.sleep(0.3)
    for client in clients:
        client.send(body)
    assert sorted(client.getresponse().status for client in clients) == [200, 409, 409]
    for client in clients:
        client.close()


def test_the_page_is_served_from_a_table_and_nothing_else(ball):
    for path in (
        "/page/../server.py",
        "/page/%2e%2e/server.py",
        "/page//etc/passwd",
        "/page/nothing.js",
        "/etc/passwd",
    ):
        status, _, body = get(ball.url + path)
        assert status == 404 and b"import" not in body
    files = ball.live._files
    if "index.html" in files:
        status, headers, body = get(ball.url)
        assert status == 200 and body == files["index.html"].content
        assert headers["content-security-policy"].startswith("default-src 'self'")
    for name in files:
        assert get(f"{ball.url}/page/{name}")[0] == 200


def test_a_source_that_fails_is_said_and_recovers():
    broken = threading.Event()
    broken.set()

    class Fragile(BallCapture):
        def read(self, time):
            if broken.is_set():
                raise OSError("the disk is on fire")
            return super().read(time)

    supply = ReadAhead(lambda: Fragile(CAMERAS, 2))
    with running(supply, ready=False) as server:
        wait_until(lambda: get(f"{server.url}/health")[0] == 503)
        assert "on fire" in get(f"{server.url}/health")[2].decode()
        with Client(server.ws) as viewer:
            wait_until(lambda: viewer.wait_for("state")["source"] == "failing")
            assert "on fire" in viewer.messages["state"]["error"]
            broken.clear()
            assert viewer.frame(viewer.look(width=32, height=32)).images
        wait_until(lambda: get(f"{server.url}/health")[0] == 200)


@pytest.mark.parametrize("way", ["out of memory", "not finite"])
def test_a_model_that_fails_shows_holes_and_recovers(way):
    from viewmend.inpainting.coarse_fill import SmoothFill

    class Fragile(SmoothFill):
        broken = False

        def step(self, view, context, state):
            if self.broken and way == "out of memory":
                raise RuntimeError("out of memory")
            completed, state = super().step(view, context, state)
            return (replace(completed, rgb=completed.rgb / 0) if self.broken else completed), state

    model = Fragile()
    said = (
        "RuntimeError: out of memory" if way == "out of memory" else "ValueError: expected finite colours from Fragile"
    )
    with running(inpainter=model) as server, Client(server.ws) as viewer:
        viewer.send("clock", seek=0, playing=False)
        good = viewer.frame(viewer.look(width=48, height=48, camera={"azimuth": 200.0})).images[0, "mended"]
        model.broken = True
        bad = viewer.frame(viewer.look(width=48, height=48, camera={"azimuth": 200.0})).images[0, "mended"]
        assert np.abs(good.astype(int) - bad).mean() > 2
        wait_until(lambda: (viewer.wait_for("state")["model_error"] or "").startswith(said))
        status, _, body = get(f"{server.url}/health")
        assert status == 503 and said.encode() in body
        model.broken = False
        again = viewer.frame(viewer.look(width=48, height=48, camera={"azimuth": 200.0})).images[0, "mended"]
        assert (again == good).all() and get(f"{server.url}/health")[0] == 200
