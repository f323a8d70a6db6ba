"""Receiving a rig's frames over a WebSocket."""

import asyncio
import json

import numpy as np
import torch
from jaxtyping import UInt8
from starlette.websockets import WebSocket

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, is_intrinsics
from viewmend.geometry.rigid import is_rotation, rigid
from viewmend.live.fields import Fields, ProtocolError, read_json
from viewmend.live.protocol import VERSION, unpack
from viewmend.live.pushed import Pushed
from viewmend.views import MultiViewFrame

MOST_CAMERAS = 128
MOST_PIXELS = 64_000_000
"""Of all cameras together."""
SILENT_S = 30.0


async def receive_rig(socket: WebSocket, supply: Pushed) -> None:
    """Take in a rig and its frames until it goes."""
    cameras: Cameras | None = None
    while True:
        try:
            async with asyncio.timeout(SILENT_S):
                message = await socket.receive()
        except TimeoutError:
            await _refuse(socket, 4408, f"expected a frame within {SILENT_S:g} s; reconnect")
            return
        if message["type"] == "websocket.disconnect":
            return
        try:
            if cameras is None:
                cameras = _begin(message.get("text") or "", supply)
                await socket.send_text(json.dumps({"type": "taken", "frame": None}))
                continue
            # Decoding eight images takes milliseconds that other viewers' messages need not wait for.
            frame = await asyncio.to_thread(_frame, message.get("bytes") or b"", cameras)
            number = supply.push(frame)
        except ValueError as error:
            await _refuse(socket, 4400, str(error))
            return
        await socket.send_text(json.dumps({"type": "taken", "frame": number}))


async def _refuse(socket: WebSocket, code: int, message: str) -> None:
    await socket.send_text(json.dumps({"type": "error", "code": code, "message": message, "fatal": True}))
    await socket.close(code)


def _begin(text: str, supply: Pushed) -> Cameras:
    """The rig's cameras, from its first message.

    Raises:
        ProtocolError: it is none.
    """
    given = Fields(read_json(text))
    given.choice("type", ("rig",))
    if given.whole("version", 0, 1000) != VERSION:
        raise ProtocolError(f"expected version {VERSION}; update the client")
    cameras = _cameras([Fields(camera) for camera in given.items("cameras", MOST_CAMERAS)])
    bounds = None
    if given.has("bounds"):
        box = Fields(given.get("bounds", None))
        bounds = Bounds(*(torch.tensor(box.numbers(corner, 3, 1e4)) for corner in ("low", "high")))
        if not bool((bounds.low < bounds.high).all()):
            raise ProtocolError("expected 'bounds' with low below high on every axis")
    up = torch.tensor(given.numbers("up", 3, 1e4)) if given.has("up") else None
    if up is not None and float(up.norm()) < 1e-6:
        raise ProtocolError("expected 'up' as a direction, got no length; leave it away")
    supply.begin(given.text("name", "live rig"), given.number("fps", 0.1, 240.0, 15.0), bounds, up)
    return cameras


def _cameras(given: list[Fields]) -> Cameras:
    names = tuple(camera.text("name") for camera in given)
    if len(set(names)) < len(names):
        raise ProtocolError("expected cameras of different names")
    R = torch.tensor([camera.numbers("R", 9, 1.001) for camera in given]).view(-1, 3, 3)
    if not bool(is_rotation(R).all()):
        raise ProtocolError("expected 'R' to be a rotation, world to camera, row by row; got another matrix")
    K = torch.tensor([camera.numbers("K", 9, 1e6) for camera in given]).view(-1, 3, 3)
    if not bool(is_intrinsics(K).all()):
        raise ProtocolError(
            "expected 'K' as [fx, skew, cx, 0, fy, cy, 0, 0, 1] with fx and fy above 0; got another matrix"
        )
    size = [(camera.whole("width", 8, 16384), camera.whole("height", 8, 16384)) for camera in given]
    if sum(width * height for width, height in size) > MOST_PIXELS:
        raise ProtocolError(f"expected at most {MOST_PIXELS} pixels in all; push smaller images")
    T = torch.tensor([camera.numbers("T", 3, 1e4) for camera in given])
    return Cameras(names, K, rigid(R, T), torch.tensor(size))


def _frame(message: bytes, cameras: Cameras) -> MultiViewFrame:
    """One time from its JPEGs and PNGs; cameras of which one of the two is missing are left out.

    Raises:
        ProtocolError: an image of an unknown camera, of another size, or none at all.
    """
    header, parts = unpack(message, "images")
    images: dict[tuple[str, str], np.ndarray] = {}
    for given, data in zip(header["images"], parts, strict=True):
        entry = Fields(given)
        name, kind = entry.choice("camera", cameras.names), entry.choice("kind", ("rgb", "mask"))
        images[name, kind] = _decoded(data, name, kind, cameras)
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
    flags = cv2.IMREAD_COLOR_RGB if kind == "rgb" else cv2.IMREAD_GRAYSCALE
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # it claims more pixels than OpenCV takes
        image = None
    if image is None or image.shape[:2] != (height, width):
        got = "no image" if image is None else f"{image.shape[1]} x {image.shape[0]}"
        raise ProtocolError(f"camera '{name}': expected {kind} of {width} x {height} pixels, got {got}")
    return image
