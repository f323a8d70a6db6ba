"""The messages between server and clients as types; docs/live-protocol.md describes them."""

import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import quote

import torch
from msgspec import Meta, Struct
from msgspec.structs import force_setattr

from viewmend.geometry.rigid import is_rotation
from viewmend.models.checkpoint import shipped_models
from viewmend.rendering.error_mask import ERROR_RULES
from viewmend.utils.timing import StageTimes
from viewmend.utils.untrusted_input import LARGEST_INTEGER, InputError, one_of, read_json, typed

VERSION = 1
MODES = ("rendered", "holes", "completed", "compared", "depth", "coverage", "confidence", "hull", "points")
COMPLETED_MODES = frozenset({"completed", "confidence"})
"""Modes that need the model's output."""
EXTRA_MODES = frozenset({"compared", "error", "hull", "points"})
"""Modes that show something else than the server's own model: another one, its errors, or the
geometry proxy alone."""
CODECS = ("jpeg", "vp9", "h264")
MAGIC = b"VMF1"
MAX_PARTS = 512
HEADER_BYTES = 1_000_000
"""Largest JSON text of a rig, or header of a binary message."""
MAX_NESTED = 10_000
"""Lists and objects in one JSON text: parsing a megabyte of empty ones would block the server for seconds."""

Kind = TypeVar("Kind")
Integer = Annotated[int, Meta(ge=-LARGEST_INTEGER, le=LARGEST_INTEGER)]
Count = Annotated[int, Meta(ge=0, le=LARGEST_INTEGER)]
ClientMs = Annotated[float, Meta(ge=-1e15, le=1e15)]
Metres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Point = tuple[Metres, Metres, Metres]
Rotation = Annotated[
    tuple[Annotated[float, Meta(ge=-1.001, le=1.001)], ...], Meta(min_length=9, max_length=9)
]
"""camera_from_world, row by row."""
Degrees = Annotated[float, Meta(ge=-1e6, le=1e6)]
Elevation = Annotated[float, Meta(ge=-89.9, le=89.9)]
Distance = Annotated[float, Meta(ge=0.02, le=1e3)]
FieldOfView = Annotated[float, Meta(ge=2, le=150)]
FocalLength = Annotated[float, Meta(ge=1, le=1e6)]
PrincipalPoint = Annotated[float, Meta(ge=-1e5, le=1e5)]
Side = Annotated[int, Meta(ge=16)]
Mode = Annotated[str, one_of(*MODES)]
Rule = Annotated[str, one_of(*ERROR_RULES)]
Model = Annotated[str, one_of(*shipped_models())]
TopK = Annotated[int, Meta(ge=1, le=1_000_000)]
Quality = Annotated[int, Meta(ge=30, le=95)]
Colour = Annotated[str, Meta(pattern="^[0-9a-f]{6}\\Z")]
"""Red, green and blue in hexadecimal."""
BLACK = "000000"
WHITE = "ffffff"
ShortText = Annotated[str, Meta(max_length=40)]
CameraName = Annotated[str, Meta(max_length=4000)]
Names = Annotated[tuple[CameraName, ...], Meta(max_length=128)]
NameList = Annotated[str, Meta(max_length=16_384)]
"""Names of cameras, separated by commas."""


class CloseCode(IntEnum):
    """Codes of the message `error`, and of a WebSocket that the server closes because of the error."""

    MALFORMED = 4400
    TIMEOUT = 4408
    VERSION_MISMATCH = 4426
    TOO_MANY_MESSAGES = 4429
    TOO_MANY_VIEWERS = 4503


class ProtocolError(InputError):
    """A malformed message. Its text states what was expected, what was found, and what to do next."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits for clients, as the message `welcome` reports them."""

    max_side_px: int = 2048
    max_pixels: int = 2_100_000
    max_message_bytes: int = 16_384
    messages_per_s: int = 120
    viewers: int = 8

    def check_size(self, width: int, height: int, views: int = 1) -> None:
        """Raise a ProtocolError if a side, or all views together, have too many pixels."""
        size = f"{width} x {height}"
        if max(width, height) > self.max_side_px:
            raise ProtocolError(
                f"expected sides from 16 to {self.max_side_px} pixels, got {size}; request less"
            )
        if width * height * views > self.max_pixels:
            size = size if views == 1 else f"{views} times {size}"
            raise ProtocolError(
                f"expected at most {self.max_pixels} pixels, got {size}; request smaller images"
            )


