"""Views requested over plain HTTP: single images, camera paths as videos, and the cameras' own images."""

import math
import time
from abc import ABC, abstractmethod
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import replace
from io import BytesIO
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from msgspec import Meta, Struct
from torch import Tensor

from viewmend.data.videos import VideoWriter
from viewmend.geometry.orbit import fit_to, orbit, thinned
from viewmend.live import protocol
from viewmend.live.encoding import Image, draw_mode, to_jpeg
from viewmend.live.frame_source import Span
from viewmend.live.poses import HomeView, stereo_pair, view_camera
from viewmend.live.protocol import Camera, FrameTimes, Limits, ProtocolError, read_message
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.sessions import PlaybackState
from viewmend.models.base import RenderQuality, State
from viewmend.types import MultiViewFrame
from viewmend.utils.untrusted_input import one_of

MAX_POSES = 900
TURNTABLE_VIEWS = 25
"""Number of views around the subject in which it has to fit."""
SOURCE_QUALITY = 90
"""JPEG quality of the cameras' own images."""
Result = TypeVar("Result")


class ViewOptions(Struct, frozen=True, kw_only=True):
    """Options that images and paths have in common."""

    width: protocol.Side = 320
    height: protocol.Side = 320
    mode: protocol.Mode = "completed"
    top_k: protocol.TopK | None = None
    error_rule: protocol.Rule | None = None
    background: protocol.Colour | None = None
    model: protocol.Model | None = None
    """See `protocol.Look`."""


