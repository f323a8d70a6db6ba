"""A viewer in Python: ask for views over the network, get images and depth as arrays (needs `viewmend[live]`)."""

import contextlib
import json
import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from viewmend.live.pictures import PackedDepth, from_jpeg, unpack_depth
from viewmend.live.protocol import VERSION, token_query, unpack

PACE = 0.9
"""Part of the messages a second that the server takes."""


class ServerSocket:
    """A connection to the server's path `ws` or `push`."""

    def __init__(self, url: str, token: str | None) -> None:
        try:  # an extra: without it, the names of this module are there all the same
            from websockets.exceptions import ConnectionClosed, InvalidStatus
            from websockets.sync.client import connect
        except ImportError:
            raise ImportError("a connection needs websockets: pip install 'viewmend[live]'") from None
        self._closed = ConnectionClosed
        self._open = contextlib.ExitStack()
        address = f"{url}{token_query(token)}"
        try:
            self._socket = self._open.enter_context(connect(address, max_size=None, compression=None))
        except InvalidStatus as refused:
            said = bytes(refused.response.body or b"").decode(errors="replace")
            raise ConnectionError(f"the server refuses ({refused.response.status_code}): {said[:400]}") from None

    def send(self, message: str | bytes) -> None:
        """Send a message. If the connection is closed already, `receive` says why."""
        with contextlib.suppress(self._closed):
            self._socket.send(message)

    def receive(self, timeout_s: float) -> dict[str, Any] | bytes:
        """The next message: JSON, or a binary one.

        Raises:
            ConnectionError: the server refuses, or the connection is closed; says why.
            TimeoutError: none came in time.
        """
        try:
            message = self._socket.recv(timeout=max(0.0, timeout_s))
        except self._closed as closed:
            raise ConnectionError(f"the server has closed the connection: {closed}") from None
        if isinstance(message, bytes):
            return message
        content = json.loads(message)
        if content["type"] == "error" and content["fatal"]:
            raise ConnectionError(content["message"])
        return content

    def close(self) -> None:
        """Close the connection."""
        self._open.close()


@dataclass(frozen=True)
class Frame:
    """One frame: its header (docs/live-protocol.md), RGB by eye and mode, depth in metres by eye, latency, bytes."""

    header: dict[str, Any]
    images: dict[tuple[int, str], UInt8[np.ndarray, "height width 3"]]
    depth: dict[int, Float[np.ndarray, "h w"]]
    latency_ms: float
    size: int


@dataclass
class Client:
    """A viewer's connection; a context manager. ConnectionError says why a server refuses, or ends it.

    Examples:
        >>> from viewmend import Client
        >>> with Client("ws://127.0.0.1:8008") as viewer:  # doctest: +SKIP
        ...     print(viewer.messages["welcome"])
    """

    url: str = "ws://127.0.0.1:8008"
    token: str | None = None
    timeout_s: float = 30.0
    messages: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The last message of each type."""

    def __enter__(self) -> "Client":
        self._socket = ServerSocket(f"{self.url}/ws", self.token)
        self._looks, self._at_most_per_s = 0, math.inf
        self._may_send, self._since_s = 1.0, time.monotonic()
        self.send("hello", version=VERSION, codecs=["jpeg"])
        self._at_most_per_s = PACE * self.wait_for("welcome")["limits"]["messages_per_s"]
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()

    def send(self, kind: str, **values: object) -> None:
        """Send a message of the protocol, as soon as the server takes one more: it drops what comes too quickly."""
        if self._at_most_per_s < math.inf:
            now, most = time.monotonic(), self._at_most_per_s
            self._may_send = min(most, self._may_send + (now - self._since_s) * most) - 1
            self._since_s = now
            if self._may_send < 0:
                time.sleep(-self._may_send / most)
        self._socket.send(json.dumps({"type": kind, **values}))

    def look(self, **values: object) -> int:
        """Ask for views from now on, e.g. camera={"azimuth": 30}, width=320, height=320; the look's id."""
        self._looks += 1
        self.send("look", id=self._looks, sent_ms=1000 * time.perf_counter(), **values)
        return self._looks

    def wait_for(self, kind: str) -> dict[str, Any]:
        """The next message of this type; frames on the way are acknowledged and dropped."""
        self.messages.pop(kind, None)
        end = time.monotonic() + self.timeout_s
        while kind not in self.messages:
            self._receive(end)
        return self.messages[kind]

    def frame(self, look: int | None = None, full: bool = False) -> Frame:
        """The next frame; with `look` the next that answers it, with `full` the next that nothing better follows."""
        end = time.monotonic() + self.timeout_s
        while True:
            frame = self._receive(end)
            if frame and look in (None, frame.header["look"]) and (frame.header["full"] or not full):
                return frame

    def _receive(self, end: float) -> Frame | None:
        message = self._socket.receive(end - time.monotonic())
        if isinstance(message, dict):
            self.messages[message["type"]] = message
            return None
        header, parts = unpack(message)
        self.send("ack", frame=header["frame"])
        frame = Frame(header, {}, {}, 1000 * time.perf_counter() - header["sent_ms"], len(message))
        for part, data in zip(header["parts"], parts, strict=True):
            if part["kind"] == "image":
                frame.images[part["eye"], part["mode"]] = from_jpeg(data)
            else:
                sizes = (part[key] for key in ("width", "height", "stride", "near_m", "far_m"))
                frame.depth[part["eye"]] = unpack_depth(PackedDepth(data, *sizes))
        return frame