class Camera(Struct, frozen=True, kw_only=True):
    """A requested camera: a pose (a matrix or a position on an orbit) and a lens."""

    R: Rotation | None = None
    T: Point | None = None
    azimuth: Degrees = 0.0
    elevation: Elevation = 0.0
    distance: Distance | None = None
    target: Point | None = None
    fov_y: FieldOfView | None = None
    fx: FocalLength | None = None
    """fx, fy, cx and cy are in pixels of the requested size; defaults: fy = fx, and cx, cy at the centre."""
    fy: FocalLength | None = None
    cx: PrincipalPoint | None = None
    cy: PrincipalPoint | None = None

    def __post_init__(self) -> None:
        if (self.R is None) != (self.T is None):
            raise ProtocolError("expected 'R' and 'T', got one of them; give both, or an orbit")
        if self.R is not None:
            check_rotation(self.R)


class Look(Struct, frozen=True, kw_only=True, tag="look"):
    """The view to show from now on."""

    id: Integer = 0
    sent_ms: ClientMs = 0.0
    camera: Camera = Camera()
    eyes: Annotated[tuple[Camera, ...], Meta(min_length=1, max_length=2)] | None = None
    """Left and right eye, instead of `camera`."""
    width: Side = 320
    height: Side = 320
    modes: Annotated[tuple[Mode, ...], Meta(min_length=1, max_length=2)] = ("completed",)
    top_k: TopK | None = None
    error_rule: Rule | None = None
    """Which pixels are inpainted; None for the server's default."""
    scale: Annotated[float, Meta(ge=0.1, le=1)] = 1.0
    moving: bool = False
    full: bool = False
    """Whether to send only the view at full quality, because the client draws a draft by itself."""
    adaptive: bool = True
    depth: bool = False
    codec: Annotated[str, one_of(*CODECS)] = "jpeg"
    key: bool = False
    """Whether video streams start again with a key frame, because the client cannot decode them any more."""
    quality: Quality = 85
    background: Colour | None = None
    """Background colour; None for the model's own."""
    without: Names = ()
    """Cameras that are not used as inputs, neither their images nor their masks."""
    model: Model | None = None
    """The shipped model whose output is the mode "compared"."""

    def __post_init__(self) -> None:
        if "compared" in self.modes and self.model is None:
            raise ProtocolError(
                "expected 'model' for the mode 'compared', got none; `welcome` lists the models"
            )
        force_setattr(self, "modes", tuple(dict.fromkeys(self.modes)))

    @property
    def pixels(self) -> float:
        """Pixels of all eyes together."""
        return len(self.cameras) * self.width * self.height * self.scale**2

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """One camera per eye."""
        return self.eyes or (self.camera,)


class Hello(Struct, frozen=True, tag="hello"):
    """A client's first message."""

    version: Count
    codecs: Annotated[tuple[ShortText, ...], Meta(max_length=8)] = ("jpeg",)


class Cancel(Struct, frozen=True, tag="cancel"):
    """The last look is not needed any more; nothing is rendered until the next one."""


class Ack(Struct, frozen=True, tag="ack"):
    """A frame has arrived."""

    frame: Count


class ClockChange(Struct, frozen=True, tag="clock"):
    """A change of the viewer's clock; None leaves a value as it is."""

    playing: bool | None = None
    speed: Annotated[float, Meta(ge=0.05, le=4)] | None = None
    seek: Integer | None = None
    live: bool = False


class OnAir(Struct, frozen=True, tag="on_air"):
    """Whether this viewer controls the broadcast view."""

    on: bool


class Ping(Struct, frozen=True, tag="ping"):
    """A message that is answered by `pong`."""

    sent_ms: ClientMs = 0.0


Message = Hello | Look | Cancel | Ack | ClockChange | OnAir | Ping


class ShowView(Struct, frozen=True):
    """The server's message `show`, which moves the page."""

    pose: Camera | None = None
    time: Count | None = None
    mode: Annotated[str, one_of(*(mode for mode in MODES if mode != "compared"))] | None = None


