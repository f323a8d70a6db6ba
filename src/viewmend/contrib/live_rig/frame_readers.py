"""Reads a camera's images with PyAV, from a live stream or from a recording that is played as if live."""

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from viewmend.contrib.live_rig.frame_times import frame_times
from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.data.errors import CaptureError
from viewmend.data.video_clock import Track, match_tracks
from viewmend.data.videos import decode, first_field_alone, first_field_of, to_rgb, video_properties

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

OPEN_S = 5.0
"""An address that does not answer within this many seconds is tried again."""
SILENT_S = 1.0
"""A stream that sends nothing for this many seconds is opened again."""
LATE_S = 0.1
"""Images of a recording that are overdue by this many seconds are skipped."""
MIN_WAIT_S = 0.002
"""If the reader waited longer than this for a packet, in seconds, the packet has just arrived;
otherwise it may have been in a queue."""
DAMAGED_S = 2.0
"""Images after a damaged one are dropped until the next key frame, but no longer than this many seconds."""
FFMPEG_OPTIONS = {"probesize": "500000", "analyzeduration": "500000", "fpsprobesize": "0"}
"""FFmpeg's options for all addresses: it examines little of a stream before the first image."""
SCHEME_OPTIONS = {
    "udp": {"overrun_nonfatal": "1"},
    "rtsp": {"rtsp_transport": "tcp"},
    "rtsps": {"rtsp_transport": "tcp"},
}
"""Additional options for addresses with these schemes: lost packets do not end the stream."""


@dataclass(frozen=True)
class Picture:
    """A decoded image, not yet converted."""

    frame: "VideoFrame"
    taken_s: float
    """When it was taken, on this machine's monotonic clock."""
    first_field: str = "auto"
    """Which field is shown first if the frame is interlaced; see `VideoProperties.first_field`."""

    def to_rgb(self, size_px: tuple[int, int] | None = None) -> UInt8[np.ndarray, "height width 3"]:
        """The image, or its first field if it is interlaced, as upright sRGB at its own or another size."""
        return to_rgb(first_field_alone(self.frame, self.first_field), size_px)


class Playback:
    """The common position of recordings that are played in a loop as if live."""

    def __init__(self, length_s: float = 1.0) -> None:
        self.start_s = time.monotonic()
        self.length_s = length_s
        """The length of a lap, after which all recordings start again: that of the shortest recording."""
        self.shifts_s: dict[str, float] = {}
        """Seconds to add to the times in each camera's recording, so that the earliest image of all is
        at 0. A recording that is not listed is played alone, from its first image."""

    def follow(self, tracks: Sequence[Track]) -> str | None:
        """Play these recordings by their own times. Returns a note if their timecodes give them different starts.

        Raises:
            ValueError: no two of them show the same time.
        """
        clock = match_tracks(tracks)
        matched = clock.tracks
        first_s = min(float(track.times_s[0]) for track in matched)
        ends_s = [float(track.times_s[-1]) + 1 / (track.fps or 1.0) for track in matched]
        self.length_s = min(ends_s) - first_s
        self.shifts_s = {
            track.camera: float(moved.times_s[0] - track.times_s[0]) - first_s
            for track, moved in zip(tracks, matched, strict=True)
        }
        return clock.timecodes

    def lap_start_s(self, now_s: float) -> float:
        """When the current lap began."""
        return now_s - (now_s - self.start_s) % self.length_s


def read_pictures(
    camera: LiveCamera, counts: "Counter[str]", playback: Playback, wait: Callable[[float], bool]
) -> Generator[Picture, None, None]:
    """Generate the images of a camera from now on, until it fails; close the generator after use.

    Damaged ("torn") and "duplicated" images are counted in `counts`. Recordings are paced by
    `wait(seconds)`, which returns True to end them.

    Raises:
        OSError: the camera cannot be opened, its stream ends, or it is silent.
    """
    return _play_recording(camera, playback, wait) if camera.is_file else _receive_stream(camera, counts)


