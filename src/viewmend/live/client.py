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
AGAIN_S = 0.1
"""Seconds between two tries to connect anew."""


class ConnectionLostError(ConnectionError):
    """The connection has ended and nobody said why; another may be had."""


class ServerSocket:
    """A connection to the server's path `ws` or `push`."""

    def __init__(self, url: str, token: str | None) -> None:
        try:  # an extra: without it, the names of this module are there all the same
            from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
            from websockets.sync.client import connect
        except ImportError:
            raise ImportError("a connection needs websockets: pip install 'viewmend[live]'") from None
        self._closed = ConnectionClosed
        self._open = contextlib.ExitStack()
        address = f"{url}{token_query(token)}"
        try:
            self._socket = self._open.enter_context(connect(address, max_size=None, compression=None))
        except InvalidStatus as refused:
            said, status = bytes(refused.response.body or b"").decode(errors="replace"), refused.response.status_code
            kind = ConnectionLostError if status >= 500 else ConnectionError
            raise kind(f"the server refuses ({status}): {said[:400]}") from None
        except (OSError, InvalidHandshake, ConnectionClosed) as error:
            raise ConnectionLostError(f"{url}: expected a server, got none ({error}); is it running?") from None

    def send(self, message: str | bytes) -> None:
        """Send a message. If the connection is closed already, `receive` says why."""
        with contextlib.suppress(self._closed):
            self._socket.send(message)

    def receive(self, timeout_s: float) -> dict[str, Any] | bytes:
        """The next message: JSON, or a binary one.

        Raises:
            ConnectionError: the server refuses, and says why.
            ConnectionLostError: the connection is closed.
            TimeoutError: none came in time.
        """
        try:
            message = self._socket.recv(timeout=max(0.0, timeout_s))
        except self._closed as closed:
            raise ConnectionLostError(f"the server has closed the connection: {closed}") from None
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
    again_s: float = 0.0
    """For so long a connection that is lost is tried to be had again; then what was looked at is asked for anew, at the
    time that was shown last. 0: it is an error."""
    messages: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The last message of each type."""
    connections: int = field(default=0, init=False)
    """How often it was connected."""

    def __enter__(self) -> "Client":
        self._looks, self._shown = 0, -1
        self._look: dict[str, Any] = {}
        self._on_air = False
        self._clock: dict[str, Any] = {}
        """What parts the clock from the edge; with a seek until that is shown."""
        self._connect()
        return self

    def _connect(self) -> None:
        """Connect, and say hello."""
        self._socket = ServerSocket(f"{self.url}/ws", self.token)
        self.connections += 1
        self._at_most_per_s, self._may_send, self._since_s = math.inf, 1.0, time.monotonic()
        self.send("hello", version=VERSION, codecs=["jpeg"])
        self.messages.pop("welcome", None)
        end = time.monotonic() + self.timeout_s
        while "welcome" not in self.messages:
            self._take(end)
        self._at_most_per_s = PACE * self.messages["welcome"]["limits"]["messages_per_s"]

    def _connect_again(self) -> None:
        """A new connection, where the look and the clock are as they were."""
        end = time.monotonic() + self.again_s
        self._socket.close()
        while True:
            try:
                self._connect()
                break
            except ConnectionLostError:
                if time.monotonic() > end:
                    raise
                time.sleep(AGAIN_S)
        if self._clock:
            self.send("clock", **({"seek": self._shown} if self._shown >= 0 else {}) | self._clock)
        if self._look:
            self.send("look", **self._look)
        if self._on_air:
            self.send("on_air", on=True)

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
        if kind == "look":
            self._look = values
        elif kind == "clock":
            self._clock = {} if values.get("live") else self._clock | values
        self._socket.send(json.dumps({"type": kind, **values}))

    def look(self, **values: object) -> int:
        """Ask for views from now on, e.g. camera={"azimuth": 30}, width=320, height=320; the look's id."""
        self._looks += 1
        self.send("look", id=self._looks, sent_ms=1000 * time.perf_counter(), **values)
        return self._looks

    def on_air(self, on: bool = True) -> None:
        """Let what this viewer looks at be what all who watch see, or no more; of a server with --broadcast."""
        self._on_air = on
        self.send("on_air", on=on)

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
        try:
            return self._take(end)
        except ConnectionLostError:
            if self.again_s <= 0:
                raise
        self._connect_again()
        return None

    def _take(self, end: float) -> Frame | None:
        message = self._socket.receive(end - time.monotonic())
        if isinstance(message, dict):
            self.messages[message["type"]] = message
            return None
        header, parts = unpack(message)
        self.send("ack", frame=header["frame"])
        self._shown = header["time"]
        if self._clock.get("playing", True) or self._clock.get("seek") == self._shown:
            self._clock.pop("seek", None)
        frame = Frame(header, {}, {}, 1000 * time.perf_counter() - header["sent_ms"], len(message))
        for part, data in zip(header["parts"], parts, strict=True):
            if part["kind"] == "image":
                frame.images[part["eye"], part["mode"]] = from_jpeg(data)
            else:
                sizes = (part[key] for key in ("width", "height", "stride", "near_m", "far_m"))
                frame.depth[part["eye"]] = unpack_depth(PackedDepth(data, *sizes))
        return frame
