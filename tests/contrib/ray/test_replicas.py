"""`viewmend serve --ray`: its options, its application behind a proxy, and the command with a local cluster."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
from live.live_servers import PIPELINE, get, in_own_loop

from viewmend.cli import main
from viewmend.contrib.ray import cluster, replicas
from viewmend.contrib.ray.replicas import ManyViewers, StartWhenReady, _demand_no_serve, serving
from viewmend.live.client import Client
from viewmend.live.push import PushSource
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService
from viewmend.models.smooth_fill import SmoothFill
from viewmend.stream import StreamConfig

TOKEN = "a token, long enough"
SMALL = [
    "--port",
    "0",
    "--size",
    "96",
    "--cameras",
    "4",
    "--frames",
    "2",
    "--model",
    "nearest",
    "--token",
    TOKEN,
]
HAS_IT = {"Authorization": f"Bearer {TOKEN}"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["live"], "expected a capture, rig.toml or studio with --ray, got live"),
        (["--replicas", "0"], "--replicas"),
        (["--replicas", "3", "--max-replicas", "2"], "--max-replicas"),
        (["--host", "0.0.0.0"], "expected --token with --host 0.0.0.0"),
    ],
)
def test_invalid_options_are_one_line(capsys, arguments, words):
    assert main(["serve", "--ray", "local", *arguments]) == 2
    message = capsys.readouterr().err
    assert words in message and message.count("\n") == 1


def test_without_ray_the_error_names_the_extra(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr(os, "environ", dict(os.environ))
    assert main(["serve", "--ray", "local"]) == 2
    assert "install viewmend's extra 'ray'" in capsys.readouterr().err


def test_a_local_cluster_has_a_token_and_sends_no_reports(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", ray := object())
    monkeypatch.setattr(os, "environ", {})
    assert cluster.find_ray("10.0.0.1:6379") is ray
    assert "RAY_AUTH_TOKEN" not in os.environ and os.environ["RAY_USAGE_STATS_ENABLED"] == "0"
    assert cluster.find_ray(cluster.LOCAL) is ray
    assert os.environ["RAY_AUTH_MODE"] == "token" and len(os.environ["RAY_AUTH_TOKEN"]) >= 32
    assert (
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] == "0"
        and cluster.AS_URGENT.items() <= os.environ.items()
    )


def test_a_cluster_on_which_serve_runs_is_refused():
    def absent(name, namespace):
        raise ValueError

    _demand_no_serve(SimpleNamespace(get_actor=absent))
    with pytest.raises(ValueError, match="on which Serve does not run"):
        _demand_no_serve(SimpleNamespace(get_actor=lambda name, namespace: name))


def test_replicas_of_one_machine_share_its_memory():
    def served(most):
        served_by = {
            "open_source": dict,
            "load_inpainter": dict,
            "server": ServerConfig(),
            "stream": StreamConfig(),
        }
        return ManyViewers(**served_by, device="cpu", replicas=(1, most), store_mb=1000.0)

    assert 2 * served(2).replica_mb == pytest.approx(400.0) and served(100).replica_mb == served(8).replica_mb
    with pytest.raises(OSError, match="choose another"), socket.create_server(("127.0.0.1", 0)) as taken:
        config = ServerConfig(port=taken.getsockname()[1])
        with serving(ManyViewers(**vars(served(2)) | {"server": config}), "local"):
            pass


def test_all_models_have_the_precision_of_the_option(monkeypatch, capsys):
    settings, asked, made = [], [], []

    def stop(**served):
        settings.append(ManyViewers(**served))
        raise ValueError("enough")

    monkeypatch.setattr("viewmend.cli.serve.import_object", lambda name: stop)
    assert main(["serve", "studio", "--ray", "local", "--precision", "float32"]) == 2
    assert "enough" in capsys.readouterr().err
    monkeypatch.setattr(replicas, "error_model_for", lambda *given: asked.append(given[1:]))
    monkeypatch.setattr(replicas, "Renderer", lambda *given, **more: made.append(Renderer(*given, **more)))
    monkeypatch.setattr(replicas, "RenderService", lambda *_: None)
    monkeypatch.setattr(replicas, "LiveServer", MagicMock())
    replicas._replica(replace(settings[0], load_inpainter=SmoothFill), replicas.RayIngest(None))
    assert asked == [("cpu", "float32")] and made[0]._precision == "float32"


async def ask(app, path, query=b"", headers=()):
    """Status and body, without a socket."""
    sent = []
    scope = {"type": "http", "method": "GET", "path": path, "query_string": query, "http_version": "1.1"}
    scope |= {
        "headers": [(b"host", b"127.0.0.1:8008"), *headers],
        "server": ("127.0.0.1", 8008),
        "root_path": "",
    }

    async def send(message):
        sent.append(message)

    async def receive():
        return {"type": "http.request", "body": b"", "more_body": False}

    await app(scope, receive, send)
    return sent[0]["status"], b"".join(message.get("body", b"") for message in sent)


@in_own_loop
async def test_token_and_origin_are_checked_behind_a_proxy_which_has_connection_limits_of_its_own():
    async def ready():
        pass

    source = PushSource()
    service = RenderService(Renderer(source, SmoothFill(), PIPELINE), source)
    open_app, app = (
        StartWhenReady(LiveServer(service, ServerConfig(token=t)).app(), ready) for t in (None, TOKEN)
    )
    status, body = await ask(open_app, "/")
    assert status == 200 and b"viewmend" in body
    assert (await ask(app, "/health"))[0] == 401
    assert (await ask(app, "/health", b"token=a+token%2C+long+enough"))[0] == 200
    assert (await ask(app, "/", headers=[(b"origin", b"http://elsewhere.example")]))[0] == 403


@in_own_loop
async def test_the_start_is_reported_when_the_first_view_is_rendered():
    order = []

    async def app(scope, receive, send):
        await send({"type": "lifespan.startup.complete"})

    async def ready():
        order.append("ready")

    async def send(message):
        order.append(message["type"])

    await StartWhenReady(app, ready)({"type": "lifespan"}, None, send)
    assert order == ["ready", "lifespan.startup.complete"]


@contextlib.contextmanager
def started(*options):
    """The command, once it has printed its address."""
    command = [sys.executable, "-m", "viewmend", "serve", "--ray", "local", *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        assert server.stderr is not None
        try:
            line = server.stderr.readline()
            found = re.search(r"http://127\.0\.0\.1:\d+", line)
            assert found, line + server.stderr.read()
            yield server, found[0]
        finally:
            server.send_signal(signal.SIGTERM)
            assert server.wait(60) == 143


@pytest.mark.slow
@pytest.mark.usefixtures("with_ray")
def test_a_viewer_reconnects_when_its_replica_is_killed():
    with started(*SMALL) as (_, address):
        assert get(f"{address}/frame.jpg")[0] == 401
        status, _, picture = get(f"{address}/frame.jpg?width=64&height=64", HAS_IT)
        assert status == 200 and picture.startswith(b"\xff\xd8")
        replicas = {json.loads(get(f"{address}/health", HAS_IT)[2])["process"] for _ in range(40)}
        assert len(replicas) == 2, "requests go to both"
        with Client(address.replace("http", "ws"), TOKEN, reconnect_s=60.0) as viewer:
            look = viewer.look(camera={"azimuth": 77.0}, width=48, height=48)
            before = viewer.frame(look)
            for process in replicas:  # one of them serves the viewer
                os.kill(process, signal.SIGKILL)
            while viewer.connections == 1:
                viewer.frame(viewer.look(camera={"azimuth": 77.0}, width=48, height=48))
            after = viewer.frame(viewer.look(camera={"azimuth": 77.0}, width=48, height=48))
            assert after.header["cameras"][0]["R"] == before.header["cameras"][0]["R"]


@pytest.mark.slow
@pytest.mark.usefixtures("with_ray")
def test_an_unusable_source_is_the_same_error_as_without_ray(tmp_path):
    (tmp_path / "empty").mkdir()
    command = [
        sys.executable,
        "-m",
        "viewmend",
        "serve",
        str(tmp_path / "empty"),
        "--ray",
        "local",
        "--port",
        "0",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    alone = subprocess.run(
        [*command[:-4], "--port", "0"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == alone.returncode == 2 and alone.stderr.strip()
    assert done.stderr == alone.stderr
