"""Servers in this process, which show a small ball seen by six cameras, and helpers to talk to them."""

import asyncio
import contextlib
import functools
import json
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch
from reference.ball import BallCapture, camera_at, photograph, ring
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from viewmend.geometry.fusion import FusionConfig
from viewmend.geometry.hull import HullConfig
from viewmend.live.client import Client
from viewmend.live.frame_source import RecordedSource
from viewmend.live.listener import Server
from viewmend.live.poses import view_camera
from viewmend.live.protocol import Camera
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService
from viewmend.models.base import DepthMap
from viewmend.models.smooth_fill import SmoothFill
from viewmend.stream import StreamConfig
from viewmend.types import CompletedView, IncompleteView


class SmallerFill(SmoothFill):
    """Predicts the proxy's depth, moved away by 20 cm, so that fused meshes are smaller than hulls."""

    predicts_depth = True

    def predict_depth(self, view, context):
        inside = (view.depth > 0).float()
        return DepthMap((view.depth + 0.2) * inside, inside)


CAMERAS = ring(12)[[0, 1, 2, 4, 7, 9]]
PIPELINE = StreamConfig(
    hull=HullConfig(resolution=32), fusion=FusionConfig(resolution=64, max_views=8, view_px=64)
)
WAIT_S = 300.0
"""How long anything may take on a busy machine."""


def wait_until(condition, seconds: float = WAIT_S) -> None:
    """Poll until the condition holds; the only place where tests sleep."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"not within {seconds} s"
        time.sleep(0.01)


class FakeClock:
    """A clock that only moves when a test advances it."""

    def __init__(self, now_s: float = 1000.0) -> None:
        self.now_s = now_s

    def __call__(self) -> float:
        return self.now_s

    def advance(self, seconds: float) -> None:
        self.now_s += seconds


@dataclass
class Running:
    """A server and its parts."""

    url: str
    service: RenderService
    live: LiveServer
    server: Server

    @property
    def ws(self) -> str:
        return self.url.replace("http", "ws")

    @property
    def port(self) -> int:
        return int(self.url.rsplit(":", 1)[1])

    @property
    def connections(self):
        return self.server.limits.connections

    def is_serving(self) -> bool:
        """Whether a new viewer gets a view."""
        with Client(self.ws, token=self.live._config.token, timeout_s=WAIT_S) as viewer:
            return bool(viewer.frame(viewer.look(width=32, height=32, modes=["rendered"])).images)


@contextlib.contextmanager
def running(
    source=None, inpainter=None, ready=True, now=time.monotonic, completed_cameras=0, **config
) -> Iterator[Running]:
    """A server on a free port, stopped at the end."""
    source = source or RecordedSource(lambda: BallCapture(CAMERAS, 3))
    settings = ServerConfig(**({"port": 0, "budget_ms": None} | config))
    model = inpainter or SmoothFill()
    renderer = Renderer(source, model, PIPELINE, completed_cameras=completed_cameras)
    service = RenderService(renderer, source, now)
    live = LiveServer(service, settings)
    server = Server(live, settings)
    with server.bind() as url:
        thread = threading.Thread(target=server.run)
        thread.start()
        try:
            wait_until(lambda: server._uvicorn.started and (service.is_ready or not ready))
            yield Running(url, service, live, server)
        finally:
            server.stop()
            thread.join(WAIT_S)
            assert not thread.is_alive(), "the server does not stop"


def in_own_loop(test):
    """Runs an async test in a thread of its own: tests of the page leave an event loop running in this one."""

    @functools.wraps(test)
    def run(*arguments, **options):
        with ThreadPoolExecutor(1) as own:
            own.submit(asyncio.run, test(*arguments, **options)).result()

    return run


def get(url, headers=None, data=None):
    """Status, headers and body of a GET, or of a POST if there is data."""
    request = urllib.request.Request(url, data=data, headers=headers or {})
    try:
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
            return answer.status, answer.headers, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read()


def post(url, **body):
    """Status and body of a POST of JSON."""
    status, _, content = get(url, data=json.dumps(body).encode())
    return status, content


def decode(jpeg):
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)


def true_image(home, size, **camera):
    """The ball, as this camera sees it."""
    return photograph(view_camera(Camera(**camera), home, size)).rgb[0].movedim(0, -1).numpy()


def open_socket(server):
    """A plain connection to the server."""
    return socket.create_connection(("127.0.0.1", server.port), timeout=WAIT_S)


def exchange(server, sent):
    """The head of the answer to these bytes."""
    with open_socket(server) as raw:
        raw.sendall(sent)
        answer = b""
        with contextlib.suppress(ConnectionResetError):
            while b"\r\n\r\n" not in answer and (more := raw.recv(65536)):
                answer += more
    return answer


def open_websocket(server, path="/ws", **options):
    return connect(f"{server.ws}{path}", max_size=None, compression=None, **options)


def say_hello(websocket, codecs=()):
    """Send the first message; returns the answer."""
    websocket.send(json.dumps({"type": "hello", "version": 1, "codecs": list(codecs)}))
    return json.loads(websocket.recv(timeout=WAIT_S))


def close_code(websocket):
    """The code with which the server closes a WebSocket; None if the connection just ends."""
    while True:
        try:
            websocket.recv(timeout=WAIT_S)
        except ConnectionClosed as closed:
            return closed.rcvd.code if closed.rcvd else None


@pytest.fixture(scope="module")
def ball() -> Iterator[Running]:
    """A server for all tests of a file; tests leave it as it was."""
    with running() as server:
        yield server


@pytest.fixture
def ball_view() -> CompletedView:
    """The ball with a square hole, completed."""
    camera = camera_at(10, "t")
    frame = photograph(camera)
    mask = (frame.mask[0] > 0).float()
    error = torch.zeros_like(mask)
    error[20:26, 20:26] = 1
    weights = torch.zeros(2, 48, 48)
    weights[0, :, :24], weights[1, :, 24:] = 1, 1
    rgb = frame.rgb[0] / 255
    view = IncompleteView(
        camera, rgb * (1 - error), mask, error, frame.depth[0], ("a", "b"), weights * mask * (1 - error), 0
    )
    return CompletedView(view, rgb)
