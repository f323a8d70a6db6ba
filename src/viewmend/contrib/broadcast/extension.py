"""The broadcast, an extension of the live server: one viewer controls a view that any number of browsers watch."""

import asyncio
import contextlib
import logging
import math
import re
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import Any

from msgspec.structs import replace
from starlette.requests import Request
from starlette.responses import Response

from viewmend.contrib.broadcast.hls import PLAYLIST, HlsSegmenter
from viewmend.geometry.threads import one_thread
from viewmend.live.encoding import Image, draw_mode
from viewmend.live.extension import Extension
from viewmend.live.protocol import Camera, FrameTimes, Limits, Look, Message, OnAir, token_query
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.responses import error_response, label, metric
from viewmend.live.server import ExtensionFactory, ServerConfig
from viewmend.live.service import RenderService
from viewmend.live.sessions import PlaybackState, ViewerSession
from viewmend.live.video import video_codecs
from viewmend.models.base import State

UNWATCHED_S = 15.0
"""Rendering and encoding end this many seconds after the last request for the playlist."""
MIN_FPS = 5
"""The video has at least this many frames per second."""
MAX_FPS = 30
"""The video has at most this many frames per second; in between, it has as many as the source."""
STILL_FPS = 10
"""The video has this many frames per second if the source has a single frame."""
START_S = 20.0
"""A video has to begin within this many seconds after the first request for its playlist."""
POLL_S = 0.05
"""Requests and the encoder check at this interval, in seconds, whether they have to go on."""
PLAYLIST_AGE_S = 1
"""HTTP caches may keep the playlist for this many seconds."""
SEGMENT_AGE_S = 60
"""HTTP caches may keep a segment for this many seconds."""

log = logging.getLogger("viewmend.live")


class BroadcastSession(ViewerSession):
    """The session of the broadcast view: a viewer like any other, whose images go to an encoder."""

    def __init__(self, service: RenderService, size_px: tuple[int, int], budget_ms: float | None) -> None:
        """Begin with the page's initial view; the session is closed until `open` is called."""
        super().__init__(
            lambda message: None, lambda error: None, budget_ms, service.renderer.ladder, service.now
        )
        self._size_px = size_px
        self._lock = threading.Lock()
        self._is_open = False
        self.image: Image | None = None
        """The newest image; None before the first."""

    def open(self) -> None:
        """Accept images from now on, beginning with one of the present look; called under the service's lock."""
        if self.wanted_look is not None:
            self.look(self.wanted_look)
        self._is_open = True

    def close(self) -> None:
        """Drop the image, and any that is still being rendered: the next video must not begin with it."""
        with self._lock:
            self._is_open = False
            self.image = None

    def look(self, look: Look) -> None:
        """Show a viewer's look, in the video's size."""
        width, height = self._size_px
        centred = replace(look, camera=centred_camera(look), eyes=None, modes=look.modes[:1])
        # Not as moving: the viewer may leave with this look, which is then shown at rest.
        still = {"scale": 1.0, "depth": False, "moving": False, "full": False}
        super().look(replace(centred, width=width, height=height, **still))

    @property
    def wants_views(self) -> bool:
        """Always: without a look, it shows the page's initial view."""
        return True

    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The newest look at the edge."""
        if self.wanted_look is None:
            home = playback.home
            self.look(Look(camera=Camera(azimuth=home.azimuth, elevation=home.elevation)))
        return super().next_request(now, playback)

    def deliver(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Keep the image, and record its times."""
        start = time.perf_counter()
        look = self.requested.look
        assert look is not None, "a view is rendered for a look"
        self.viewer: State | None = result.viewer
        completed, extra = next(result.eyes)
        with one_thread():
            image = draw_mode(completed, look.modes[0], look.background or result.background, extra)
        with self._lock:
            if self._is_open:
                self.image = image
        times = FrameTimes(encode=1000 * (time.perf_counter() - start)) + result.times
        self.record(look, times, size_bytes=0)
        return times