class ImageQuery(ViewOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The query of `GET /frame.jpg`."""

    azimuth: protocol.Degrees = 0.0
    elevation: protocol.Elevation = 0.0
    distance: protocol.Distance | None = None
    fov_y: protocol.FieldOfView | None = None
    quality: protocol.Quality = 85
    time: Literal["live"] | protocol.Count = "live"
    camera: protocol.CameraName | None = None
    """A camera of the rig: the view has its pose, lens and size, and is scored against its image."""
    mode: Annotated[str, one_of(*protocol.MODES, "error")] = "completed"
    without: protocol.NameList = ""
    token: str = ""

    def __post_init__(self) -> None:
        if self.mode == "error" and self.camera is None:
            raise ProtocolError("expected 'camera' for the mode 'error', got none; give its name")
        if self.mode == "compared" and self.model is None:
            raise ProtocolError("expected 'model' for the mode 'compared', got none; give its name")

    @property
    def left_out(self) -> tuple[str, ...]:
        """The names in `without`."""
        return tuple(name.strip() for name in self.without.split(",") if name.strip())


class SourceImageQuery(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The query of `GET /camera.jpg`."""

    name: protocol.CameraName
    """The camera's name."""
    time: Literal["live"] | protocol.Count = "live"
    token: str = ""


class TurntableQuery(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The query of `GET /turntable`: how to frame a video around the subject so that it stays in view."""

    time: protocol.Count
    """Index of the video's first frame."""
    frames: Annotated[int, Meta(ge=1, le=MAX_POSES)] = 1
    """Number of frames that the video shows."""
    azimuth: protocol.Degrees = 0.0
    """The middle of the arc, in degrees."""
    arc: Annotated[float, Meta(ge=1, le=360)] = 360.0
    elevation: protocol.Elevation = 0.0
    width: protocol.Side = 320
    height: protocol.Side = 320
    token: str = ""

    def moments(self, span: Span) -> list[int]:
        """A sample of the video's frames, from which `frame_motion` learns what the motion covers."""
        count = span.end - span.first
        shown = {span.first + (self.time - span.first + n) % count for n in range(min(self.frames, count))}
        return thinned(sorted(shown))


def frame_motion(asked: TurntableQuery, points: Float[Tensor, "point 3"], home: HomeView) -> dict[str, Any]:
    """Choose target, distance (metres) and focal length (pixels) so that a turntable shows all points."""
    center = (points.amin(0) + points.amax(0)) / 2
    azimuths = torch.deg2rad(asked.azimuth + asked.arc * torch.linspace(-0.5, 0.5, TURNTABLE_VIEWS)).tolist()
    elevation_rad = math.radians(asked.elevation)
    size_px = (asked.width, asked.height)
    shape = {"radius_m": home.distance_m, "elevation_rad": elevation_rad, "center": center, "up": home.up}
    path = fit_to(orbit(azimuths, size_px, **shape, visible_m=home.distance_m), points)
    return {"target": center.tolist(), "distance": home.distance_m, "f": float(path.K[0, 0, 0])}


class PathBody(ViewOptions, frozen=True, kw_only=True):
    """The body of `POST /path.mp4`."""

    poses: Annotated[tuple[Camera, ...], Meta(min_length=1, max_length=MAX_POSES)]
    times: Annotated[tuple[protocol.Count, ...], Meta(min_length=1, max_length=MAX_POSES)] | None = None
    fps: Annotated[float, Meta(ge=1, le=120)] = 30.0
    without: protocol.Names = ()
    stereo_m: Annotated[float, Meta(ge=0.001, le=1)] | None = None
    """Distance of the two eyes of a side-by-side stereo video, each `width` wide; None for a single view."""

    def __post_init__(self) -> None:
        if self.times is not None and len(self.times) != len(self.poses):
            raise ProtocolError(f"expected a time for each of {len(self.poses)} poses, got {len(self.times)}")


def parse_path(body: bytes | bytearray, limits: Limits) -> PathBody:
    """Parse the body of a request for a video; ProtocolError if it is malformed or the images are too large."""
    asked: PathBody = read_message(bytes(body), PathBody)
    limits.check_size(asked.width, asked.height, 1 if asked.stereo_m is None else 2)
    return asked


class RenderError(RuntimeError):
    """A view of a job could not be rendered."""


class RenderJob(ABC, Generic[Result]):
    """A session that ends when `done` has its result."""

    def __init__(self) -> None:
        self.viewer: State | None = None
        self.done: Future[Result] = Future()

    wants_views = True

    @abstractmethod
    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The next view; None while its frame is being read."""

    @abstractmethod
    def encode(self, result: RenderResult) -> None:
        """Encode one view, and `finish` after the last."""

    def deliver(self, request: RenderRequest, result: RenderResult) -> FrameTimes:
        """Encode the view; returns the times of all stages."""
        start = time.perf_counter()
        self.encode(result)
        return FrameTimes(encode=1000 * (time.perf_counter() - start)) + result.times

    @property
    def is_cancelled(self) -> bool:
        """Whether the client has gone."""
        return self.done.done()

    def give_up(self) -> None:
        """Do nothing: a job is cancelled only when its client has gone."""

    def finish(self, result: Result) -> None:
        """Set the result, unless the job was cancelled."""
        with suppress(InvalidStateError):
            self.done.set_result(result)

    def fail(self, message: str) -> None:
        """Set a RenderError, unless the job was cancelled."""
        with suppress(InvalidStateError):
            self.done.set_exception(RenderError(message))


class ImageJob(RenderJob[tuple[bytes, RenderResult]]):
    """One image at full quality, as JPEG."""

    def __init__(self, asked: ImageQuery) -> None:
        super().__init__()
        self._asked = asked

    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The view; None while its frame is being read."""
        if self.done.done() or playback.span.end <= playback.span.first:
            return None
        asked = self._asked
        index = int(playback.span.clamp(playback.edge if asked.time == "live" else asked.time))
        if playback.read(index) is None:
            return None
        pose = Camera(
            azimuth=asked.azimuth, elevation=asked.elevation, distance=asked.distance, fov_y=asked.fov_y
        )
        request = request_view(asked, pose, index, playback.home)
        return replace(request, without=asked.left_out, truth=asked.camera)

    def encode(self, result: RenderResult) -> None:
        """Encode the image."""
        self.finish((to_jpeg(draw_eyes(self._asked, result), self._asked.quality), result))


class PathJob(RenderJob[bytes]):
    """A camera path, encoded view by view as MP4."""

    def __init__(self, path: PathBody) -> None:
        super().__init__()
        self._path = path
        self._times = path.times
        self._frame: MultiViewFrame | None = None
        """The frame of the last view, which is kept because a live rig may drop it before the next view."""
        self._home: object = None
        """The home view of the rig that the frame is from."""
        self._count = 0
        self._mp4 = BytesIO()
        self._video = VideoWriter(self._mp4, path.fps, threads=1)  # encodes on the render thread

    @property
    def progress(self) -> tuple[int, int]:
        """Number of views that were rendered, and of all views."""
        return self._count, len(self._path.poses)

    def next_request(self, now: float, playback: PlaybackState) -> RenderRequest | None:
        """The view of the next pose; None while its frame is being read. RenderError if a live rig has dropped it."""
        if self.done.done() or playback.span.end <= playback.span.first:
            return None
        if self._times is None:  # the edge at the start of the job
            self._times = (int(playback.span.clamp(playback.edge)),) * len(self._path.poses)
        index = min(self._times[self._count], playback.span.newest)
        if playback.home is not self._home:  # after a new start, frames of the rig before do not fit
            self._home = playback.home
            self._frame = None
        if self._frame is None or self._frame.time != index:
            if index < playback.span.first:
                raise RenderError(
                    f"frame {index} is no longer in memory; export fewer, or use more --memory-mb"
                )
            self._frame = playback.read(index)
        if self._frame is None:
            return None
        path = self._path
        request = request_view(path, path.poses[self._count], index, playback.home, path.stereo_m)
        return replace(request, without=path.without, frame=self._frame)

    def encode(self, result: RenderResult) -> None:
        """Encode one more view; the last one ends the job."""
        self.viewer: State | None = result.viewer
        self._video.add(draw_eyes(self._path, result))
        self._count += 1
        if self._count == len(self._path.poses):
            self._video.close()
            self.finish(self._mp4.getvalue())


def request_view(
    asked: ViewOptions,
    pose: Camera,
    index: int,
    home: HomeView,
    stereo_m: float | None = None,
) -> RenderRequest:
    """The request for a view of the frame `index`."""
    camera = view_camera(pose, home, (asked.width, asked.height))
    eyes = (camera,) if stereo_m is None else stereo_pair(camera, stereo_m, home.center)
    quality = RenderQuality(mend=asked.mode in protocol.COMPLETED_MODES | {"error"}, top_k=asked.top_k)
    return RenderRequest(
        index, eyes, quality, asked.error_rule, protocol.EXTRA_MODES & {asked.mode}, model=asked.model
    )


def draw_eyes(asked: ViewOptions, result: RenderResult) -> Image:
    """The images of all eyes side by side."""
    background = asked.background or result.background
    return np.hstack([draw_mode(view, asked.mode, background, extra) for view, extra in result.eyes])


def source_jpeg(frame: MultiViewFrame, name: str) -> bytes:
    """A camera's undistorted image as JPEG; ProtocolError if the frame has no such camera."""
    if name not in frame.cameras.names:
        raise ProtocolError(
            f"expected a camera of this frame, one of {', '.join(frame.cameras.names)[:200]}, got '{name[:40]}'"
        )
    image = frame.select([name]).rgb[0]
    return to_jpeg(image.movedim(0, -1).contiguous().cpu().numpy(), SOURCE_QUALITY)
