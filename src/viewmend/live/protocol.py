"""What client and server say to each other, typed and versioned: docs/live-protocol.md in code."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from viewmend.live.fields import Fields, ProtocolError, read_json

VERSION = 1
MODES = ("rendered", "holes", "mended", "depth", "coverage")
CODECS = ("jpeg", "vp9", "h264")
MAGIC = b"VMF1"
_LARGEST = 2**53
"""The largest whole number that JavaScript counts exactly."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What a client may ask for."""

    max_side_px: int = 2048
    max_pixels: int = 2_100_000
    max_message_bytes: int = 16_384
    messages_per_s: int = 120
    viewers: int = 8


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A viewer's camera as it was asked for: a matrix or an orbit, and a lens."""

    R: tuple[float, ...] | None = None
    T: tuple[float, ...] | None = None
    azimuth: float = 0.0
    elevation: float = 0.0
    distance: float | None = None
    target: tuple[float, ...] | None = None
    fov_y: float | None = None
    lens: tuple[float, float, float | None, float | None] | None = None
    """fx, fy, cx, cy in pixels of the size that was asked for; None for the middle."""


@dataclass(frozen=True, kw_only=True)
class Look:
    """What to show from now on."""

    id: int = 0
    sent_ms: float = 0.0
    eyes: tuple[Camera, ...] = (Camera(),)
    width: int = 320
    height: int = 320
    modes: tuple[str, ...] = ("mended",)
    top_k: int | None = None
    scale: float = 1.0
    moving: bool = False
    adaptive: bool = True
    depth: bool = False
    codec: str = "jpeg"
    key: bool = False
    """Begin video streams anew: the decoder has lost them."""
    quality: int = 85


@dataclass(frozen=True)
class Hello:
    """A client's first words."""

    version: int
    codecs: tuple[str, ...]


@dataclass(frozen=True)
class Ack:
    """A frame has arrived."""

    frame: int


@dataclass(frozen=True)
class ClockChange:
    """What to do with a viewer's clock; None leaves it."""

    playing: bool | None = None
    speed: float | None = None
    seek: int | None = None
    live: bool = False


@dataclass(frozen=True)
class Ping:
    """Answered by a pong."""

    sent_ms: float


Message = Hello | Look | Ack | ClockChange | Ping


def parse(text: str, limits: Limits) -> Message:
    """A client's message.

    Raises:
        ProtocolError: it is none, or asks for more than the limits.
    """
    if len(text) > limits.max_message_bytes:
        raise ProtocolError(f"expected at most {limits.max_message_bytes} bytes, got {len(text)}; send less")
    given = Fields(read_json(text))
    kind = given.choice("type", ("hello", "look", "ack", "clock", "ping"))
    if kind == "look":
        return parse_look(given, limits)
    if kind == "ack":
        return Ack(given.whole("frame", 0, _LARGEST))
    if kind == "hello":
        codecs = given.texts("codecs", ("jpeg",), most=8, least=0)
        return Hello(given.whole("version", 0, _LARGEST), tuple(c for c in CODECS if c in codecs))
    if kind == "ping":
        return Ping(given.number("sent_ms", -1e15, 1e15, 0.0))
    seek = given.whole("seek", -_LARGEST, _LARGEST) if given.has("seek") else None
    playing = given.flag("playing", False) if given.has("playing") else None
    speed = given.number("speed", 0.05, 4.0) if given.has("speed") else None
    return ClockChange(playing, speed, seek, given.flag("live", False))


