"""Views that are asked for over plain HTTP: single pictures, and camera paths as videos."""

import time
from abc import ABC, abstractmethod
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from io import BytesIO
from typing import Annotated, Generic, Literal, TypeVar

import numpy as np
from msgspec import Meta, Struct

from viewmend.capture.video_writer import VideoWriter
from viewmend.inpainting.protocol import RenderQuality, State
from viewmend.live import protocol
from viewmend.live.pictures import Picture, picture, to_jpeg
from viewmend.live.poses import stereo_pair, view_camera
from viewmend.live.protocol import HULL_MODES, MENDED_MODES, Camera, FrameTimes, Limits, ProtocolError, read_message
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.sessions import Playback

MAX_POSES = 900
Result = TypeVar("Result")


class ViewOptions(Struct, frozen=True, kw_only=True):
    """What pictures and paths have in common."""

    width: protocol.Side = 320
    height: protocol.Side = 320
    mode: protocol.Mode = "mended"
    top_k: protocol.TopK | None = None
    error_rule: protocol.Rule | None = None
    background: protocol.Colour | None = None


class PictureQuery(ViewOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The query of `GET /frame.jpg`."""

    azimuth: protocol.Degrees = 0.0
    elevation: protocol.Elevation = 0.0
    distance: protocol.Distance | None = None
    fov_y: protocol.FieldOfView | None = None
    quality: protocol.Quality = 85
    time: Literal["live"] | protocol.Count = "live"
    token: str = ""

    @property
    def camera(self) -> Camera:
        """Where the picture is taken from."""
        return Camera(azimuth=self.azimuth, elevation=self.elevation, distance=self.distance, fov_y=self.fov_y)


class PathBody(ViewOptions, frozen=True, kw_only=True):
    """The body of `POST /path.mp4`."""

    poses: Annotated[tuple[Camera, ...], Meta(min_length=1, max_length=MAX_POSES)]
    times: Annotated[tuple[protocol.Count, ...], Meta(min_length=1, max_length=MAX_POSES)] | None = None
    fps: Annotated[float, Meta(ge=1, le=120)] = 30.0
    stereo_m: Annotated[float, Meta(ge=0.001, le=1)] | None = None
    """Distance of two eyes, whose pictures lie side by side, left and right, each `width` wide; None for one eye."""

    def __post_init__(self) -> None:
        if self.times is not None and len(self.times) != len(self.poses):
            raise ProtocolError(f"expected a time for each of {len(self.poses)} poses, got {len(self.times)}")


def parse_query(query: dict[str, str], limits: Limits) -> PictureQuery:
    """What the query of a picture asks for.

    Raises:
        ProtocolError: a key is unknown, a value does not fit, or the picture is too large.
    """
    asked: PictureQuery = read_message(query, PictureQuery, strict=False)
    limits.check_size(asked.width, asked.height)
    return asked


def parse_path(body: bytes | bytearray, limits: Limits) -> PathBody:
    """What the body of a request for a video asks for.

    Raises:
        ProtocolError: it does not fit, or the pictures are too large.
    """
    asked: PathBody = read_message(bytes(body), PathBody)
    limits.check_size(asked.width, asked.height, 1 if asked.stereo_m is None else 2)
    return asked


class RenderJob(ABC, Generic[Result]):
    """A session that ends when `done` has its result."""

    def __init__(self) -> None:
        self.viewer: State | None = None
        self.done: Future[Result] = Future()

    @abstractmethod
    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The next view, once its frame has been read."""

    @abstractmethod
    def encode(self, result: RenderResult) -> None:
        """Take in one view, and `finish` after the last."""

    def show(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Encode the view; what all of it took."""
        start = time.perf_counter()
        self.encode(result)
        return FrameTimes(**vars(result.times), encode=1000 * (time.perf_counter() - start))

    def finish(self, result: Result) -> None:
        """Set the result, unless nobody waits any more."""
        with suppress(InvalidStateError):
            self.done.set_result(result)

    def fail(self, message: str) -> None:
        """Set a RuntimeError, unless nobody waits any more."""
        with suppress(InvalidStateError):
            self.done.set_exception(RuntimeError(message))


class PictureJob(RenderJob[tuple[bytes, RenderResult]]):
    """One picture with all that the model can do, as JPEG."""

    def __init__(self, asked: PictureQuery) -> None:
        super().__init__()
        self._asked = asked

    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The picture, once its frame has been read."""
        at = playback.edge if self._asked.time == "live" else self._asked.time
        return None if self.done.done() else request_for(self._asked, self._asked.camera, at, playback)

    def encode(self, result: RenderResult) -> None:
        """Encode the picture."""
        self.finish((to_jpeg(pictures_of(self._asked, result), self._asked.quality), result))


class PathJob(RenderJob[bytes]):
    """A camera path, encoded view by view as MP4."""

    def __init__(self, path: PathBody) -> None:
        super().__init__()
        self._path, self._times = path, path.times
        self._count = 0
        self._mp4 = BytesIO()
        self._video = VideoWriter(self._mp4, path.fps, threads=1)  # the render thread's own: none is left behind

    @property
    def progress(self) -> tuple[int, int]:
        """How many views are done, and of how many."""
        return self._count, len(self._path.poses)

    def next_request(self, now: float, playback: Playback) -> RenderRequest | None:
        """The next pose, once its frame has been read."""
        if self.done.done() or playback.span.end <= playback.span.first:
            return None
        if self._times is None:  # the edge as it is now
            self._times = (int(playback.span.clamp(playback.edge)),) * len(self._path.poses)
        pose, at = self._path.poses[self._count], self._times[self._count]
        return request_for(self._path, pose, at, playback, self._path.stereo_m)

    def encode(self, result: RenderResult) -> None:
        """Encode one more view; the last one ends the job."""
        self.viewer: State | None = result.viewer
        self._video.add(pictures_of(self._path, result))
        self._count += 1
        if self._count == len(self._path.poses):
            self._video.close()
            self.finish(self._mp4.getvalue())


def request_for(
    asked: ViewOptions, pose: Camera, at: float | int, playback: Playback, stereo_m: float | None = None
) -> RenderRequest | None:
    """The view at the nearest time that there is; None while its frame is on its way."""
    time = int(playback.span.clamp(at))
    if playback.span.end <= playback.span.first or not playback.has_frame(time):
        return None
    camera = view_camera(pose, playback.rig_frame, (asked.width, asked.height))
    eyes = (camera,) if stereo_m is None else stereo_pair(camera, stereo_m, playback.rig_frame.center)
    quality = RenderQuality(mend=asked.mode in MENDED_MODES, top_k=asked.top_k)
    return RenderRequest(time, eyes, quality, asked.error_rule, HULL_MODES & {asked.mode})


def pictures_of(asked: ViewOptions, result: RenderResult) -> Picture:
    """All eyes' pictures side by side."""
    ground = asked.background or result.background
    return np.hstack([picture(seen, asked.mode, ground, hulls) for seen, hulls in result.eyes])
