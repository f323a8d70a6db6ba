"""The server over real sockets: images, videos, metrics, and viewers' WebSockets."""

import http.client
import io
import json
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from live.live_servers import (
    CAMERAS,
    decode,
    exchange,
    get,
    open_socket,
    post,
    running,
    true_image,
    wait_until,
)
from reference.ball import BallCapture

from viewmend.live import frame_source, render_jobs
from viewmend.live.client import Client
from viewmend.live.frame_source import RecordedSource
from viewmend.live.poses import stereo_pair, view_camera
from viewmend.live.protocol import Camera, Limits, ProtocolError, read_message
from viewmend.live.render_jobs import PathJob, parse_path
from viewmend.models.smooth_fill import SmoothFill
from viewmend.rendering.error_mask import ERROR_RULES
from viewmend.rendering.proxy_views import CLAY

ERROR_RULE = next(iter(ERROR_RULES))
"""The default: pixels that no camera colours."""


def test_the_command_is_parsed_before_torch_is_imported():
    """`serve` sets the policy of torch's threads, which is read at import."""
    code = "import sys; import viewmend.cli, viewmend.cli.serve; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_health_and_metrics(ball):
    status, _, body = get(f"{ball.url}/health")
    health = json.loads(body)
    assert (
        status == 200
        and health["status"] == "ok"
        and health["source"] == "ready"
        and health["name"] == "ball"
    )
    status, headers, body = get(f"{ball.url}/metrics")
    assert status == 200 and headers["content-type"].startswith("text/plain")
    lines = [line for line in body.decode().splitlines() if not line.startswith("#")]
    values = {line.rsplit(" ", 1)[0]: float(line.rsplit(" ", 1)[1]) for line in lines}
    assert values["viewmend_up"] == 1
    stages = [name.split('"')[1] for name in values if name.startswith("viewmend_stage_seconds_total")]
    assert stages == ["geometry", "context", "rendering", "inpainting", "encode"]
    if Path("/proc/self/statm").exists():
        assert 50e6 < values["process_resident_memory_bytes"] < 100e9


def test_an_image_from_a_requested_camera(ball):
    home = ball.service.renderer.home
    for azimuth in (20, 200):
        status, headers, body = get(
            f"{ball.url}/frame.jpg?azimuth={azimuth}&time=0&width=64&height=48&mode=completed"
        )
        image = decode(body)
        assert status == 200 and image.shape == (48, 64, 3) and headers["x-viewmend-time"] == "0"
        timing = dict(part.split(";dur=") for part in headers["server-timing"].split(", "))
        assert (
            list(timing) == ["geometry", "context", "rendering", "inpainting"]
            and float(timing["rendering"]) > 0
        )
        right = true_image(home, (64, 48), azimuth=float(azimuth), elevation=0.0)
        assert np.abs(image.astype(float) - right).mean() < 14
    query = f"{ball.url}/frame.jpg?azimuth=200&time=0&width=64&height=48&mode=holes"
    assert np.abs(decode(get(query)[2]).astype(float) - image).mean() > 1.5
    green = decode(get(f"{query}&background=00ff00")[2])
    assert np.abs(green[:4, :4].astype(int) - (0, 255, 0)).max() < 12


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("frame.jpg?azimuth=x", "azimuth: expected a number"),
        ("frame.jpg?width=99999", "from 16 to 2048"),
        ("frame.jpg?mode=naked", "mode: expected rendered or holes"),
        ("frame.jpg?error_rule=some", "error_rule: expected "),
        ("frame.jpg?time=soon", "time: expected"),
        ("frame.jpg?distanse=3", "expected keys among"),
        ("frame.jpg?elevation=90", "elevation: expected"),
        ("frame.jpg?azimuth=nan", "azimuth: expected"),
        *(
            (f"frame.jpg?background={colour}", "expected")
            for colour in ("red", "00ff0", "00FF00", "00ff00%0A")
        ),
        *(
            (f"camera.jpg?{query}", "expected")
            for query in ("", "name=none", "name=none&time=x", "name=none&size=3")
        ),
        ("camera.jpg?name=" + 99 * "a", "expected"),
    ],
)
def test_invalid_queries_are_refused(ball, query, words):
    status, _, body = get(f"{ball.url}/{query}")
    assert status == 400 and words in json.loads(body)["error"]


