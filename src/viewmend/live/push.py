"""Live rigs: sources of frames that arrive as they happen, and the WebSocket by which a rig pushes them."""

import asyncio
import json
import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from msgspec import Meta, Struct
from starlette.websockets import WebSocket
from torch import Tensor

from viewmend.data.images import decode_image, size_from_header
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, is_intrinsics
from viewmend.geometry.rigid import rigid
from viewmend.live import protocol
from viewmend.live.connection import close_with_error
from viewmend.live.connection_limits import authenticate, is_gone
from viewmend.live.frame_source import FrameCache, FrameSource, RigInfo, SourceStatus, Span
from viewmend.live.protocol import (
    HEADER_BYTES,
    CloseCode,
    Point,
    ProtocolError,
    Rotation,
    check_rotation,
    read_message,
)
from viewmend.types import MultiViewFrame
from viewmend.utils.untrusted_input import one_of

MAX_CAMERAS = 128
MAX_PIXELS = 64_000_000
"""Cameras x widest x highest: the images of a frame share one tensor."""
IMAGE_BYTES = 65_536
"""Bytes of an encoded image in addition to four per pixel."""
MAX_FRAME_BYTES = 8 + HEADER_BYTES + 4 * MAX_PIXELS + MAX_CAMERAS * IMAGE_BYTES
"""Largest frame of any rig, in bytes; a rig's own limit is that of its images."""
SILENT_S = 30.0
"""A rig that sends nothing for this long is disconnected."""
ImageSide = Annotated[int, Meta(ge=8, le=16384)]


class LiveSource(FrameSource):
    """Frames as they happen, numbered in order of arrival; the oldest are dropped."""

    def __init__(self, fps: float | None = None, memory_mb: float = 500.0) -> None:
        super().__init__(Span(live=True, fps=fps or 15.0))
        self._fps = fps
        self._cache = FrameCache(memory_mb, by_last_use=False)
        self._lock = threading.Lock()

    def read(self, index: int) -> MultiViewFrame | None:
        """The frame, or None once it has been dropped."""
        with self._lock:
            return self._cache.get(index)

    def begin(
        self,
        name: str,
        fps: float,
        bounds: Bounds | None,
        up: Float[Tensor, "3"] | None,
        cameras: Cameras | None = None,
    ) -> None:
        """Start a rig; the frames of an earlier one can no longer be requested."""
        with self._lock:
            self.span = replace(self.span, first=self.span.end, fps=self._fps or fps)
            self.status = SourceStatus()
            self.rig = RigInfo(name, bounds, up, 1 if self.rig is None else self.rig.number + 1, cameras)
        self.changed()

    def add(self, frame: MultiViewFrame) -> int:
        """Append a frame; returns its index."""
        with self._lock:
            index = self.span.end
            self._cache.put(index, frame)
            self.span = replace(self.span, first=max(self.span.first, self._cache.oldest), end=index + 1)
            self.status = replace(self.status, state="ready", error=None)
        self.changed()
        return index


class PushSource(LiveSource):
    """The source of `viewmend serve live`: a rig pushes its frames."""

    def __init__(self, fps: float | None = None, memory_mb: float = 500.0) -> None:
        super().__init__(fps, memory_mb)
        self.status = SourceStatus(error="waiting for a rig to push frames")

    def disconnect(self) -> None:
        """Note that the rig has disconnected."""
        self.status = replace(self.status, state="failing", error="the rig has disconnected; waiting for it")
        self.changed()


async def receive_rig(socket: WebSocket, source: PushSource) -> None:
    """Receive a rig and its frames until it disconnects."""
    cameras: Cameras | None = None
    while True:
        try:
            async with asyncio.timeout(SILENT_S):
                message = await socket.receive()
        except TimeoutError:
            await close_with_error(
                socket, CloseCode.TIMEOUT, f"expected a frame within {SILENT_S:g} s; reconnect"
            )
            return
        if message["type"] == "websocket.disconnect":
            return
        try:
            index = None
            if cameras is None or message.get("text"):  # a rig may change while it pushes
                cameras = await asyncio.to_thread(_begin_rig, message.get("text") or "", source)
                image_bytes = 4 * int(cameras.size_px.prod(1).sum()) + IMAGE_BYTES * len(cameras)
                authenticate(socket, 8 + HEADER_BYTES + image_bytes)
            else:  # decoded on a thread, so that other messages need not wait
                data = message.get("bytes") or b""
                frame = await asyncio.to_thread(_decode_frame, data, cameras, lambda: is_gone(socket))
                if frame is None:
                    return
                index = source.add(frame)
        except ValueError as error:
            await close_with_error(socket, CloseCode.MALFORMED, str(error))
            return
        await socket.send_text(json.dumps({"type": "taken", "frame": index}))


class PushedCamera(Struct, frozen=True, kw_only=True):
    """One camera of the message `rig`."""

    name: Annotated[str, Meta(max_length=200)]
    width: ImageSide
    height: ImageSide
    K: Annotated[tuple[Annotated[float, Meta(ge=-1e6, le=1e6)], ...], Meta(min_length=9, max_length=9)]
    R: Rotation
    T: Point

    def __post_init__(self) -> None:
        check_rotation(self.R)
        if not is_intrinsics([self.K[:3], self.K[3:6], self.K[6:]]):
            raise ProtocolError(
                "expected 'K' as [fx, skew, cx, 0, fy, cy, 0, 0, 1] with positive fx and fy, got another matrix"
            )