class Broadcast(Extension):
    """Encodes the broadcast view while it is watched, and serves the video's files."""

    notice = "watch {address}/watch{query}   (the view of the viewer who is on air)"

    def __init__(self, service: RenderService, config: ServerConfig, size_px: tuple[int, int]) -> None:
        self._service = service
        self._size_px = size_px
        self._now = service.now
        self.session = BroadcastSession(service, size_px, config.budget_ms)
        self._director: ViewerSession | None = None
        """The viewer that is on air."""
        self._segmenter: HlsSegmenter | None = None
        self._thread: threading.Thread | None = None
        self._requested_at = -math.inf
        self._stopped = threading.Event()
        self.counts = Counter(playlists=0, segments=0, bytes=0)
        """What was sent, for /metrics."""

    def welcome_json(self) -> dict[str, Any]:
        """See `Extension`."""
        return {"broadcast": True}

    def state_json(self, session: ViewerSession) -> dict[str, Any]:
        """See `Extension`."""
        return {"on_air": self._director is session, "watched": self.is_watched}

    def handle(self, session: ViewerSession, message: Message) -> bool:
        """Put a viewer on air or take it off, and show the looks of the viewer that is on air."""
        if isinstance(message, OnAir):
            if not message.on:
                self.leave(session)
                return True
            self._director = session
        if (
            self._director is session
            and session.wanted_look is not None
            and isinstance(message, OnAir | Look)
        ):
            self.session.look(session.wanted_look)
        return isinstance(message, OnAir)

    def leave(self, session: ViewerSession) -> None:
        """Take a viewer off the air; its last view stays."""
        if self._director is session:
            self._director = None

    def metrics(self) -> list[str]:
        """See `Extension`."""
        sent = {label(kind=kind): self.counts[kind] for kind in ("playlists", "segments")}
        return [
            *metric("viewmend_broadcast_watched", "gauge", "1 while it is watched.", int(self.is_watched)),
            *metric("viewmend_broadcast_files_total", "counter", "Files of the video that were sent.", sent),
            *metric(
                "viewmend_broadcast_bytes_total", "counter", "Bytes of the video sent.", self.counts["bytes"]
            ),
        ]

    def routes(self) -> dict[str, Callable[[Request], Awaitable[Response]]]:
        """See `Extension`."""
        return {"/broadcast/{name}": self._file_response}

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Run as `Extension` says, and end the video afterwards."""
        try:
            yield
        finally:
            self._stopped.set()
            if self._thread is not None:
                await asyncio.to_thread(self._thread.join, 5)

    async def _file_response(self, request: Request) -> Response:
        """A file of the video; 404 if there is none of this name, 503 if the video does not begin in time."""
        name = request.path_params["name"]
        end_s = self._now() + START_S
        content = self.file(name)
        while content is None and name == PLAYLIST:
            if self._now() > end_s or await request.is_disconnected():
                return error_response(503, "the video did not begin in time; see /health")
            await asyncio.sleep(POLL_S)
            content = self.file(name)
        if content is None:
            return error_response(404, "the video has no such file, or no longer; reload the playlist")
        media_type = "video/mp4"
        age_s = SEGMENT_AGE_S
        if name == PLAYLIST:
            content = add_query(content, token_query(request.query_params.get("token")))
            media_type = "application/vnd.apple.mpegurl"
            age_s = PLAYLIST_AGE_S
        headers = {"Cache-Control": f"max-age={age_s}", "X-Content-Type-Options": "nosniff"}
        return Response(content, media_type=media_type, headers=headers)

    @property
    def is_watched(self) -> bool:
        """Whether the playlist was requested recently."""
        return not self._stopped.is_set() and self._now() - self._requested_at < UNWATCHED_S

    def file(self, name: str) -> bytes | None:
        """A file of the video, None if it does not exist (yet). A request for the playlist starts the video.

        Called on the event loop's thread.
        """
        if name == PLAYLIST:
            self._requested_at = self._now()
            if not self._stopped.is_set() and (self._thread is None or not self._thread.is_alive()):
                self._thread = threading.Thread(target=self._run, name="broadcast", daemon=True)
                self._thread.start()
        segmenter = self._segmenter  # the encoder's thread may remove it meanwhile
        content = None if segmenter is None else segmenter.file(name)
        if content:
            self.counts.update({"playlists" if name == PLAYLIST else "segments": 1, "bytes": len(content)})
        return content

    def _run(self) -> None:
        """Render and encode until the video is no longer watched."""
        with self._service.lock:
            self.session.open()
        self._service.join(self.session)
        try:
            while self.is_watched and self.session.image is None:
                self._stopped.wait(POLL_S)
            if self.is_watched:
                self._encode(choose_fps(self._service.source.span.fps))
        except Exception:  # the next request for the playlist tries again
            log.exception("while encoding the broadcast")
        finally:
            self._service.leave(self.session)
            self._segmenter = None
            self.session.close()

    def _encode(self, fps: int) -> None:
        """Encode the newest image at every frame; if encoding is too slow, frames are left out, in step with time."""
        with HlsSegmenter(self._size_px, fps) as segmenter:
            self._segmenter = segmenter
            start_s = self._now()
            index = 0
            while self.is_watched:
                image = self.session.image
                if image is not None:
                    segmenter.add(image, index)
                index = max(index + 1, math.ceil((self._now() - start_s) * fps))
                due_s = start_s + index / fps
                while self.is_watched and self._now() < due_s:
                    self._stopped.wait(min(due_s - self._now(), POLL_S))


def choose_fps(source_fps: float) -> int:
    """The video's frame rate for a source with this one; 0 for a single frame."""
    return STILL_FPS if source_fps <= 0 else round(min(MAX_FPS, max(MIN_FPS, source_fps)))


def centred_camera(look: Look) -> Camera:
    """A look's camera (the left one of two) for an image of any size: the same vertical field of view, centred."""
    camera = look.cameras[0]
    if camera.fx is None:
        return camera
    fov_y = math.degrees(2 * math.atan(look.height / 2 / (camera.fy or camera.fx)))
    return replace(camera, fx=None, fy=None, cx=None, cy=None, fov_y=min(150.0, max(2.0, fov_y)))


def add_query(playlist: bytes, query: str) -> bytes:
    """A playlist whose files are requested with a query, for example `?token=...`."""
    text = re.sub(r'(?<=URI=")[^"]*', lambda uri: uri[0] + query, playlist.decode())
    return re.sub(r"^[^#\n].*$", lambda uri: uri[0] + query, text, flags=re.MULTILINE).encode()


def broadcast_extension(text: str) -> ExtensionFactory:
    """The extension for `--broadcast WIDTHxHEIGHT`.

    Raises:
        ValueError: the size is malformed or too large, or H.264 cannot be encoded.
    """
    found = re.fullmatch(r"(\d{2,5})x(\d{2,5})", text, re.ASCII)
    size_px = (int(found[1]), int(found[2])) if found else (0, 0)
    if min(size_px) < 16 or any(side % 2 for side in size_px):
        raise ValueError(
            f"expected --broadcast WIDTHxHEIGHT, even, from 16, e.g. 1280x720; got '{text[:40]}'"
        )
    try:
        Limits().check_size(*size_px)
    except ValueError as error:
        raise ValueError(f"--broadcast: {error}") from None
    if "h264" not in video_codecs():
        raise ValueError("--broadcast needs PyAV with x264; install a PyAV with it: pip install --upgrade av")
    return partial(Broadcast, size_px=size_px)