def test_a_viewer_gets_its_view_and_frame(ball):
    with Client(ball.ws) as viewer:
        welcome = viewer.messages["welcome"]
        assert (
            welcome["version"] == 1
            and welcome["modes"][2] == "completed"
            and welcome["limits"]["viewers"] == 8
        )
        rig = viewer.wait_for("rig")
        assert [camera["name"] for camera in rig["cameras"]] == list(CAMERAS.names) and rig["name"] == "ball"
        viewer.send("clock", playing=False, seek=0)
        look = viewer.look(
            camera={"azimuth": 200.0},
            width=64,
            height=64,
            modes=["rendered", "completed"],
            depth=True,
            quality=95,
        )
        shown = viewer.frame(look, full=True)
        assert set(shown.images) == {(0, "rendered"), (0, "completed")} and shown.header["time"] == 0
        right = true_image(ball.service.renderer.home, (64, 64), azimuth=200.0)
        errors = {
            mode: np.abs(image - right.astype(float)).mean() for (_, mode), image in shown.images.items()
        }
        assert errors["completed"] < 12 and errors["completed"] < errors["rendered"]
        assert shown.depth[0].shape == (64, 64) and 1.4 < shown.depth[0][32, 32] < 1.6
        assert 0 < shown.latency_ms < 20_000
        while (state := viewer.messages["state"])["playing"]:
            viewer.wait_for("state")
        assert state["time"] == 0 and state["total"] == 3


def test_a_viewer_chooses_the_error_rule(ball):
    with Client(ball.ws) as viewer:
        welcome = viewer.messages["welcome"]
        assert welcome["error_rules"] == list(ERROR_RULES) and welcome["error_rule"] == ERROR_RULE
        viewer.send("clock", playing=False, seek=0)
        shown = {}
        for rule in (None, ERROR_RULE, "all"):
            look = viewer.look(width=64, height=64, error_rule=rule)
            shown[rule] = viewer.frame(look, full=True)
    own, holes, whole = (frame.images[0, "completed"].astype(int) for frame in shown.values())
    assert (own == holes).all()
    assert np.abs(whole - own).mean() > 5, "the ball is filled from its black surroundings"
    assert shown["all"].header.get("confidence") is None
    query = f"{ball.url}/frame.jpg?time=0&width=64&height=64&error_rule="
    holes, whole = (decode(get(query + rule)[2]).astype(int) for rule in (ERROR_RULE, "all"))
    assert np.abs(holes - whole).mean() > 5


def test_stereo_views_have_two_eyes_of_one_frame(ball):
    with Client(ball.ws) as viewer:
        eyes = [{"azimuth": 100.0}, {"azimuth": 103.0}]
        shown = viewer.frame(viewer.look(eyes=eyes, width=48, height=48, depth=True))
        assert set(shown.images) == {(0, "completed"), (1, "completed")} and set(shown.depth) == {0, 1}
        assert len(shown.header["cameras"]) == 2
        assert np.abs(shown.images[0, "completed"].astype(int) - shown.images[1, "completed"]).mean() > 0.5


def test_playback_pauses_seeks_and_follows_the_edge(ball):
    with Client(ball.ws) as viewer:
        look = viewer.look(width=32, height=32, modes=["rendered"])
        times = set()
        wait_until(lambda: times.add(viewer.frame(look).header["time"]) or len(times) >= 2)
        viewer.send("clock", seek=1, playing=False)
        wait_until(lambda: (viewer.wait_for("state")["time"], viewer.messages["state"]["live"]) == (1, False))
        viewer.send("clock", live=True)
        wait_until(lambda: viewer.wait_for("state")["live"])
        wait_until(lambda: viewer.frame(look).header["time"] != 1)
        stats = viewer.wait_for("stats")
        assert stats["fps"] > 0 and set(stats["stage_ms"]) >= {
            "geometry",
            "rendering",
            "inpainting",
            "encode",
        }


def test_a_turntable_shows_the_whole_motion(ball):
    query = "time=2&frames=30&azimuth=40&arc=180&elevation=20&width=96&height=64"
    status, _, body = get(f"{ball.url}/turntable?{query}")
    fitted = json.loads(body)
    assert status == 200 and np.abs(fitted["target"]).max() < 0.1, "the ball moves about the origin"
    for azimuth in (-50.0, 40.0, 130.0):
        lens = {"fx": fitted["f"], "cx": 48.0, "cy": 32.0}
        pose = {
            "azimuth": azimuth,
            "elevation": 20.0,
            "distance": fitted["distance"],
            "target": fitted["target"],
        }
        for time in range(3):
            with Client(ball.ws) as viewer:
                viewer.send("clock", playing=False, seek=time)
                look = viewer.look(camera=pose | lens, width=96, height=64, modes=["holes"])
                subject = viewer.frame(look, full=True).images[0, "holes"].max(-1) > 40
            assert subject.any() and not subject[[0, -1]].any() and not subject[:, [0, -1]].any()
    assert subject.any(1).sum() > 45, "it fills the image"
    assert get(f"{ball.url}/turntable?time=0&frames=1000")[0] == 400