class Box(Struct, frozen=True):
    """The volume of the subject."""

    low: Point
    high: Point

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ProtocolError(
                "expected low < high on every axis of the bounds, got another order; swap them"
            )


class RigMessage(Struct, frozen=True, kw_only=True, tag="rig"):
    """The first message of a rig, also sent when its cameras change."""

    version: int
    name: Annotated[str, Meta(max_length=200)] = "live rig"
    fps: Annotated[float, Meta(ge=0.1, le=240)] = 15.0
    cameras: Annotated[tuple[PushedCamera, ...], Meta(min_length=1, max_length=MAX_CAMERAS)]
    bounds: Box | None = None
    up: Point | None = None

    def __post_init__(self) -> None:
        if self.version != protocol.VERSION:
            raise ProtocolError(f"expected version {protocol.VERSION}, got {self.version}; update the client")
        if len({camera.name for camera in self.cameras}) < len(self.cameras):
            raise ProtocolError("expected unique camera names, got one twice; rename it")
        if self.up is not None and sum(x * x for x in self.up) < 1e-12:
            raise ProtocolError("expected 'up' as a direction, got a zero vector; leave it out")
        widest = max(camera.width for camera in self.cameras)
        highest = max(camera.height for camera in self.cameras)
        pixels = len(self.cameras) * widest * highest
        if pixels > MAX_PIXELS:
            raise ProtocolError(
                f"expected cameras x widest x highest of at most {MAX_PIXELS} pixels, got {pixels}; push smaller images"
            )


class ImagePart(Struct, frozen=True):
    """One image in the header of a frame."""

    camera: str
    kind: Annotated[str, one_of("rgb", "mask")]


def _begin_rig(text: str, source: PushSource) -> Cameras:
    """Start the rig of a message `rig`; returns its cameras. ProtocolError if the message is malformed."""
    rig: RigMessage = read_message(text, RigMessage)
    bounds = (
        None if rig.bounds is None else Bounds(torch.tensor(rig.bounds.low), torch.tensor(rig.bounds.high))
    )
    K, R, T = (torch.tensor([getattr(camera, key) for camera in rig.cameras]) for key in ("K", "R", "T"))
    size_px = torch.tensor([(camera.width, camera.height) for camera in rig.cameras])
    names = tuple(camera.name for camera in rig.cameras)
    cameras = Cameras(names, K.view(-1, 3, 3), rigid(R.view(-1, 3, 3), T), size_px)
    source.begin(rig.name, rig.fps, bounds, None if rig.up is None else torch.tensor(rig.up), cameras)
    return cameras


def _decode_frame(
    message: bytes, cameras: Cameras, is_cancelled: Callable[[], bool]
) -> MultiViewFrame | None:
    """One frame from its JPEGs and PNGs; cameras that lack the image or the mask are left out. None if cancelled.

    ProtocolError if an image is malformed or unexpected, or if fewer than two cameras are complete.
    """
    header, parts = protocol.unpack(message, "images")
    images: dict[tuple[str, str], np.ndarray] = {}
    listed: list[ImagePart] = read_message(header["images"], list[ImagePart])
    if len({(entry.camera, entry.kind) for entry in listed}) < len(listed):
        raise ProtocolError("expected one image of each camera and kind, got one twice; send it once")
    for entry, data in zip(listed, parts, strict=True):
        if is_cancelled():
            return None
        if entry.camera not in cameras.names:
            raise ProtocolError(f"expected a camera among {list(cameras.names)}, got '{entry.camera[:40]}'")
        images[entry.camera, entry.kind] = _decode_image(data, entry.camera, entry.kind, cameras)
    complete = [n for n in cameras.names if (n, "rgb") in images and (n, "mask") in images]
    if len(complete) < 2:
        raise ProtocolError(f"expected image and mask of two cameras or more, got {len(complete)}; send both")
    selected = cameras.select(complete)
    width, height = selected.max_size_px
    rgb = torch.zeros(len(complete), 3, height, width, dtype=torch.uint8)
    mask = torch.zeros(len(complete), height, width, dtype=torch.uint8)
    for view, name in enumerate(complete):
        h, w = images[name, "mask"].shape
        rgb[view, :, :h, :w] = torch.from_numpy(images[name, "rgb"]).movedim(-1, 0)
        mask[view, :h, :w] = torch.from_numpy(images[name, "mask"])
    return MultiViewFrame(selected, rgb, mask, 0)


def _decode_image(
    data: bytes, name: str, kind: str, cameras: Cameras
) -> UInt8[np.ndarray, "height width *channel"]:
    width, height = cameras.size_px[cameras.names.index(name)].tolist()
    expected = f"camera '{name}': expected {kind} of {width} x {height} pixels"
    if not data.startswith((b"\x89PNG", b"\xff\xd8")):
        raise ProtocolError(f"camera '{name}': expected JPEG or PNG as {kind}, got {data[:4]!r}")
    # The size is checked before the image is decoded
    size_px = size_from_header(data)
    if size_px is not None and size_px != (width, height):
        raise ProtocolError(f"{expected}, got {size_px[0]} x {size_px[1]}")
    flags = cv2.IMREAD_COLOR_RGB if kind == "rgb" else cv2.IMREAD_GRAYSCALE
    image = decode_image(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise ProtocolError(f"{expected}, got no image")
    if image.shape[:2] != (height, width):
        raise ProtocolError(f"{expected}, got {image.shape[1]} x {image.shape[0]}")
    return image
