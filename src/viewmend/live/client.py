"""A viewer in Python: ask for views over the network, get images and depth as arrays (needs `viewmend[live]`)."""

import contextlib
import json
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from websockets.sync.client import connect

from viewmend.live.pictures import PackedDepth, unpack_depth
from viewmend.live.protocol import VERSION, unpack


@dataclass(frozen=True)
class Frame:
    """One frame that was sent."""

    header: dict[str, Any]
    """As in docs/live-protocol.md."""
    images: dict[tuple[int, str], UInt8[np.ndarray, "height width 3"]]
    """RGB by eye and mode."""
    depth: dict[int, Float[np.ndarray, "h w"]]
    """By eye, metres, every `stride`-th pixel; 0 where there is no surface."""
    latency_ms: float
    """From the look that it answers (the last one sent with that id) to now."""
    size: int
    """Bytes."""


@dataclass
class Client:
    """A viewer's connection; a context manager.

    Raises:
        ConnectionError: the server refuses, or ends the connection; says why.
        TimeoutError: nothing came in time.
    """

    url: str = "ws://127.0.0.1:8008"
    token: str | None = None
    timeout_s: float = 30.0
    messages: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The last message of each type: welcome, rig, state, stats, error, pong."""

    def __enter__(self) -> "Client":
        query = f"?token={self.token}" if self.token else ""
        url = f"{self.url}/ws{query}"
        self._open = contextlib.ExitStack()
        self._socket = self._open.enter_context(
            connect(url, max_size=None, compression=None, open_timeout=self.timeout_s)
        )
        self._looks = 0
        self.send("hello", version=VERSION, codecs=["jpeg"])
        self.wait_for("welcome")
        return self

    def __exit__(self, *exception: object) -> None:
        self._open.close()

    def send(self, kind: str, **values: object) -> None:
        """Send a message of the protocol."""
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
        while kind not in self.messages and time.monotonic() < end:
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
        message = self._socket.recv(timeout=max(0.0, end - time.monotonic()))
        if isinstance(message, str):
            note = json.loads(message)
            self.messages[note["type"]] = note
            if note["type"] == "error" and note["fatal"]:
                raise ConnectionError(note["message"])
            return None
        header, parts = unpack(message)
        self.send("ack", frame=header["frame"])
        frame = Frame(header, {}, {}, 1000 * time.perf_counter() - header["sent_ms"], len(message))
        for part, data in zip(header["parts"], parts, strict=True):
            if part["kind"] == "depth":
                shape = (part["width"], part["height"], part["near_m"], part["far_m"])
                frame.depth[part["eye"]] = unpack_depth(PackedDepth(data, *shape))
            elif part["codec"] == "jpeg":
                import cv2

                image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
                frame.images[part["eye"], part["mode"]] = np.asarray(image)
        return frame
