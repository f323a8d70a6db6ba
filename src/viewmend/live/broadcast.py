"""One view for many: a viewer goes on air, and whoever watches gets the same film, encoded once (HLS)."""

import logging
import math
import threading
import time
from collections import Counter

from msgspec.structs import replace

from viewmend.geometry.threads import light_operations
from viewmend.inpainting.protocol import State
from viewmend.live.film_segments import PLAYLIST, FilmSegments
from viewmend.live.pictures import Picture, picture
from viewmend.live.protocol import Camera, FrameTimes, Look
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.service import RenderService
from viewmend.live.sessions import Playback, ViewerSession

UNWATCHED_S = 15.0
"""So long after the last question for the playlist nothing is rendered or encoded any more."""
FPS = (5, 30)
"""Least and most frames a second; in between as many as the source has."""
STILL_FPS = 10
"""Frames a second of a source that stands still."""

log = logging.getLogger("viewmend.live")


class BroadcastSession(ViewerSession):
    """The session whose view all who watch see: a viewer like any other, whose pictures go to an encoder."""

    def __init__(self, service: RenderService, size_px: tuple[int, int], budget_ms: float | None) -> None:
        """Begin with the view that the page begins with."""
        super().__init__(lambda message: None, lambda error: None, budget_ms, service.renderer.ladder)
        self._size_px = size_px
        self.picture: Picture | None = None
        """The newest; replaced, never changed."""

    def look(self, look: Look) -> None:
        """Show what somebody looks at, in the film's size."""
        width, height = self._size_px
        shown = replace(look, camera=centred(look), eyes=None, modes=look.modes[:1], width=width, height=height)
        super().look(replace(shown, scale=1.0, depth=False, moving=False))  # who leaves, rests

    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The newest look at the edge."""
        if self._look is None:
            home = playback.rig_frame
            self.look(Look(camera=Camera(azimuth=home.azimuth, elevation=home.elevation)))
        return super().next_request(now, playback)

    def show(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Take the picture, and learn from what it took."""
        start, look = time.perf_counter(), self._shown[0]
        assert look is not None, "views are rendered for those who look"
        self.viewer: State | None = result.viewer
        completed, hulls = next(result.eyes)
        with light_operations():
            self.picture = picture(completed, look.modes[0], look.background or result.background, hulls)
        times = FrameTimes(**vars(result.times), encode=1000 * (time.perf_counter() - start))
        self._learn(look, times, size_bytes=0)
        return times


class Broadcast:
    """What is on air, and the film of it, which is made while somebody watches."""

    def __init__(self, service: RenderService, size_px: tuple[int, int], budget_ms: float | None) -> None:
        """Set up.

        Args:
            service: renders.
            size_px: the film's width and height, even.
            budget_ms: milliseconds that a view may take; None without a limit.
        """
        self._service, self._size_px = service, size_px
        self._session = BroadcastSession(service, size_px, budget_ms)
        self._director: ViewerSession | None = None
        self._film: FilmSegments | None = None
        self._thread: threading.Thread | None = None
        self._asked_at = -math.inf
        self._stopped = threading.Event()
        self.counts = Counter(playlists=0, segments=0, bytes=0)
        """What was sent, for /metrics."""

    def go_on_air(self, viewer: ViewerSession, on: bool) -> None:
        """Let a viewer's looks be shown from now on, in place of another's, or no more. Under the service's lock."""
        if on:
            self._director = viewer
            if viewer.newest_look is not None:
                self._session.look(viewer.newest_look)
        elif self._director is viewer:
            self._director = None

    def is_on_air(self, viewer: ViewerSession) -> bool:
        """Whether it is this viewer's looks that are shown."""
        return self._director is viewer

    def look(self, viewer: ViewerSession) -> None:
        """Show what a viewer looks at now, if it is on air. Under the service's lock."""
        if self._director is viewer:
            self.go_on_air(viewer, True)

    @property
    def watched(self) -> bool:
        """Whether somebody has asked for the playlist lately."""
        return not self._stopped.is_set() and time.monotonic() - self._asked_at < UNWATCHED_S

    def file(self, name: str) -> bytes | None:
        """A file of the film; None where it is not there, or not yet. Asking for the playlist begins the film.

        From the event loop's thread.
        """
        if name == PLAYLIST:
            self._asked_at = time.monotonic()
            if not self._stopped.is_set() and (self._thread is None or not self._thread.is_alive()):
                self._thread = threading.Thread(target=self._run, name="broadcast", daemon=True)
                self._thread.start()
        film = self._film  # which its thread may take away meanwhile
        content = film and film.file(name)
        if content:
            self.counts.update({"playlists" if name == PLAYLIST else "segments": 1, "bytes": len(content)})
        return content

    def stop(self) -> None:
        """End the film."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join(timeout=5)

    def _run(self) -> None:
        """Encode the newest picture again and again, as often as a film has frames, until nobody watches."""
        self._service.join(self._session)
        try:
            while self.watched and self._session.picture is None:
                self._stopped.wait(0.02)
            if self.watched:
                self._encode(frames_per_second(self._service.supply.span.fps))
        except Exception:  # the next question for the playlist tries again
            log.exception("while encoding the broadcast")
        finally:
            self._service.leave(self._session)
            self._film, self._session.picture = None, None

    def _encode(self, fps: int) -> None:
        with FilmSegments(self._size_px, fps) as film:
            self._film, start, at = film, time.monotonic(), 0
            while self.watched:
                if (shown := self._session.picture) is not None:
                    film.add(shown, at)
                # Where encoding is slower than the film, frames are left out, and the others come at their time.
                at = max(at + 1, math.ceil((time.monotonic() - start) * fps))
                self._stopped.wait(max(0.0, start + at / fps - time.monotonic()))


def frames_per_second(source_fps: float) -> int:
    """How many frames a film has of a source with so many; 0 for one that stands still."""
    least, most = FPS
    return STILL_FPS if source_fps <= 0 else round(min(most, max(least, source_fps)))


def centred(look: Look) -> Camera:
    """A look's camera, the left one of two, for a picture of any size: as high a field of view, about its middle."""
    camera = look.cameras[0]
    if camera.fx is None:
        return camera
    fov_y = math.degrees(2 * math.atan(look.height / 2 / (camera.fy or camera.fx)))
    return replace(camera, fx=None, fy=None, cx=None, cy=None, fov_y=min(150.0, max(2.0, fov_y)))
