"""Images of a camera's address, by PyAV, and when they were taken."""

import time
from bisect import bisect_left
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.data.errors import CaptureError
from viewmend.data.video_clock import Track, match_tracks
from viewmend.data.videos import decode, video_properties

WINDOW_S = 10.0
"""The least delayed packet of this time sets the sender's clock; clocks drift by less than 1 ms in it."""
JUMP_S = 1.0
"""A sender has restarted if its timestamps jump by this much more or less than the elapsed time."""


class SenderClock:
    """Estimates the offset of a sender's clock from the arrival of its packets.

    Networks only delay, so the least delayed packet of the last seconds is the best estimate.
    """

    def __init__(self) -> None:
        self._offsets: deque[tuple[float, float]] = deque()
        """When a packet arrived, and how much later than its timestamp; both increase."""
        self._last: tuple[float, float] | None = None

    def saw(self, sent_s: float, arrived_s: float) -> None:
        """Take in a packet that has just arrived, without waiting in a queue here."""
        if self._last is not None:
            step_s, passed_s = sent_s - self._last[0], arrived_s - self._last[1]
            if step_s < -JUMP_S or step_s > passed_s + JUMP_S:
                self._offsets.clear()
        self._last = sent_s, arrived_s
        offset_s = arrived_s - sent_s
        while self._offsets and self._offsets[-1][1] >= offset_s:
            self._offsets.pop()
        self._offsets.append((arrived_s, offset_s))
        while self._offsets[0][0] < arrived_s - WINDOW_S:
            self._offsets.popleft()

    def here_s(self, sent_s: float) -> float | None:
        """A sender's time on this machine's clock; None before the first packet."""
        return sent_s + self._offsets[0][1] if self._offsets else None


if TYPE_CHECKING:
    from av import Packet, VideoFrame
    from av.container import InputContainer

OPEN_S, SILENT_S = 5.0, 1.0
"""Seconds after which a silent address is reopened."""
WAITED_S = 0.002
"""A packet for which the reader waited at least this long was not in a queue."""
TORN_S = 2.0
"""Images after a damaged one are dropped until the next key frame, but no longer than this."""
LAG = {"rtsp": 1, "rtp": 1, "mpegts": 2}
"""By how many packets FFmpeg delays, by format: parsers detect an image's end by the start of the next."""
UNTIMED = ("mjpeg", "mpjpeg", "h264", "hevc", "rawvideo", "image2pipe", "jpeg_pipe")
"""FFmpeg's formats without meaningful timestamps."""
FOR_ALL = {"probesize": "500000", "analyzeduration": "500000", "fpsprobesize": "0"}
BY_SCHEME = {"udp": {"overrun_nonfatal": "1"}, "rtsp": {"rtsp_transport": "tcp"}, "rtsps": {"rtsp_transport": "tcp"}}
"""FFmpeg's options: short probing before the first image; losses do not end the stream."""


@dataclass(frozen=True)
class Picture:
    """A decoded picture, not yet converted."""

    frame: "VideoFrame"
    taken_s: float
    """When it was taken, on this machine's monotonic clock."""


class Playback:
    """Position of recordings that are played in a loop as if live; all of a rig have the same."""

    def __init__(self, length_s: float = 1.0) -> None:
        self.start_s = time.monotonic()
        self.length_s = length_s
        """Where all of them start again: the end of the shortest."""
        self.shifts_s: dict[str, float] = {}
        """What is added to the times in each recording, so that the first of all starts at 0; else each does."""

    def follow(self, tracks: Sequence[Track]) -> None:
        """Play these recordings by their own times.

        Raises:
            ValueError: no two of them show the same time.
        """
        matched = match_tracks(tracks).tracks
        first_s = min(float(track.times_s[0]) for track in matched)
        ends_s = [float(track.times_s[-1]) + 1 / (track.fps or 1.0) for track in matched]
        self.length_s = min(ends_s) - first_s
        self.shifts_s = {
            track.camera: float(moved.times_s[0] - track.times_s[0]) - first_s
            for track, moved in zip(tracks, matched, strict=True)
        }

    def lap(self, now_s: float) -> tuple[float, float]:
        """When the current lap began, and the position in it."""
        passed_s = now_s - self.start_s
        position_s = passed_s % self.length_s
        return self.start_s + passed_s - position_s, position_s


def pictures_of(camera: LiveCamera, counts: "Counter[str]", playback: Playback, wait: Callable[[float], bool]) -> Any:
    """Generate the images of a camera from now on, until it fails; close the generator after use.

    Damaged ("torn") and "duplicated" images are counted in `counts`. `wait(seconds)` is True once none are wanted.

    Raises:
        OSError: it cannot be opened, ends, or is silent.
    """
    return _played(camera, playback, wait) if camera.is_file else _received(camera, counts)