def parse(text: str, limits: Limits) -> Message:
    """Parse a client's message; ProtocolError if it is malformed or exceeds the limits."""
    size = len(text.encode())
    if size > limits.max_message_bytes:
        raise ProtocolError(f"expected at most {limits.max_message_bytes} bytes, got {size}; send less")
    message: Message = read_message(text, Message)
    if isinstance(message, Look):
        limits.check_size(message.width, message.height, len(message.cameras))
    return message


def read_message(message: object, kind: type[Kind] | Any, strict: bool = True) -> Kind:
    """Convert JSON text, or parsed JSON, to `kind`, as `untrusted_input.typed`; ProtocolError if it does not match."""
    if isinstance(message, str | bytes):
        opening = ("[", "{") if isinstance(message, str) else (b"[", b"{")
        nested = sum(map(message.count, opening))
        if nested > MAX_NESTED:
            raise ProtocolError(
                f"expected at most {MAX_NESTED} lists and objects in a message, got {nested}; send fewer"
            )
    try:
        value = read_json(message) if isinstance(message, str | bytes) else message
        return typed(value, kind, "see docs/live-protocol.md", strict)
    except ValueError as error:
        raise ProtocolError(str(error)[:300]) from None


@dataclass(frozen=True, kw_only=True)
class FrameTimes(StageTimes):
    """Milliseconds per stage of a frame that is sent, including the server's own stages."""

    encode: float = 0.0
    """Encoding as JPEG or video."""
    wait: float = 0.0
    """Time from the arrival of a look to the start of its first frame."""

    @property
    def shares_geometry(self) -> bool:
        """Whether the frame's geometry was computed before, for another view."""
        return self.geometry == 0

    def as_json(self, frames: int = 1) -> dict[str, float]:
        """The protocol's `stage_ms`; means if this is the sum of several frames."""
        return {name: round(ms / frames, 2) for name, ms in (vars(self) | {"total": self.total}).items()}


def error_json(code: int | str, message: str, fatal: bool) -> dict[str, Any]:
    """The message `error`; `fatal` if the socket is closed next."""
    return {"type": "error", "code": code, "message": message, "fatal": fatal}


def check_rotation(R: Sequence[float]) -> None:
    """Raise a ProtocolError if nine numbers, row by row, are not a rotation matrix."""
    if not bool(is_rotation(torch.tensor(R, dtype=torch.float64).view(3, 3))):
        raise ProtocolError(
            "expected 'R' as a rotation, world to camera, row by row, got another matrix; check signs"
        )


def pack(header: dict[str, Any], parts: Sequence[bytes]) -> bytes:
    """Build a binary message; `header["parts"]` or `header["images"]` list the parts with their length `bytes`."""
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    return b"".join([MAGIC, struct.pack("<I", len(text)), text, *parts])


class _Part(Struct, frozen=True):
    bytes: Count


def unpack(
    message: bytes, listed: Literal["parts", "images"] = "parts"
) -> tuple[dict[str, Any], list[bytes]]:
    """Split a binary message into header and parts; ProtocolError if its header is malformed or its length wrong."""
    if len(message) < 8 or message[:4] != MAGIC:
        raise ProtocolError(
            f"expected a message that begins with {MAGIC.decode()}, got {message[:4]!r}; see docs/live-protocol.md"
        )
    start = 8 + struct.unpack("<I", message[4:8])[0]
    if start > min(len(message), 8 + HEADER_BYTES):
        raise ProtocolError(
            f"expected a whole header of at most {HEADER_BYTES} bytes, got one of {start - 8}; shorten it"
        )
    header: dict[str, Any] = read_message(message[8:start], dict[str, Any])
    parts: list[_Part] = read_message(header.get(listed), Annotated[list[_Part], Meta(max_length=MAX_PARTS)])
    sizes = [part.bytes for part in parts]
    if start + sum(sizes) != len(message):
        raise ProtocolError(
            f"expected {start + sum(sizes)} bytes, as the header says, got {len(message)}; correct its 'bytes'"
        )
    ends = [start + sum(sizes[: n + 1]) for n in range(len(sizes))]
    return header, [message[end - size : end] for size, end in zip(sizes, ends, strict=True)]


def token_query(token: str | None) -> str:
    """The query string that carries the token; empty without a token."""
    return f"?token={quote(token, safe='')}" if token else ""