def test_viewers_get_their_own_views_and_share_geometry(ball):
    seen: dict[int, list] = {}

    def watch(azimuth):
        with Client(ball.ws) as viewer:
            viewer.send("clock", seek=2, playing=False)
            look = viewer.look(
                camera={"azimuth": float(azimuth)}, width=48, height=48, modes=["rendered"], quality=95
            )
            seen[azimuth] = [viewer.frame(look, full=True).images[0, "rendered"]]
            seen[azimuth] += [
                viewer.frame(
                    viewer.look(camera={"azimuth": float(azimuth)}, width=48, height=48, modes=["rendered"])
                )
                for _ in range(5)
            ]

    threads = [threading.Thread(target=watch, args=(azimuth,)) for azimuth in (0, 90, 180, 270)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    home = ball.service.renderer.home
    rights = {a: true_image(home, (48, 48), azimuth=float(a)) * (1 - 0.1 * 2) for a in seen}
    assert len(seen) == 4
    for azimuth, (image, *later) in seen.items():
        errors = {other: np.abs(image - right).mean() for other, right in rights.items()}
        assert min(errors, key=errors.get) == azimuth, "another viewer's view"
        assert sum(f.header["stage_ms"]["geometry"] == 0 for f in later) == len(later)


def test_the_number_of_viewers_is_limited():
    with running(limits=Limits(viewers=2)) as server, Client(server.ws), Client(server.ws):
        with pytest.raises(ConnectionError, match="at most 2 viewers"):
            Client(server.ws).__enter__()
        assert json.loads(get(f"{server.url}/health")[2])["viewers"] == 2
    with running(ready=False) as server:
        with Client(server.ws):
            pass
        wait_until(lambda: not server.live.registry.sessions)


def read_video(video: bytes):
    """Frames, and how many a second."""
    with av.open(io.BytesIO(video)) as container:
        fps = container.streams.video[0].average_rate
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)], fps


def test_a_path_becomes_a_video(ball):
    poses = [{"azimuth": 20.0 * n} for n in range(5)]
    body = {
        "poses": poses,
        "times": [0, 0, 1, 1, 2],
        "fps": 10,
        "width": 64,
        "height": 48,
        "mode": "completed",
    }
    status, headers, video = get(f"{ball.url}/path.mp4", data=json.dumps(body).encode())
    assert status == 200 and headers["content-type"] == "video/mp4", video
    frames, fps = read_video(video)
    assert len(frames) == 5 and fps == 10 and frames[0].shape == (48, 64, 3)
    assert np.abs(frames[0].astype(int) - frames[4]).mean() > 3
    right = true_image(ball.service.renderer.home, (64, 48), azimuth=0.0)
    assert np.abs(frames[0] - right.astype(float)).mean() < 14


@pytest.mark.parametrize(
    ("body", "said"),
    [
        *((body, "expected") for body in (b"", b"[]", b'{"poses": []}', b"x" * 1_100_000)),
        (b'{"poses": [{}], "times": [1, 2]}', "expected a time for each"),
        (b'{"poses": [{}], "stereo_m": -1}', "stereo_m: expected"),
        (
            b'{"poses": [{}], "width": 1600, "height": 1000, "stereo_m": 0.06}',
            "expected at most 2100000 pixels",
        ),
    ],
)
def test_invalid_paths_are_refused(ball, body, said):
    status, _, answer = get(f"{ball.url}/path.mp4", data=body)
    assert status == (413 if len(body) > 1_000_000 else 400) and said in json.loads(answer)["error"]


def test_one_path_at_a_time(ball):
    body = json.dumps(
        {"poses": [{"azimuth": 20.0 * n} for n in range(4)], "width": 32, "height": 32}
    ).encode()
    clients = [http.client.HTTPConnection("127.0.0.1", ball.port, timeout=60) for _ in range(3)]
    for client in clients:
        client.putrequest("POST", "/path.mp4")
        client.putheader("Content-Length", str(len(body)))
        client.endheaders()
        wait_until(lambda: ball.live._is_exporting)
    for client in clients[1:]:  # the body of the first request is missing until then
        client.send(body)
        assert client.getresponse().status == 409
    clients[0].send(body)
    assert clients[0].getresponse().status == 200
    for client in clients:
        client.close()