def _received(camera: LiveCamera, counts: "Counter[str]") -> Iterator[Picture]:
    import av

    with closing(_opened(camera)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        stamps, whole = _stamps(camera, container), _Whole(counts)
        packets = container.demux(stream)
        while True:
            asked_s = time.monotonic()
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                raise OSError(_said(error)) from None
            if packet is None or packet.size == 0:
                raise OSError("the stream has ended")
            arrived_s = time.monotonic()
            stamps.saw(packet, arrived_s, arrived_s - asked_s > WAITED_S)
            try:
                frames = packet.decode()
            except av.InvalidDataError:
                whole.torn(arrived_s)
                continue
            for frame in frames:
                if whole.is_good(frame, packet.is_corrupt, arrived_s) and stamps.is_new(frame, counts):
                    taken_s = stamps.taken_s(frame, arrived_s)
                    if taken_s is not None:
                        yield Picture(frame, taken_s - camera.offset_s)


def _played(camera: LiveCamera, playback: Playback, wait: Callable[[float], bool]) -> Iterator[Picture]:
    """A recording's images when they are due; overdue ones are skipped."""
    try:
        video = video_properties(Path(camera.url))
    except CaptureError as error:
        raise OSError(str(error)) from None
    shift_s = playback.shifts_s.get(camera.name, -video.times_s[0])
    times_s = [time_s + shift_s for time_s in video.times_s]
    lap_s, position_s = playback.lap(time.monotonic())
    while True:
        for index, frame in decode(video, bisect_left(times_s, position_s - 1e-6), threads=1):
            due_s = lap_s + times_s[index]
            if times_s[index] >= playback.length_s - 1e-6:
                break
            if due_s < time.monotonic() - SILENT_S / 10:
                continue
            if wait(due_s - time.monotonic()):
                return
            yield Picture(frame, due_s - camera.offset_s)
        lap_s, position_s = max(lap_s + playback.length_s, playback.lap(time.monotonic())[0]), 0.0
        if wait(lap_s - time.monotonic()):
            return


def _opened(camera: LiveCamera) -> "InputContainer":
    """Open the camera's address.

    Raises:
        OSError: it does not answer, or has no video.
    """
    import av

    options = FOR_ALL | BY_SCHEME.get(camera.url.partition("://")[0], {}) | dict(camera.options)
    try:
        container = av.open(camera.url, format=camera.format, options=options, timeout=(OPEN_S, SILENT_S))
    except (av.FFmpegError, ValueError) as error:
        raise OSError(_said(error)) from None
    if not container.streams.video:
        container.close()
        raise OSError("expected a video, got none there")
    return container


def _said(error: Exception) -> str:
    """FFmpeg's message, without numbers and addresses, which may hold a password."""
    import av

    if isinstance(error, av.ExitError):
        return "it is silent"
    return getattr(error, "strerror", None) or str(error).partition(":")[0]


class _Stamps:
    """When images were taken: here, when their packets arrived."""

    def __init__(self) -> None:
        self._last: int | None = None

    def saw(self, packet: "Packet", arrived_s: float, waited: bool) -> None:
        """Take in a packet that has arrived."""

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """When an image was taken; None if unknown."""
        return arrived_s

    def is_new(self, frame: "VideoFrame", counts: "Counter[str]") -> bool:
        """Whether the image has another timestamp than the last one."""
        again = frame.pts is not None and frame.pts == self._last
        self._last = frame.pts
        counts["duplicated"] += again
        return not again


class _SenderStamps(_Stamps):
    """The sender's timestamps, on this machine's clock."""

    def __init__(self, lag: int = 0) -> None:
        super().__init__()
        self._clock = SenderClock()
        self._came_s: deque[float | None] = deque(maxlen=lag + 1)
        """Arrival of the packets that FFmpeg still delays; None if unknown."""

    def saw(self, packet: "Packet", arrived_s: float, waited: bool) -> None:
        self._came_s.append(arrived_s if waited else None)
        came_s = self._came_s[0] if len(self._came_s) == self._came_s.maxlen else None
        if came_s is not None and packet.dts is not None and packet.time_base is not None:
            self._clock.saw(float(packet.dts * packet.time_base), came_s)

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        return None if frame.time is None else self._clock.here_s(frame.time)


class _KernelStamps(_SenderStamps):
    """The kernel's timestamps, which are on a clock of this machine if the driver is correct."""

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        for off_s in (0.0, time.time() - time.monotonic()):
            if frame.time is not None and 0 <= arrived_s - (frame.time - off_s) < SILENT_S:
                return frame.time - off_s
        return super().taken_s(frame, arrived_s)


def _stamps(camera: LiveCamera, container: "InputContainer") -> _Stamps:
    names = container.format.name.split(",")
    if camera.clock == "arrival" or (camera.clock == "auto" and set(names) & set(UNTIMED)):
        return _Stamps()
    if camera.clock == "auto" and "v4l2" in names:
        return _KernelStamps()
    return _SenderStamps(max(LAG.get(name, 0) for name in names))


class _Whole:
    """Detects damaged images, and those that depend on damaged ones."""

    def __init__(self, counts: "Counter[str]") -> None:
        self._counts = counts
        self._begun = False
        self._torn_s: float | None = None

    def torn(self, now_s: float) -> None:
        """An image is damaged. Those before the first whole one are not counted: streams are joined in the middle."""
        self._counts["torn"] += self._begun
        self._torn_s = now_s

    def is_good(self, frame: "VideoFrame", damaged: bool, now_s: float) -> bool:
        """Whether this image can be used."""
        if frame.is_corrupt or damaged:
            self.torn(now_s)
            return False
        if self._torn_s is not None and not frame.key_frame and now_s < self._torn_s + TORN_S:
            self._counts["torn"] += self._begun
            return False
        self._begun, self._torn_s = True, None
        return True