def _receive_stream(camera: LiveCamera, counts: "Counter[str]") -> Generator[Picture, None, None]:
    import av

    with closing(_open_stream(camera)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1
        times = frame_times(camera, container)
        damage = DamageFilter(counts)
        packets = container.demux(stream)
        while True:
            asked_s = time.monotonic()
            try:
                packet = next(packets, None)
            except av.FFmpegError as error:
                raise OSError(_describe(error)) from None
            if packet is None or packet.size == 0:
                raise OSError("the stream has ended")
            arrived_s = time.monotonic()
            times.add_packet(packet, arrived_s, waited=arrived_s - asked_s > MIN_WAIT_S)
            try:
                frames = packet.decode()
            except av.InvalidDataError:
                damage.note(arrived_s)
                continue
            for frame in frames:
                if not damage.accepts(frame, packet.is_corrupt, arrived_s) or not times.is_new(frame, counts):
                    continue
                taken_s = times.taken_s(frame, arrived_s)
                if taken_s is not None:
                    yield Picture(frame, taken_s - camera.offset_s, first_field_of(stream.codec_context))


def _play_recording(
    camera: LiveCamera, playback: Playback, wait: Callable[[float], bool]
) -> Generator[Picture, None, None]:
    """A recording's images when they are due; overdue ones are skipped."""
    try:
        video = video_properties(Path(camera.url))
    except CaptureError as error:
        raise OSError(str(error)) from None
    shift_s = playback.shifts_s.get(camera.name, -video.times_s[0])
    times_s = [time_s + shift_s for time_s in video.times_s]

    # Begin where the other recordings are now, in the middle of a lap
    now_s = time.monotonic()
    lap_s = playback.lap_start_s(now_s)
    position_s = now_s - lap_s
    while True:
        for index, frame in decode(video, bisect_left(times_s, position_s - 1e-6), threads=1):
            due_s = lap_s + times_s[index]
            if times_s[index] >= playback.length_s - 1e-6:
                break
            if due_s < time.monotonic() - LATE_S:
                continue
            if wait(due_s - time.monotonic()):
                return
            yield Picture(frame, due_s - camera.offset_s)
        lap_s = max(lap_s + playback.length_s, playback.lap_start_s(time.monotonic()))
        position_s = 0.0
        if wait(lap_s - time.monotonic()):
            return


def _open_stream(camera: LiveCamera) -> "InputContainer":
    """Open the camera's address.

    Raises:
        OSError: it does not answer, or has no video.
    """
    import av

    scheme = camera.url.partition("://")[0]
    options = FFMPEG_OPTIONS | SCHEME_OPTIONS.get(scheme, {}) | dict(camera.options)
    try:
        container = av.open(camera.url, format=camera.format, options=options, timeout=(OPEN_S, SILENT_S))
    except (av.FFmpegError, ValueError) as error:
        raise OSError(_describe(error)) from None
    if not container.streams.video:
        container.close()
        raise OSError("expected a video, got none there")
    return container


def _describe(error: Exception) -> str:
    """FFmpeg's message, without numbers and addresses, which may hold a password."""
    import av

    if isinstance(error, av.ExitError):
        return "it is silent"
    return getattr(error, "strerror", None) or str(error).partition(":")[0]


class DamageFilter:
    """Rejects damaged images, and those that depend on damaged ones."""

    def __init__(self, counts: "Counter[str]") -> None:
        self._counts = counts
        self._has_begun = False
        """Whether there was an undamaged image."""
        self._damaged_s: float | None = None
        """When the last damaged image arrived; None after an undamaged one."""

    def note(self, now_s: float) -> None:
        """Note a damaged image."""
        self._count()
        self._damaged_s = now_s

    def accepts(self, frame: "VideoFrame", is_damaged: bool, now_s: float) -> bool:
        """Whether this image can be used."""
        if frame.is_corrupt or is_damaged:
            self.note(now_s)
            return False
        if self._damaged_s is not None and not frame.key_frame and now_s < self._damaged_s + DAMAGED_S:
            self._count()
            return False
        self._has_begun = True
        self._damaged_s = None
        return True

    def _count(self) -> None:
        """Count a rejected image, except at the start: a stream that is joined in the middle begins with some."""
        if self._has_begun:
            self._counts["torn"] += 1
