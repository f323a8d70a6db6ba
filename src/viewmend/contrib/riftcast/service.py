"""A server for RIFTCast's clients, which request RGB-D views over plain TCP.

A request is answered at once: by the image of the previous request if that is finished, else by "no update". If no
image of this client is being rendered, the requested one is started.
"""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from functools import partial

from viewmend.contrib.riftcast.messages import (
    CAMERA_DATA,
    LARGEST,
    ImageRequest,
    camera_data,
    framed,
    no_update,
    parse,
    update,
)
from viewmend.live.connection import Extension
from viewmend.live.encoding import surface_depth, to_jpeg
from viewmend.live.protocol import Limits, ProtocolError
from viewmend.live.render_jobs import RenderJob, ViewOptions, draw_eyes, request_view
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.server import ExtensionFactory, ServerConfig
from viewmend.live.service import RenderService
from viewmend.live.sessions import PlaybackState
from viewmend.models.base import State

SILENT_S = 30.0
"""Clients poll: one that sends nothing, or does not read an answer, for this long is disconnected."""
JPEG_QUALITY = 90
UNREAD_BYTES = 256_000
"""Unread answers above this size delay the next one."""


def listen(port: int) -> socket.socket:
    """A socket that only this machine can reach, as the protocol has no token.

    Raises:
        OSError: the port is in use.
    """
    try:
        return socket.create_server(("127.0.0.1", port))
    except OSError as error:
        reason = error.strerror or str(error)
        raise OSError(f"port {port} of 127.0.0.1: {reason}; choose another --riftcast-port") from None


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
            return no_update() if frame is None else camera_data(frame.cameras)
        if not isinstance(asked, ImageRequest):
            raise ProtocolError(f"expected a request for an image or for the cameras, got task {asked}")
        if min(asked.width, asked.height) < 16:
            raise ProtocolError(f"expected sides of at least 16 pixels, got {asked.width} x {asked.height}")
        self._limits.check_size(asked.width, asked.height)
        finished = self._finished()
        if self._job is None:
            self._job = RgbdJob(asked, self._viewer)
            self._service.join(self._job)
        return finished or no_update()

    def _finished(self) -> bytes | None:
        """The image that was being rendered, if it is finished; a failed one is dropped."""
        job = self._job
        if job is None or not job.done.done():
            return None
        self.leave()
        if job.done.exception() is not None:
            return None
        self._viewer = job.viewer
        return job.done.result()

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
                writer.write(framed(client.answer(message)))
                async with asyncio.timeout(SILENT_S):
                    await writer.drain()
        except (asyncio.IncompleteReadError, TimeoutError, OSError, ProtocolError):
            pass  # the client has gone, is silent or speaks another protocol
        finally:
            client.leave()
            self._clients.discard(task)
            writer.transport.abort()


def riftcast_extension(port: int) -> ExtensionFactory:
    """The extension for `--riftcast-port`; takes the port at once.

    Raises:
        OSError: the port is in use.
    """
    return partial(RiftcastService, listener=listen(port))
