"""Python clients of the live server: `Client` requests views as arrays, `Publisher` pushes a rig's frames."""

import contextlib
import json
import math
import time
from dataclasses import dataclass, field
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.live.encoding import PackedDepth, from_jpeg, unpack_depth
from viewmend.live.poses import bounds_json, cameras_json
from viewmend.live.protocol import VERSION, pack, token_query, unpack
from viewmend.types import MultiViewFrame

RATE = 0.9
"""Fraction of the server's limit on messages per second that a client uses."""
RETRY_S = 0.1
"""Seconds between attempts to reconnect."""
ANSWER_S = 30.0
"""Time limit for the answer to a pushed frame."""
Self = TypeVar("Self", bound="Connection")


class ConnectionLostError(ConnectionError):
    """The connection broke, or could not be made for now; a new one may succeed."""


class ServerSocket:
    """A connection to the server's path `ws` or `push`."""

    def __init__(self, url: str, token: str | None) -> None:
        self._context = contextlib.ExitStack()
        address = f"{url}{token_query(token)}"
        try:
            self._socket = self._context.enter_context(connect(address, max_size=None, compression=None))
        except InvalidStatus as refused:
            reason = bytes(refused.response.body or b"").decode(errors="replace")
            status = refused.response.status_code
            kind = ConnectionLostError if status >= 500 else ConnectionError
            raise kind(f"the server refuses ({status}): {reason[:400]}") from None
        except (OSError, InvalidHandshake, ConnectionClosed) as error:
            raise ConnectionLostError(
                f"{url}: expected a server, got none ({error}); is it running?"
            ) from None

    def send(self, message: str | bytes) -> None:
        """Send a message. If the connection is closed already, `receive` raises the reason."""
        with contextlib.suppress(ConnectionClosed):
            self._socket.send(message)

    def receive(self, timeout_s: float) -> dict[str, Any] | bytes:
        """The next message, parsed JSON or binary; TimeoutError if none comes in time.

        ConnectionError has the server's reason for closing the connection; ConnectionLostError has none.
        """
        try:
            message = self._socket.recv(timeout=max(0.0, timeout_s))
        except ConnectionClosed as closed:
            raise ConnectionLostError(f"the server has closed the connection: {closed}") from None
        if isinstance(message, bytes):
            return message
        content = json.loads(message)
        if content["type"] == "error" and content["fatal"]:
            raise ConnectionError(content["message"])
        return content

    def close(self) -> None:
        """Close the connection."""
        self._context.close()