def parse_look(given: Fields, limits: Limits) -> Look:
    """A look, from a message or a query."""
    width, height = (given.whole(side, 16, limits.max_side_px, 320) for side in ("width", "height"))
    eyes = tuple(parse_camera(Fields(eye)) for eye in given.items("eyes", 2)) if given.has("eyes") else ()
    modes = given.texts("modes", ("mended",), most=2)
    if width * height * max(1, len(eyes)) > limits.max_pixels:
        raise ProtocolError(f"expected at most {limits.max_pixels} pixels, got {width} x {height}; ask for fewer")
    if not modes or any(mode not in MODES for mode in modes):
        raise ProtocolError(f"expected one or two modes among {MODES}, got {str(modes)[:60]}")
    return Look(
        id=given.whole("id", -_LARGEST, _LARGEST, 0),
        sent_ms=given.number("sent_ms", -1e15, 1e15, 0.0),
        eyes=eyes or (parse_camera(Fields(given.get("camera", {}))),),
        width=width,
        height=height,
        modes=modes,
        top_k=given.whole("top_k", 1, 1_000_000) if given.has("top_k") else None,
        scale=given.number("scale", 0.1, 1.0, 1.0),
        moving=given.flag("moving", False),
        adaptive=given.flag("adaptive", True),
        depth=given.flag("depth", False),
        codec=given.choice("codec", CODECS, "jpeg"),
        key=given.flag("key", False),
        quality=given.whole("quality", 30, 95, 85),
    )


def parse_camera(given: Fields) -> Camera:
    """A pose and a lens."""
    pose: dict[str, Any] = {}
    if given.has("R") or given.has("T"):
        pose = {"R": given.numbers("R", 9, 1.001), "T": given.numbers("T", 3, 1e4)}
        if not _is_rotation(pose["R"]):
            raise ProtocolError("expected 'R' to be a rotation, world to camera, row by row; got another matrix")
    else:
        pose = {
            "azimuth": given.number("azimuth", -1e6, 1e6, 0.0),
            "elevation": given.number("elevation", -89.9, 89.9, 0.0),
            "distance": given.number("distance", 0.02, 1e3) if given.has("distance") else None,
            "target": given.numbers("target", 3, 1e4) if given.has("target") else None,
        }
    lens = None
    if given.has("fx"):
        fx = given.number("fx", 1.0, 1e6)
        cx, cy = (given.number(key, -1e5, 1e5) if given.has(key) else None for key in ("cx", "cy"))
        lens = (fx, given.number("fy", 1.0, 1e6, fx), cx, cy)
    return Camera(**pose, lens=lens, fov_y=given.number("fov_y", 2.0, 150.0) if given.has("fov_y") else None)


def _is_rotation(R: Sequence[float]) -> bool:
    rows = [R[0:3], R[3:6], R[6:9]]
    dots = [sum(a * b for a, b in zip(rows[i], rows[j], strict=True)) - (i == j) for i in range(3) for j in range(3)]
    (a, b, c), (d, e, f), (g, h, i) = rows
    determinant = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return max(map(abs, dots)) < 1e-3 and determinant > 0


def pack(header: dict[str, Any], parts: Sequence[bytes]) -> bytes:
    """A binary message; `header["parts"]` or `header["images"]` say what the parts are, `bytes` how long each is."""
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    return b"".join([MAGIC, struct.pack("<I", len(text)), text, *parts])


def unpack(message: bytes, listed: Literal["parts", "images"] = "parts") -> tuple[dict[str, Any], list[bytes]]:
    """Inverse of `pack`.

    Raises:
        ProtocolError: lengths that do not add up, or no header.
    """
    if len(message) < 8 or message[:4] != MAGIC:
        raise ProtocolError(f"expected a message that begins with {MAGIC.decode()}, got {message[:4]!r}")
    start = 8 + struct.unpack("<I", message[4:8])[0]
    header = Fields(read_json(message[8:start])) if start <= len(message) else None
    if header is None:
        raise ProtocolError("expected a whole header, got a message that ends in it")
    sizes = [Fields(part).whole("bytes", 0, len(message)) for part in header.items(listed, 512)]
    if start + sum(sizes) != len(message):
        raise ProtocolError(f"expected {start + sum(sizes)} bytes by the header, got {len(message)}")
    ends = [start + sum(sizes[: n + 1]) for n in range(len(sizes))]
    return header.values, [message[end - size : end] for size, end in zip(sizes, ends, strict=True)]
