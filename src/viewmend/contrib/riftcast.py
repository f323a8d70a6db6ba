"""A server for RIFTCast's clients, which request RGB-D views over plain TCP (protocol 1.3).

A message is four bytes of length, then a head of 8 bytes (major and minor version, task). Lengths and counts are
big-endian, heads and matrices little-endian; matrices are OpenGL's, column by column, and cameras look along -z. A
request is answered at once: by the image of the previous request if that is finished, otherwise by "no update".
"""

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, UInt16
from torch import Tensor

from viewmend.data.formats.riftcast import FLIP
from viewmend.geometry.cameras import Cameras
from viewmend.live.connection import Extension
from viewmend.live.encoding import surface_depth, to_jpeg
from viewmend.live.protocol import Camera, Limits, ProtocolError
from viewmend.live.render_jobs import RenderJob, ViewOptions, draw_eyes, request_view
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.server import ExtensionFactory, ServerConfig
from viewmend.live.service import RenderService
from viewmend.live.sessions import PlaybackState
from viewmend.models.base import State

MAJOR, MINOR = 1, 3
REQUEST_IMAGE, NO_UPDATE, UPDATE, CAMERA_DATA = 3, 4, 5, 10
HEAD = struct.Struct("<HHi")
NOTHING_NEW = HEAD.pack(MAJOR, MINOR, NO_UPDATE)
"""The answer if there is no new image yet."""
LARGEST = 4096
"""Bytes of a message that a client may send; a request has 152."""
STEPS_PER_M = 5000
"""Depth is sent in fifths of a millimetre."""
BACKGROUND_M = 10.0
"""Depth of pixels without a subject: farther than clients draw."""
NEAR_M, FAR_M = 0.01, 10.0
"""Clipping planes of the projections that are sent."""


@dataclass(frozen=True)
class ImageRequest:
    """A requested image."""

    width: int
    height: int
    camera: Camera
    world_from_clip: bytes
    """The inverse of projection times view, which is returned with the image to locate its pixels."""


def parse(message: bytes) -> ImageRequest | int:
    """Read a client's message: a request for an image, or the number of a request without a body.

    Raises:
        ProtocolError: it is of another version, truncated, or requests an impossible view.
    """
    if len(message) < HEAD.size:
        raise ProtocolError(f"expected a head of {HEAD.size} bytes, got {len(message)}")
    major, _, task = HEAD.unpack_from(message)
    if major != MAJOR:
        raise ProtocolError(f"expected RIFTCast's protocol {MAJOR}.{MINOR}, got version {major}; update the client")
    if task != REQUEST_IMAGE:
        return task
    body = message[HEAD.size :]
    if len(body) < 144:
        raise ProtocolError(f"expected a request of 144 bytes, got {len(body)}")
    width, height, view_bytes = struct.unpack_from(">III", body)
    (projection_bytes,) = struct.unpack_from(">I", body, 76)
    if (view_bytes, projection_bytes) != (64, 64):
        raise ProtocolError(f"expected two matrices of 64 bytes, got {view_bytes} and {projection_bytes}")
    with np.errstate(all="ignore"):  # results are checked
        view, projection = (np.frombuffer(body, "<f4", 16, at).reshape(4, 4).T.astype(float) for at in (12, 80))
        camera = camera_of(view, projection, width, height)
        try:
            inverse = np.linalg.inv(projection @ view).astype("<f4")
        except np.linalg.LinAlgError:
            inverse = np.full((4, 4), np.nan)
    if not np.isfinite(inverse).all():
        raise ProtocolError("expected a projection that can be undone, got another")
    return ImageRequest(width, height, camera, _columns(inverse))


