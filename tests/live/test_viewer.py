"""The server from Python: an address, what pages show, and an end; and the command that opens a browser."""

import asyncio
import json
import math
import time
import urllib.error
import urllib.request
from unittest.mock import Mock

import pytest
from live.live_servers import CAMERAS, PIPELINE, WAIT_S, get, in_own_loop, say_hello
from reference.ball import BallCapture
from websockets.sync.client import connect

from viewmend import serve
from viewmend.cli import main, view
from viewmend.data.native_writer import write_capture
from viewmend.live.connection import ViewerConnection
from viewmend.live.frame_source import SourceStatus, Span
from viewmend.live.protocol import Limits
from viewmend.live.registry import SessionRegistry
from viewmend.live.service import RenderService
from viewmend.live.viewer import Viewer
from viewmend.models.smooth_fill import SmoothFill
from viewmend.studio.stage import Studio, StudioConfig

TOKEN = "a token of a test, long enough"


def messages(socket, kind):
    """The messages of a kind, as they come."""
    while True:
        message = socket.recv(timeout=60)
        if isinstance(message, str) and json.loads(message)["type"] == kind:
            yield json.loads(message)


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"port": 99999}, "expected a port from 0 to 65535, got 99999"),
        ({"port": -1}, "expected a port from 0 to 65535, got -1"),
        ({"budget_ms": -1.0}, "expected a budget_ms above 0, or None for no limit, got -1.0"),
    ],
)
def test_a_port_or_a_budget_out_of_range_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        serve(BallCapture(CAMERAS, 1), SmoothFill(), **wrong)


def test_pages_show_what_the_program_wants():
    with serve(BallCapture(CAMERAS, 3), SmoothFill(), token=TOKEN, config=PIPELINE) as viewer:
        address, _, query = viewer.address.partition("/?")
        assert query == "token=" + TOKEN.replace(" ", "%20").replace(",", "%2C")
        assert get(address + "/health")[0] == 401 and get(f"{address}/health?{query}")[0] in (200, 503)
        viewer.show(azimuth=30.0, mode="rendered")
        with connect(f"{address.replace('http', 'ws')}/ws?{query}", max_size=None) as socket:
            assert say_hello(socket)["model"] == "SmoothFill"
            shown = messages(socket, "show")
            assert next(shown) == {"type": "show", "pose": {"azimuth": 30.0}, "mode": "rendered"}, (
                "it was shown before"
            )
            viewer.show(camera=CAMERAS[2], time=1)
            later = next(shown)
            assert later["time"] == 1 and len(later["pose"]["R"]) == 9 and len(later["pose"]["T"]) == 3
        for wrong in (
            {"mode": "nice"},
            {"mode": "compared"},
            {"elevation": 100.0},
            {"azimuth": 1.0, "camera": CAMERAS},
            {"time": -1},
        ):
            with pytest.raises(ValueError, match="expected"):
                viewer.show(**wrong)
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(address, timeout=5)


@in_own_loop
async def test_what_is_shown_while_the_first_page_opens_reaches_it():
    """The program sets it on its own thread, perhaps just after the page was sent what was due."""
    source = Mock(span=Span(), status=SourceStatus())
    service = Mock(
        spec=RenderService,
        source=source,
        renderer=Mock(rig_json=None),
        error=None,
        now=lambda: 0.0,
        ahead=Mock(num_made=0),
    )
    registry, page, shown = SessionRegistry(service, Limits(), None, {}), Mock(spec=ViewerConnection), []
    page.send_due.side_effect = lambda shared: shown.append(shared.show) or math.inf
    registry.join(page)
    registry.shown = {"type": "show", "time": 1}
    end = time.monotonic() + WAIT_S
    while len(shown) < 2 and time.monotonic() < end:
        await asyncio.sleep(0.01)
    registry.connections.clear()
    assert shown == [None, {"type": "show", "time": 1}]


def test_the_command_opens_a_browser(monkeypatch, tmp_path, capsys):
    seen = {}
    monkeypatch.setattr(view.webbrowser, "open", lambda address: seen.update(address=address) is None)
    monkeypatch.setattr(Viewer, "wait", lambda self: seen.update(page=get(self.address)[2]))
    write_capture(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), tmp_path / "capture")
    assert main(["view", str(tmp_path / "capture"), "--model", "telea"]) == 0
    assert b"viewmend live" in seen["page"] and seen["address"] in capsys.readouterr().err
    assert main(["view", str(tmp_path / "none")]) == 2