def test_only_the_pages_own_files_are_served(ball):
    for path in (
        "page/../server.py",
        "page/%2e%2e/server.py",
        "page//etc/passwd",
        "page/nothing.js",
        "etc/passwd",
    ):
        status, _, body = get(f"{ball.url}/{path}")
        assert status == 404 and b"import" not in body
    files = ball.live._files
    status, headers, body = get(ball.url)
    assert status == 200 and body == files["index.html"].content
    assert headers["content-security-policy"].startswith("default-src 'self'")
    for name in files:
        assert get(f"{ball.url}/page/{name}")[0] == 200


def test_a_failing_source_is_reported_and_recovers(monkeypatch):
    monkeypatch.setattr(frame_source, "RETRY_S", 0.05)
    broken = threading.Event()
    broken.set()

    class Fragile(BallCapture):
        def read(self, time):
            if broken.is_set():
                raise OSError("the disk is on fire")
            return super().read(time)

    supply = RecordedSource(lambda: Fragile(CAMERAS, 2))
    with running(supply, ready=False) as server:
        wait_until(lambda: get(f"{server.url}/health")[0] == 503)
        assert "on fire" in get(f"{server.url}/health")[2].decode()
        with Client(server.ws) as viewer:
            wait_until(lambda: viewer.wait_for("state")["source"] == "failing")
            assert "on fire" in viewer.messages["state"]["error"]
            broken.clear()
            assert viewer.frame(viewer.look(width=32, height=32)).images
        wait_until(lambda: get(f"{server.url}/health")[0] == 200)


@pytest.mark.parametrize("said", ["RuntimeError: out of memory", "ValueError: Fragile: expected `step`"])
def test_a_failing_model_leaves_holes_and_recovers(said):
    class Fragile(SmoothFill):
        broken = False

        def step(self, view, context, state):
            if self.broken and "memory" in said:
                raise RuntimeError("out of memory")
            completed, state = super().step(view, context, state)
            return (replace(completed, rgb=completed.rgb / 0) if self.broken else completed), state

    model = Fragile()
    with running(inpainter=model) as server, Client(server.ws) as viewer:

        def image():
            return viewer.frame(viewer.look(width=48, height=48, camera={"azimuth": 200.0})).images[
                0, "completed"
            ]

        viewer.send("clock", seek=0, playing=False)
        good = image()
        model.broken = True
        assert np.abs(good.astype(int) - image()).mean() > 1
        wait_until(lambda: (viewer.wait_for("state")["model_error"] or "").startswith(said))
        status, _, body = get(f"{server.url}/health")
        assert status == 503 and said.encode() in body
        model.broken = False
        assert (image() == good).all() and get(f"{server.url}/health")[0] == 200


def test_a_cameras_own_image(ball):
    name = ball.service.renderer.rig_json["cameras"][1]["name"]
    status, headers, body = get(f"{ball.url}/camera.jpg?name={name}&time=2")
    assert status == 200 and headers["content-type"] == "image/jpeg" and headers["x-viewmend-time"] == "2"
    taken = ball.service.source.read(2).select([name]).rgb[0].movedim(0, -1).numpy()
    assert decode(body).shape == taken.shape and np.abs(decode(body) - taken.astype(int)).mean() < 4
    assert get(f"{ball.url}/camera.jpg?name={name}&time=99999")[0] == 200, "the nearest frame"


def test_the_progress_of_a_path(ball):
    assert json.loads(get(f"{ball.url}/path")[2]) == {"done": None, "of": None}
    job = PathJob(parse_path(b'{"poses": [{}, {}, {}], "width": 32, "height": 32}', Limits()))
    ball.live._path_job = job
    assert json.loads(get(f"{ball.url}/path")[2]) == {"done": 0, "of": 3}
    ball.live._path_job = None
    assert post(f"{ball.url}/path.mp4", poses=[{}, {}], width=32, height=32)[0] == 200
    assert json.loads(get(f"{ball.url}/path")[2]) == {"done": None, "of": None}


