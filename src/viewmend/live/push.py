"""Receiving a rig's frames over a WebSocket."""

import asyncio
import json
from typing import Annotated

import numpy as np
import torch
from jaxtyping import UInt8
from msgspec import Meta, Struct
from starlette.websockets import WebSocket

from viewmend.capture.images import decoded, told_size
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, is_intrinsics
from viewmend.geometry.rigid import rigid
from viewmend.json_input import one_of
from viewmend.live.connection import close_with_error
from viewmend.live.door import Visitor, admit, visitor_of
from viewmend.live.protocol import (
    HEADER_BYTES,
    VERSION,
    Point,
    ProtocolError,
    Rotation,
    check_rotation,
    read_message,
    unpack,
)
from viewmend.live.pushed import PushedFrames
from viewmend.views import MultiViewFrame

MAX_CAMERAS = 128
MAX_PIXELS = 64_000_000
"""Cameras x widest x highest: a frame's images lie in one tensor."""
IMAGE_BYTES = 65_536
"""What an image may take besides four bytes a pixel: no JPEG and PNG of a camera need more."""
SILENT_S = 30.0
ImageSide = Annotated[int, Meta(ge=8, le=16384)]


async def receive_rig(socket: WebSocket, supply: PushedFrames) -> None:
    """Receive a rig and its frames, until it disconnects."""
    cameras: Cameras | None = None
    while True:
        try:
            async with asyncio.timeout(SILENT_S):
                message = await socket.receive()
        except TimeoutError:
            await close_with_error(socket, 4408, f"expected a frame within {SILENT_S:g} s; reconnect")
            return
        if message["type"] == "websocket.disconnect":
            return
        try:
            if cameras is None or message.get("text"):  # a rig may change while it pushes
                cameras = await asyncio.to_thread(_begin, message.get("text") or "", supply)
                admit(socket, _frame_bytes(cameras))
                await socket.send_text(json.dumps({"type": "taken", "frame": None}))
                continue
            # On a thread: other viewers' messages need not wait while images are decoded.
            frame = await asyncio.to_thread(_frame, message.get("bytes") or b"", cameras, visitor_of(socket))
            if frame is None:
                return
            number = supply.push(frame)
        except ValueError as error:
            await close_with_error(socket, 4400, str(error))
            return
        await socket.send_text(json.dumps({"type": "taken", "frame": number}))


class CameraEntry(Struct, frozen=True, kw_only=True):
    """One camera of the message `rig`."""

    name: Annotated[str, Meta(max_length=200)]
    width: ImageSide
    height: ImageSide
    K: Annotated[tuple[Annotated[float, Meta(ge=-1e6, le=1e6)], ...], Meta(min_length=9, max_length=9)]
    R: Rotation
    T: Point

    def __post_init__(self) -> None:
        check_rotation(self.R)
        if not bool(is_intrinsics(torch.tensor(self.K).view(3, 3))):
            raise ProtocolError(
                "expected 'K' as [fx, skew, cx, 0, fy, cy, 0, 0, 1] with fx and fy above 0, got another"
            )


class Box(Struct, frozen=True):
    """The volume of the subject."""

    low: Point
    high: Point

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ProtocolError("expected low below high on every axis, got another order; swap them")


class RigMessage(Struct, frozen=True, kw_only=True, tag="rig"):
    """The first message of a rig, and whenever its cameras change."""

    version: int
    name: Annotated[str, Meta(max_length=200)] = "live rig"
    fps: Annotated[float, Meta(ge=0.1, le=240)] = 15.0
    cameras: Annotated[tuple[CameraEntry, ...], Meta(min_length=1, max_length=MAX_CAMERAS)]
    bounds: Box | None = None
    up: Point | None = None

    def __post_init__(self) -> None:
        if self.version != VERSION:
            raise ProtocolError(f"expected version {VERSION}, got {self.version}; update the client")
        if len({camera.name for camera in self.cameras}) < len(self.cameras):
            raise ProtocolError("expected cameras of different names, got one twice; rename it")
        if self.up is not None and sum(x * x for x in self.up) < 1e-12:
            raise ProtocolError("expected 'up' as a direction, got no length; leave it away")
        widest, highest = max(camera.width for camera in self.cameras), max(camera.height for camera in self.cameras)
        if (pixels := len(self.cameras) * widest * highest) > MAX_PIXELS:
            raise ProtocolError(
                f"expected cameras x widest x highest of at most {MAX_PIXELS} pixels, got {pixels}; push smaller images"
            )


