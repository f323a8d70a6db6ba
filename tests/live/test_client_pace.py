"""The Python client keeps to what the server takes."""

import time

from live_servers import running

from viewmend.live.client import Client
from viewmend.live.protocol import Limits


def test_a_client_that_asks_as_fast_as_it_can_is_always_answered():
    """It sends two messages a frame, and the server drops those above its limit."""
    with running(limits=Limits(messages_per_s=40)) as server, Client(server.ws, timeout_s=5.0) as viewer:
        began = time.monotonic()
        for number in range(70):
            look = viewer.look(camera={"azimuth": 3.0 * number}, width=16, height=16, modes=["rendered"])
            assert viewer.frame(look).header["look"] == look
        assert time.monotonic() - began > (140 - 2 * 40) / 40
        assert "error" not in viewer.messages