class Connection:
    """A context manager that closes its socket."""

    _socket: ServerSocket

    def __enter__(self: Self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


@dataclass(frozen=True)
class Frame:
    """One received frame."""

    header: dict[str, Any]
    """The frame's header (docs/live-protocol.md)."""
    images: dict[tuple[int, str], UInt8[np.ndarray, "height width 3"]]
    """RGB images by eye and mode."""
    depth: dict[int, Float[np.ndarray, "h w"]]
    """Depth in metres by eye, 0 for background."""
    latency_ms: float
    size: int
    """Bytes of the message."""


@dataclass
class Client(Connection):
    """A viewer's connection; a context manager.

    Raises:
        ConnectionError: the server refuses or ends the connection; the text is its reason.

    Examples:
        >>> from viewmend import Client
        >>> with Client("ws://127.0.0.1:8008") as viewer:  # doctest: +SKIP
        ...     print(viewer.messages["welcome"])
    """

    url: str = "ws://127.0.0.1:8008"
    token: str | None = None
    timeout_s: float = 30.0
    reconnect_s: float = 0.0
    """How long to try to reconnect after the connection was lost; then the last view is requested
    again, at the frame that was shown last. 0: a lost connection is an error."""
    messages: dict[str, dict[str, Any]] = field(default_factory=dict)
    """The last message of each type."""
    connections: int = field(default=0, init=False)
    """Number of connections so far."""

    def __enter__(self) -> "Client":
        self._looks = 0
        self._shown = -1
        self._look: dict[str, Any] = {}
        self._on_air = False
        self._clock: dict[str, Any] = {}
        """Changes of the clock since it last followed the edge; contains a seek until its frame is shown."""
        self._connect()
        return self

    def _connect(self) -> None:
        self._socket = ServerSocket(f"{self.url}/ws", self.token)
        self.connections += 1
        self._max_per_s = math.inf
        self._credit = 1.0
        self._credited_at = time.monotonic()
        self.send("hello", version=VERSION, codecs=["jpeg"])
        self.messages.pop("welcome", None)
        end = time.monotonic() + self.timeout_s
        while "welcome" not in self.messages:
            self._take(end)
        self._max_per_s = RATE * self.messages["welcome"]["limits"]["messages_per_s"]

    def _reconnect(self) -> None:
        end = time.monotonic() + self.reconnect_s
        self._socket.close()
        while True:
            try:
                self._connect()
                break
            except ConnectionLostError:
                if time.monotonic() > end:
                    raise
                time.sleep(RETRY_S)
        if self._clock:
            self.send("clock", **({"seek": self._shown} if self._shown >= 0 else {}) | self._clock)
        if self._look:
            self.send("look", **self._look)
        if self._on_air:
            self.send("on_air", on=True)

    def send(self, kind: str, **values: object) -> None:
        """Send a message of the protocol; waits first if it would exceed the server's rate limit."""
        if self._max_per_s < math.inf:
            now = time.monotonic()
            rate = self._max_per_s
            self._credit = min(rate, self._credit + (now - self._credited_at) * rate) - 1
            self._credited_at = now
            if self._credit < 0:
                time.sleep(-self._credit / rate)
        if kind == "look":
            self._look = values
        elif kind == "clock":
            self._clock = {} if values.get("live") else self._clock | values
        self._socket.send(json.dumps({"type": kind, **values}))

    def look(self, **values: object) -> int:
        """Request views from now on, e.g. camera={"azimuth": 30}, width=320, height=320; returns the look's id."""
        self._looks += 1
        self.send("look", id=self._looks, sent_ms=1000 * time.perf_counter(), **values)
        return self._looks

    def on_air(self, on: bool = True) -> None:
        """Start or stop controlling the broadcast view of a server with --broadcast."""
        self._on_air = on
        self.send("on_air", on=on)

    def wait_for(self, kind: str) -> dict[str, Any]:
        """The next message of this type; frames that arrive meanwhile are acknowledged and dropped."""
        self.messages.pop(kind, None)
        end = time.monotonic() + self.timeout_s
        while kind not in self.messages:
            self._receive(end)
        return self.messages[kind]

    def frame(self, look: int | None = None, full: bool = False) -> Frame:
        """The next frame; with `look` the next one that answers it, with `full` the next one at full quality."""
        end = time.monotonic() + self.timeout_s
        while True:
            frame = self._receive(end)
            if frame and look in (None, frame.header["look"]) and (frame.header["full"] or not full):
                return frame

    def _receive(self, end: float) -> Frame | None:
        try:
            return self._take(end)
        except ConnectionLostError:
            if self.reconnect_s <= 0:
                raise
        self._reconnect()
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
                fields = {key: part[key] for key in ("width", "height", "stride", "near_m", "far_m")}
                frame.depth[part["eye"]] = unpack_depth(PackedDepth(data, **fields))
        return frame


class Publisher(Connection):
    """A rig's connection to `viewmend serve live`; a context manager. Frames are undistorted and have masks.

    Raises:
        ConnectionError: the server refuses the rig or a frame; the text is its reason.
        TimeoutError: the server does not answer.

    Examples:
        >>> from viewmend import Publisher
        >>> with Publisher(frame.cameras, "ws://127.0.0.1:8008", fps=15.0) as rig:  # doctest: +SKIP
        ...     rig.push(frame)
    """

    def __init__(
        self,
        cameras: Cameras,
        url: str = "ws://127.0.0.1:8008",
        token: str | None = None,
        fps: float = 15.0,
        name: str = "live rig",
        up: Tensor | None = None,
        bounds: Bounds | None = None,
    ) -> None:
        """Connect.

        Args:
            cameras: the rig, calibrated in metres.
            url: the server's address, without /push.
            token: the server's token.
            fps: frames per second.
            name: the rig's name on the page.
            up: up axis of the world, shape (3,); None to estimate it from the cameras.
            bounds: volume that contains the subject; None to estimate it from the masks.
        """
        self._socket = ServerSocket(f"{url}/push", token)
        self._rig = {
            "type": "rig",
            "version": VERSION,
            "name": name,
            "fps": fps,
            "up": None if up is None else up.tolist(),
            "bounds": None if bounds is None else bounds_json(bounds),
        }
        self.change(cameras)

    def change(self, cameras: Cameras) -> None:
        """Replace the cameras: some were added, removed or moved."""
        self._request(json.dumps(self._rig | {"cameras": cameras_json(cameras)}))

    def push(self, frame: MultiViewFrame, quality: int = 92) -> int:
        """Send a frame and wait until the server has it; returns its index.

        Raises:
            ValueError: the frame has no masks.
        """
        if frame.mask is None:
            raise ValueError("expected a frame with masks, got one without; create them with viewmend masks")
        images: list[dict[str, Any]] = []
        parts: list[bytes] = []
        for view, name in enumerate(frame.cameras.names):
            width, height = frame.cameras.size_px[view].tolist()
            rgb = frame.rgb[view, :, :height, :width].movedim(0, -1).cpu().numpy()
            jpeg = cv2.imencode(
                ".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
            )[1]
            mask = frame.mask[view, :height, :width].cpu().numpy()
            png = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
            for kind, data in (("rgb", jpeg.tobytes()), ("mask", png.tobytes())):
                images.append({"camera": name, "kind": kind, "bytes": len(data)})
                parts.append(data)
        return self._request(pack({"images": images}, parts))["frame"]

    def _request(self, message: str | bytes) -> dict[str, Any]:
        self._socket.send(message)
        answer = self._socket.receive(ANSWER_S)
        assert isinstance(answer, dict), "the server answers rigs in JSON"
        return answer