class ImagePart(Struct, frozen=True):
    """One image of a frame's header."""

    camera: str
    kind: Annotated[str, one_of("rgb", "mask")]


def _begin(text: str, supply: PushedFrames) -> Cameras:
    """The rig's cameras, from its first message.

    Raises:
        ProtocolError: it is none.
    """
    rig: RigMessage = read_message(text, RigMessage)
    bounds = None if rig.bounds is None else Bounds(torch.tensor(rig.bounds.low), torch.tensor(rig.bounds.high))
    supply.begin(rig.name, rig.fps, bounds, None if rig.up is None else torch.tensor(rig.up))
    K, R, T = (torch.tensor([getattr(camera, key) for camera in rig.cameras]) for key in ("K", "R", "T"))
    size_px = torch.tensor([(camera.width, camera.height) for camera in rig.cameras])
    return Cameras(tuple(c.name for c in rig.cameras), K.view(-1, 3, 3), rigid(R.view(-1, 3, 3), T), size_px)


def _frame_bytes(cameras: Cameras) -> int:
    """The largest message that a frame of this rig may be."""
    images = 4 * int(cameras.size_px.prod(1).sum()) + IMAGE_BYTES * len(cameras)
    return 8 + HEADER_BYTES + images


def _frame(message: bytes, cameras: Cameras, rig: Visitor) -> MultiViewFrame | None:
    """One time from its JPEGs and PNGs; cameras of which one of the two is missing are left out.

    None once the rig is gone, whose work is dropped.

    Raises:
        ProtocolError: an image of an unknown camera, of another size, or none at all.
    """
    header, parts = unpack(message, "images")
    images: dict[tuple[str, str], np.ndarray] = {}
    listed: list[ImagePart] = read_message(header["images"], list[ImagePart])
    if len({(entry.camera, entry.kind) for entry in listed}) < len(listed):
        raise ProtocolError("expected one image of each camera and kind, got one twice; send it once")
    for entry, data in zip(listed, parts, strict=True):
        if rig.gone:
            return None
        if entry.camera not in cameras.names:
            raise ProtocolError(f"expected a camera among {list(cameras.names)}, got '{entry.camera[:40]}'")
        images[entry.camera, entry.kind] = _decoded(data, entry.camera, entry.kind, cameras)
    there = [n for n in cameras.names if (n, "rgb") in images and (n, "mask") in images]
    if len(there) < 2:
        raise ProtocolError(f"expected image and mask of two cameras or more, got {len(there)}")
    seen = cameras.select(there)
    width, height = seen.max_size_px
    rgb = torch.zeros(len(there), 3, height, width, dtype=torch.uint8)
    mask = torch.zeros(len(there), height, width, dtype=torch.uint8)
    for view, name in enumerate(there):
        h, w = images[name, "mask"].shape
        rgb[view, :, :h, :w] = torch.from_numpy(images[name, "rgb"]).movedim(-1, 0)
        mask[view, :h, :w] = torch.from_numpy(images[name, "mask"])
    return MultiViewFrame(seen, rgb, mask, 0)


def _decoded(data: bytes, name: str, kind: str, cameras: Cameras) -> UInt8[np.ndarray, "height width *channel"]:
    import cv2

    width, height = cameras.size_px[cameras.names.index(name)].tolist()
    if not data.startswith((b"\x89PNG", b"\xff\xd8")):
        raise ProtocolError(f"camera '{name}': expected JPEG or PNG as {kind}, got {data[:4]!r}")
    if (told := told_size(data)) is not None and told != (width, height):
        raise ProtocolError(f"camera '{name}': expected {kind} of {width} x {height} pixels, got {told[0]} x {told[1]}")
    flags = cv2.IMREAD_COLOR_RGB if kind == "rgb" else cv2.IMREAD_GRAYSCALE
    image = decoded(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.shape[:2] != (height, width):
        got = "no image" if image is None else f"{image.shape[1]} x {image.shape[0]}"
        raise ProtocolError(f"camera '{name}': expected {kind} of {width} x {height} pixels, got {got}")
    return image