def camera_of(view: Float[np.ndarray, "4 4"], projection: Float[np.ndarray, "4 4"], width: int, height: int) -> Camera:
    """The camera of OpenGL's matrices, for images of this size.

    Raises:
        ProtocolError: they are not finite, or the projection is not a perspective one.
    """
    if not (np.isfinite(view).all() and np.isfinite(projection).all() and np.abs(view).max() < 1e4):
        raise ProtocolError("expected matrices of finite numbers, got others")
    pose, P = FLIP @ view, projection
    fx, fy = float(P[0, 0] * width / 2), float(P[1, 1] * height / 2)
    if P[3, 2] != -1 or not (1 <= fx <= 1e6 and 1 <= fy <= 1e6):
        raise ProtocolError("expected a perspective projection, got another; see docs/guide/riftcast.md")
    cx, cy = float((1 - P[0, 2]) * width / 2), float((1 + P[1, 2]) * height / 2)
    if max(abs(cx), abs(cy)) > 1e5:
        raise ProtocolError("expected a frustum around the viewing direction, got one far off axis")
    R, T = tuple(pose[:3, :3].flatten().tolist()), tuple(pose[:3, 3].tolist())
    return Camera(R=R, T=T, fx=fx, fy=fy, cx=cx, cy=cy)


def update(request: ImageRequest, jpeg: bytes, depth: Float[Tensor, "height width"]) -> bytes:
    """A requested image, top row first, and its depth (metres, 0 without subject), bottom row first, as Zstandard."""
    import zstandard

    packed = zstandard.ZstdCompressor(level=1).compress(depth_steps(depth).tobytes())
    return HEAD.pack(MAJOR, MINOR, UPDATE) + b"".join(map(_sized, (request.world_from_clip, jpeg, packed)))


def depth_steps(depth: Float[Tensor, "height width"]) -> UInt16[np.ndarray, "height width"]:
    """Depth in steps, the bottom row first; clients treat numbers from 32768 as empty."""
    z = depth.double().cpu().numpy()[::-1]
    steps = np.rint(np.where(z > 0, np.minimum(z, BACKGROUND_M), BACKGROUND_M) * STEPS_PER_M)
    return np.ascontiguousarray(steps, dtype="<u2")


def camera_data(cameras: Cameras) -> bytes:
    """The rig: all views' matrices, then all projections'."""
    views = [_columns(FLIP @ pose.double().cpu().numpy()) for pose in cameras.camera_from_world]
    projections = [
        _columns(_projection(K.double().cpu().numpy(), *size))
        for K, size in zip(cameras.K, cameras.size_px.tolist(), strict=True)
    ]
    return HEAD.pack(MAJOR, MINOR, CAMERA_DATA) + _sized(b"".join(views)) + _sized(b"".join(projections))


def _projection(K: Float[np.ndarray, "3 3"], width: int, height: int) -> Float[np.ndarray, "4 4"]:
    P = np.zeros((4, 4))
    P[0, 0], P[1, 1] = 2 * K[0, 0] / width, 2 * K[1, 1] / height
    P[0, 1] = -2 * K[0, 1] / width
    P[0, 2], P[1, 2] = 1 - 2 * K[0, 2] / width, 2 * K[1, 2] / height - 1
    P[2, 2], P[2, 3] = (FAR_M + NEAR_M) / (NEAR_M - FAR_M), 2 * FAR_M * NEAR_M / (NEAR_M - FAR_M)
    P[3, 2] = -1
    return P


def _columns(matrix: Float[np.ndarray, "4 4"]) -> bytes:
    return matrix.T.astype("<f4").tobytes()


def _sized(data: bytes) -> bytes:
    """The data after its length."""
    return struct.pack(">I", len(data)) + data


SILENT_S = 30.0
"""Clients poll: one that sends nothing, or does not read an answer, for this long is disconnected."""
JPEG_QUALITY = 90
UNREAD_BYTES = 256_000
"""Unread answers above this size delay the next one."""


