"""Views that are asked for over plain HTTP: single pictures, and camera paths as videos."""

import io
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass

from viewmend.capture.video_writer import VideoWriter
from viewmend.live.fields import Fields, ProtocolError
from viewmend.live.pictures import picture, to_jpeg
from viewmend.live.poses import view_camera
from viewmend.live.protocol import Camera, Limits, Look, parse_camera, parse_look
from viewmend.live.renderer import RenderRequest, RenderResult
from viewmend.live.sessions import Scene
from viewmend.stream import RenderQuality, Viewer

MOST_POSES = 900
_NUMBERS = ("azimuth", "elevation", "distance", "fov_y")
_WHOLES = ("width", "height", "top_k", "quality")


def parse_query(query: dict[str, str], limits: Limits) -> tuple[Look, int | None]:
    """A picture from a query's words, and its time (None: the edge's).

    Raises:
        ProtocolError: a word is unknown, or a value none that can be.
    """
    known = (*_NUMBERS, *_WHOLES, "mode", "time", "token")
    unknown = [key for key in query if key not in known]
    if unknown:
        raise ProtocolError(f"expected words among {list(known)}, got '{unknown[0][:40]}'")
    at = query.get("time", "live")
    camera = {key: _number(key, query[key]) for key in _NUMBERS if key in query}
    words: dict[str, object] = {key: _number(key, query[key]) for key in _WHOLES if key in query}
    look = parse_look(Fields(words | {"camera": camera, "modes": [query.get("mode", "mended")]}), limits)
    return look, None if at == "live" else Fields({"time": _number("time", at)}).whole("time", 0, 2**53)


def _number(key: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise ProtocolError(f"expected '{key}' as a number, got '{value[:40]}'") from None


class PictureJob:
    """One picture with all that the model can do; `done` gets the JPEG."""

    def __init__(self, look: Look, time: int | None) -> None:
        self.viewer: Viewer | None = None
        self.done: Future[tuple[bytes, RenderResult]] = Future()
        self._look, self._time = look, time

    def due(self, now: float, scene: Scene) -> RenderRequest | None:
        """Once, as soon as its frame is there."""
        at = int(scene.span.clamp(scene.edge if self._time is None else self._time))
        if self.done.done() or scene.span.end <= scene.span.first or not scene.present(at):
            return None
        look = self._look
        cameras = tuple(view_camera(eye, scene.frame, (look.width, look.height)) for eye in look.eyes)
        return RenderRequest(at, cameras, RenderQuality(mend=look.modes == ("mended",), top_k=look.top_k))

    def show(self, ask: RenderRequest, rendered: RenderResult) -> None:
        """Done."""
        image = to_jpeg(picture(rendered.completed[0], self._look.modes[0]), self._look.quality)
        with suppress(InvalidStateError):  # nobody waits any more
            self.done.set_result((image, rendered))

    def fail(self, message: str) -> None:
        """Done, badly."""
        with suppress(InvalidStateError):
            self.done.set_exception(RuntimeError(message))


@dataclass(frozen=True)
class Path:
    """A camera path to be rendered as a video."""

    poses: tuple[Camera, ...]
    times: tuple[int, ...] | None
    fps: float
    look: Look


def parse_path(given: Fields, limits: Limits) -> Path:
    """The body of a request for a video.

    Raises:
        ProtocolError: it is none.
    """
    poses = tuple(parse_camera(Fields(pose)) for pose in given.items("poses", MOST_POSES))
    times = None
    if given.has("times"):
        times = tuple(Fields({"time": t}).whole("time", 0, 2**53) for t in given.items("times", MOST_POSES))
        if len(times) != len(poses):
            raise ProtocolError(f"expected a time for each of {len(poses)} poses, got {len(times)}")
    look = parse_look(Fields({**given.values, "modes": [given.get("mode", "mended")], "camera": None}), limits)
    return Path(poses, times, given.number("fps", 1.0, 120.0, 30.0), look)


class PathJob:
    """A camera path, one view a turn, encoded as it goes; `done` gets the MP4."""

    def __init__(self, path: Path) -> None:
        self.viewer: Viewer | None = None
        self.done: Future[bytes] = Future()
        self._path = path
        self._times = path.times
        self._count = 0
        self._mp4 = io.BytesIO()
        self._video = VideoWriter(self._mp4, path.fps)

    def due(self, now: float, scene: Scene) -> RenderRequest | None:
        """The next pose."""
        if self.done.done() or scene.span.end <= scene.span.first:
            return None
        if self._times is None:
            self._times = (int(scene.span.clamp(scene.edge)),) * len(self._path.poses)
        at = int(scene.span.clamp(self._times[self._count]))
        if not scene.present(at):
            return None
        look = self._path.look
        camera = view_camera(self._path.poses[self._count], scene.frame, (look.width, look.height))
        return RenderRequest(at, (camera,), RenderQuality(mend=look.modes == ("mended",), top_k=look.top_k))

    def show(self, ask: RenderRequest, rendered: RenderResult) -> None:
        """One more picture; the last one ends it."""
        self.viewer = rendered.viewer
        self._video.add(picture(rendered.completed[0], self._path.look.modes[0]))
        self._count += 1
        if self._count == len(self._path.poses):
            self._video.close()
            with suppress(InvalidStateError):
                self.done.set_result(self._mp4.getvalue())

    def fail(self, message: str) -> None:
        """Done, badly."""
        with suppress(InvalidStateError):
            self.done.set_exception(RuntimeError(message))