def test_an_aborted_path_leaves_no_threads():
    tasks = Path("/proc/self/task")
    if not tasks.exists():
        pytest.skip("threads are counted by /proc")
    body = json.dumps({"poses": [{"azimuth": n} for n in range(900)], "width": 320, "height": 320}).encode()
    head = f"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    with running() as server:
        assert server.is_serving()
        threads = []
        for _ in range(6):
            with open_socket(server) as raw:
                raw.sendall(head + body)
                rendered = server.service.counts["frames"]
                wait_until(lambda rendered=rendered: server.service.counts["frames"] > rendered + 3)
            wait_until(lambda: not server.live._is_exporting and not server.service._sessions)
            assert server.is_serving()
            threads.append(len(list(tasks.iterdir())))
        assert threads[-1] - threads[0] < 5, "a pool may grow by a worker or two, but not by one per path"


@pytest.mark.parametrize("body", [b'{"poses": [' + b"[[]]," * 190_000 + b"0]}", b"[" * 900_000])
def test_a_body_of_many_lists_is_refused_before_it_is_parsed(body):
    with pytest.raises(ProtocolError, match="at most 10000 lists and objects"):
        parse_path(body, Limits())
    with pytest.raises(ProtocolError, match="at most 10000 lists and objects"):
        read_message(body.decode(), dict)


def test_a_body_is_parsed_off_the_event_loop(ball, monkeypatch):
    threads = []

    def parse(*_):
        threads.append(threading.current_thread().name)
        raise ProtocolError("parsed")

    monkeypatch.setattr(render_jobs, "parse_path", parse)
    chunked = b"POST /path.mp4 HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"
    assert exchange(ball, chunked + b"1\r\nx\r\n0\r\n\r\n").startswith(b"HTTP/1.1 400")
    assert threads[0].startswith("asyncio_")


def test_the_hull_and_its_points_are_modes(ball):
    with Client(ball.ws) as viewer:
        assert {*viewer.messages["welcome"]["modes"]} >= frozenset({"hull", "points"})
        viewer.send("clock", seek=0, playing=False)
        options = {"width": 64, "height": 64, "modes": ["hull", "points"], "quality": 95}
        look = viewer.look(**options, background="ff0000", depth=True)
        shown = viewer.frame(look, full=True)
        black = viewer.frame(viewer.look(**options), full=True).images[0, "points"].astype(int)
        rendered = viewer.frame(viewer.look(width=64, height=64, modes=["rendered"], quality=95), full=True)
    hull, points = (shown.images[0, mode].astype(int) for mode in ("hull", "points"))
    assert np.abs(hull[32, 32] - 255 * np.array(CLAY)).max() < 20, "lit from the viewer"
    for corner in (hull[2, 2], points[2, 2]):
        assert corner[0] > 230 and corner[1:].max() < 25, "on the background"
    inside = shown.depth[0] > 0
    assert inside.sum() > 100
    body = np.zeros((64, 64), bool)
    body[24:40, 24:40] = True
    own = black[body & (black.sum(-1) > 150)]
    assert 20 < len(own) < 256, "dots of the ball's colours, and gaps"
    assert np.abs(own.mean(0) - rendered.images[0, "rendered"][body].mean(0)).max() < 25
    assert shown.header["stage_ms"]["inpainting"] == 0, "without the model"


def test_a_stereo_video_has_two_eyes_side_by_side(ball):
    pose, size = {"azimuth": 20.0}, {"width": 64, "height": 64}
    status, video = post(f"{ball.url}/path.mp4", poses=[pose] * 2, times=[0, 0], stereo_m=0.2, **size)
    assert status == 200, video
    both = read_video(video)[0][0].astype(int)
    assert both.shape == (64, 128, 3)
    home = ball.service.renderer.home
    eyes = stereo_pair(view_camera(Camera(**pose), home, (64, 64)), 0.2, home.center)
    for half, eye in zip((both[:, :64], both[:, 64:]), eyes, strict=True):
        pose = eye.camera_from_world[0]
        asked = {"R": pose[:3, :3].flatten().tolist(), "T": pose[:3, 3].tolist()}
        lens = {"fx": float(eye.K[0, 0, 0]), "cx": float(eye.K[0, 0, 2]), "cy": float(eye.K[0, 1, 2])}
        alone = read_video(post(f"{ball.url}/path.mp4", poses=[asked | lens], times=[0], **size)[1])[0][0]
        assert np.abs(half - alone).mean() < 2
    assert np.abs(both[:, :64] - both[:, 64:]).mean() > 1