class RgbdJob(RenderJob[bytes]):
    """One image with its depth, as a RIFTCast message."""

    def __init__(self, asked: ImageRequest, viewer: State | None) -> None:
        super().__init__()
        self.viewer: State | None = viewer
        self._asked, self._options = asked, ViewOptions(width=asked.width, height=asked.height)

    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The view at the edge; None while its frame is being read."""
        return None if self.done.done() else request_view(self._options, self._asked.camera, playback.edge, playback)

    def encode(self, result: RenderResult) -> None:
        """Encode the image."""
        self.viewer = result.viewer
        jpeg = to_jpeg(draw_eyes(self._options, result), JPEG_QUALITY)
        self.finish(update(self._asked, jpeg, surface_depth(result.completed[0])))


class RiftcastClient:
    """One connection, and the image that is being rendered for it."""

    def __init__(self, service: RenderService, limits: Limits) -> None:
        self._service, self._limits = service, limits
        self._job: RgbdJob | None = None
        self._viewer: State | None = None

    def answer(self, message: bytes) -> bytes:
        """Answer a message.

        Raises:
            ProtocolError: the message is malformed, or of an unknown kind.
        """
        asked = parse(message)
        if asked == CAMERA_DATA:
            source = self._service.source
            frame = None if source.rig is None else source.read(int(source.edge))
            return NOTHING_NEW if frame is None else camera_data(frame.cameras)
        if not isinstance(asked, ImageRequest):
            raise ProtocolError(f"expected a request for an image or for the cameras, got task {asked}")
        if min(asked.width, asked.height) < 16:
            raise ProtocolError(f"expected sides of at least 16 pixels, got {asked.width} x {asked.height}")
        self._limits.check_size(asked.width, asked.height)
        job, answer = self._job, NOTHING_NEW
        if job is not None and job.done.done():
            self.leave()
            if job.done.exception() is None:  # a failed image is dropped
                self._viewer, answer = job.viewer, job.done.result()
        if self._job is None:
            self._job = RgbdJob(asked, self._viewer)
            self._service.join(self._job)
        return answer

    def leave(self) -> None:
        """Cancel the image that is being rendered."""
        if self._job is not None:
            self._service.leave(self._job)
            self._job.done.cancel()
            self._job = None


class RiftcastService(Extension):
    """Accepts clients on a socket, at most as many as viewers."""

    def __init__(self, service: RenderService, config: ServerConfig, listener: socket.socket) -> None:
        self._service, self._limits, self._listener = service, config.limits, listener
        self._clients: set[asyncio.Task[None]] = set()
        self.notice = f"RIFTCast's clients: 127.0.0.1, port {listener.getsockname()[1]}"

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Answer clients within the context."""
        server = await asyncio.start_server(self._accept, sock=self._listener, limit=2 * LARGEST)
        try:
            yield
        finally:
            server.close()
            for client in list(self._clients):
                client.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None, "a coroutine of the loop"
        if len(self._clients) >= self._limits.viewers:
            writer.transport.abort()
            return
        self._clients.add(task)
        client = RiftcastClient(self._service, self._limits)
        writer.transport.set_write_buffer_limits(UNREAD_BYTES)
        try:
            while True:
                async with asyncio.timeout(SILENT_S):
                    size = int.from_bytes(await reader.readexactly(4))
                    if size > LARGEST:
                        break
                    message = await reader.readexactly(size)
                writer.write(_sized(client.answer(message)))
                async with asyncio.timeout(SILENT_S):
                    await writer.drain()
        except (asyncio.IncompleteReadError, TimeoutError, OSError, ProtocolError):
            pass  # the client has gone, is silent or speaks another protocol
        finally:
            client.leave()
            self._clients.discard(task)
            writer.transport.abort()


def riftcast_extension(port: int) -> ExtensionFactory:
    """The extension for `--riftcast-port`; takes the port at once, for this machine alone: the protocol has no token.

    Raises:
        OSError: the port is in use.
    """
    try:
        listener = socket.create_server(("127.0.0.1", port))
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"port {port} of 127.0.0.1: {reason}; choose another --riftcast-port") from None
    return partial(RiftcastService, listener=listener)
