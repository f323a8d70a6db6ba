"""Servers in this process: a small ball, seen by six cameras, in two frames."""

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from reference.ball import BallCapture, ring

from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.coarse_fill import SmoothFill
from viewmend.live.frames import ReadAhead
from viewmend.live.listener import Server
from viewmend.live.renderer import Renderer
from viewmend.live.server import LiveServer, ServerConfig
from viewmend.live.service import RenderService
from viewmend.stream import StreamConfig

CAMERAS = ring(12)[[0, 1, 2, 4, 7, 9]]
PIPELINE = StreamConfig(hull=HullConfig(resolution=32))


@dataclass
class Running:
    """A server and what it is made of."""

    url: str
    service: RenderService
    live: LiveServer
    server: Server

    @property
    def ws(self) -> str:
        return self.url.replace("http", "ws")


@contextlib.contextmanager
def running(supply=None, inpainter=None, ready=True, **config) -> Iterator[Running]:
    """A server on a free port, stopped at the end."""
    supply = supply or ReadAhead(lambda: BallCapture(CAMERAS, 3))
    settings = ServerConfig(**({"port": 0, "budget_ms": None} | config))
    service = RenderService(Renderer(supply, inpainter or SmoothFill(), PIPELINE), supply)
    live = LiveServer(service, settings)
    server = Server(live, settings)
    with server.bound() as url:
        thread = threading.Thread(target=server.run_bound)
        thread.start()
        try:
            wait_until(lambda: server.started and (service.ready or not ready))
            yield Running(url, service, live, server)
        finally:
            server.should_exit = True
            thread.join(20)
            assert not thread.is_alive(), "the server does not stop"


def wait_until(true, seconds: float = 15.0) -> None:
    """Until something is so."""
    end = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < end, "that did not happen in time"
        time.sleep(0.01)
