"""RIFTCast's own clients, beside the page: they ask for RGB-D views over plain TCP, and get mended ones.

A request is answered at once, by the picture of the one before if that is finished, else by nothing new; and if no
picture of this client is on its way, the one that was asked for begins.
"""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator
from importlib.util import find_spec

from viewmend.inpainting.protocol import State
from viewmend.live.pictures import surface_depth, to_jpeg
from viewmend.live.protocol import Limits, ProtocolError
from viewmend.live.render_jobs import RenderJob, ViewOptions, pictures_of, request_for
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.riftcast_messages import (
    CAMERA_DATA,
    LARGEST,
    ImageRequest,
    camera_data,
    framed,
    no_update,
    parse,
    update,
)
from viewmend.live.service import RenderService
from viewmend.live.sessions import Playback

SILENT_S = 30.0
"""Clients poll: who is silent for so long is gone. So is who does not read an answer for so long."""
JPEG_QUALITY = 90
UNREAD_BYTES = 256_000
"""What is held of answers that were not read yet, before the next message is looked at."""


def listen(port: int) -> socket.socket:
    """A socket of this machine alone: the protocol knows no token.

    Raises:
        ValueError: what packs depth is not installed.
        OSError: somebody else has the port.
    """
    if find_spec("zstandard") is None:
        raise ValueError("--riftcast-port needs the extra 'riftcast'; from the clone: pip install -e '.[riftcast]'")
    try:
        return socket.create_server(("127.0.0.1", port))
    except OSError as error:
        what = error.strerror or str(error)
        raise OSError(f"port {port} of 127.0.0.1: {what}; choose another --riftcast-port") from None


class RgbdJob(RenderJob[bytes]):
    """One picture with its depth, as the message that carries it."""

    def __init__(self, asked: ImageRequest, viewer: State | None) -> None:
        super().__init__()
        self.viewer: State | None = viewer
        self._asked, self._options = asked, ViewOptions(width=asked.width, height=asked.height)

    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The view of the live edge, once its frame has been read."""
        return None if self.done.done() else request_for(self._options, self._asked.camera, playback.edge, playback)

    def encode(self, result: RenderResult) -> None:
        """Encode the picture."""
        self.viewer = result.viewer
        jpeg = to_jpeg(pictures_of(self._options, result), JPEG_QUALITY)
        self.finish(update(self._asked, jpeg, surface_depth(result.completed[0])))


class RiftcastClient:
    """One connection: what it asked for last, and what comes of it."""

    def __init__(self, service: RenderService, limits: Limits) -> None:
        self._service, self._limits = service, limits
        self._job: RgbdJob | None = None
        self._viewer: State | None = None

    def answer(self, message: bytes) -> bytes:
        """What is said to a message.

        Raises:
            ProtocolError: it is none of those that are answered.
        """
        asked = parse(message)
        if asked == CAMERA_DATA:
            rig = self._service.supply.rig
            at = None if rig is None else self._service.supply.read(int(self._service.edge))
            return no_update() if at is None else camera_data(at.cameras)
        if not isinstance(asked, ImageRequest):
            raise ProtocolError(f"expected a request of a picture or of the cameras, got task {asked}")
        if min(asked.width, asked.height) < 16:
            raise ProtocolError(f"expected sides of at least 16 pixels, got {asked.width} x {asked.height}")
        self._limits.check_size(asked.width, asked.height)
        finished = self._finished()
        if self._job is None:
            self._job = RgbdJob(asked, self._viewer)
            self._service.join(self._job)
        return finished or no_update()

    def _finished(self) -> bytes | None:
        """The picture that was on its way, if it is there; one that failed is forgotten."""
        job = self._job
        if job is None or not job.done.done():
            return None
        self.leave()
        if job.done.exception() is not None:
            return None
        self._viewer = job.viewer
        return job.done.result()

    def leave(self) -> None:
        """What was asked for is wanted no more."""
        if self._job is not None:
            self._service.leave(self._job)
            self._job.done.cancel()
            self._job = None


class RiftcastService:
    """Accepts clients on a socket, at most as many as there may be viewers."""

    def __init__(self, service: RenderService, limits: Limits, listener: socket.socket) -> None:
        self._service, self._limits, self._listener = service, limits, listener
        self._clients: set[asyncio.Task[None]] = set()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """While it lasts, clients are answered."""
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
            pass  # gone, silent, or no client of ours: it is told by the end of the connection
        finally:
            client.leave()
            self._clients.discard(task)
            writer.transport.abort()
