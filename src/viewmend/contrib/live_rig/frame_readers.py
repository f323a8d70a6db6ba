"""Reads a camera's images with PyAV, from a live stream or from a recording that is played as if live."""

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import UInt8

from viewmend.contrib.live_rig.frame_times import frame_times
from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.data.errors import CaptureError
from viewmend.data.video_clock import Track, match_tracks, own_fps
from viewmend.data.videos import (
    VideoProperties,
    decode,
    first_field_alone,
    first_field_of,
    to_rgb,
    video_properties,
)

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

OPEN_S = 5.0
"""An address that does not answer within this many seconds is tried again, unless `SILENT_TICKS` are longer."""
SILENT_S = 1.0
"""A stream that sends nothing for this many seconds is opened again, unless `SILENT_TICKS` are longer."""
SILENT_TICKS = 2.5
"""A stream that sends one image per tick is never silent for this many ticks."""
LATE_S = 0.1
"""Images of a recording that are overdue by this many seconds are skipped."""
MIN_WAIT_S = 0.002
"""If the reader waited for a packet for more than this many seconds, the packet has just arrived;
otherwise it may have been in a queue."""
DAMAGED_S = 2.0
"""Images that follow a damaged one are dropped until the next key frame, for at most this many seconds."""
ROUNDING_S = 1e-6
"""Times of a recording that differ by less than this many seconds are the same."""
FFMPEG_OPTIONS = {"probesize": "500000", "analyzeduration": "500000", "fpsprobesize": "0"}
"""FFmpeg's options for all addresses: little of a stream is analysed, so that the first image comes soon."""
SCHEME_OPTIONS = {
    "udp": {"overrun_nonfatal": "1"},
    "rtsp": {"rtsp_transport": "tcp"},
    "rtsps": {"rtsp_transport": "tcp"},
}
"""More options by scheme: RTSP over TCP loses no packets; with UDP, overruns do not end the stream."""


@dataclass(frozen=True)
class DecodedImage:
    """A camera's image as FFmpeg's frame, not yet converted to RGB."""

    frame: "VideoFrame"
    taken_s: float
    """When it was taken, on this machine's monotonic clock."""
    first_field: str = "auto"
    """Which field is shown first if the frame is interlaced; see `VideoProperties.first_field`. It stays
    "auto" for recordings, because `decode` de-interlaces interlaced videos."""

    def to_rgb(self, size_px: tuple[int, int] | None = None) -> UInt8[np.ndarray, "height width 3"]:
        """The image, or its first field if it is interlaced, as upright sRGB at its own or another size."""
        return to_rgb(first_field_alone(self.frame, self.first_field), size_px)


class Timing(NamedTuple):
    """How one recording is played on the timeline."""

    lap_s: float
    """Length of a lap (`Playback.length_s`)."""
    shift_s: float
    """Seconds to add to the recording's times, which gives times on the timeline."""


class Playback:
    """The common timeline on which recordings are played in a loop, as if they were live."""

    def __init__(self, length_s: float = 1.0) -> None:
        self.start_s = time.monotonic()
        self.length_s = length_s
        """The length of a lap, that is, one pass through the recordings: as soon as one of them ends, all start
        again."""
        self.shifts_s: dict[str, float] = {}
        """Seconds to add to the times of each recording, which gives times on the timeline. The timeline starts
        at the earliest image of all recordings. A recording without a shift here starts at 0."""

    def synchronise(self, tracks: Sequence[Track]) -> str | None:
        """Put these recordings on the timeline, by timecodes if they all have matching ones, otherwise by timestamps.

        Returns a note for the user if their timecodes start at different times; None otherwise.

        Raises:
            ValueError: no two of them overlap in time.
        """
        clock = match_tracks(tracks)
        matched = clock.tracks
        first_s = min(float(track.times_s[0]) for track in matched)
        ends_s = [float(track.times_s[-1]) + 1 / own_fps(track) for track in matched]
        shifts_s: dict[str, float] = {}
        for original, shifted in zip(tracks, matched, strict=True):
            shift_s = float(shifted.times_s[0] - original.times_s[0])
            shifts_s[original.camera] = shift_s - first_s

        # Before each image, a reader (on another thread) compares the length and its shift with those that it began
        # with. If either differs, it begins again with the new values, in the lap that all recordings are in
        self.length_s = min(ends_s) - first_s
        self.shifts_s = shifts_s
        return clock.timecode_note

    def timing(self, name: str, first_s: float) -> Timing:
        """How a recording is played now, given the time of its first image."""
        return Timing(self.length_s, self.shifts_s.get(name, -first_s))

    def lap_start_s(self, now_s: float) -> float:
        """When the current lap began."""
        return now_s - (now_s - self.start_s) % self.length_s


def read_images(
    camera: LiveCamera,
    counts: "Counter[str]",
    playback: Playback,
    wait: Callable[[float], bool],
    interval_s: float = 0.0,
) -> Generator[DecodedImage, None, None]:
    """Generate the images of a camera from now on, until it fails. The caller closes the generator.

    Args:
        camera: a live stream or a recording.
        counts: counts a stream's damaged images as "torn", and repeated ones as "duplicated".
        playback: the timeline of recordings.
        wait: waits for some seconds before a recording's next image; returns True to end the recording.
        interval_s: the rig's time between two ticks.

    Raises:
        OSError: the camera cannot be opened; or it is a stream that ends or is silent.
    """
    if camera.is_file:
        return _play_recording(camera, playback, wait)
    return _receive_stream(camera, counts, max(SILENT_S, SILENT_TICKS * interval_s))


def _receive_stream(
    camera: LiveCamera, counts: "Counter[str]", silent_s: float
) -> Generator[DecodedImage, None, None]:
    """A stream's undamaged images as they arrive."""
    import av

    with closing(_open_stream(camera, silent_s)) as container:
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
                damage.note_damaged(arrived_s)
                continue
            is_damaged = packet.is_corrupt
            for frame in frames:
                is_usable = damage.accepts(frame, is_damaged, arrived_s) and times.is_new(frame, counts)
                taken_s = times.taken_s(frame, arrived_s) if is_usable else None
                if taken_s is not None:
                    first_field = first_field_of(stream.codec_context)
                    yield DecodedImage(frame, taken_s - camera.offset_s, first_field)


def _play_recording(
    camera: LiveCamera, playback: Playback, wait: Callable[[float], bool]
) -> Generator[DecodedImage, None, None]:
    """A recording's images when they are due; overdue ones are skipped."""
    try:
        video = video_properties(Path(camera.url))
    except CaptureError as error:
        raise OSError(str(error)) from None
    has_to_end = False
    while not has_to_end:
        has_to_end = yield from _play_laps(camera, video, playback, wait)


def _play_laps(
    camera: LiveCamera, video: VideoProperties, playback: Playback, wait: Callable[[float], bool]
) -> Generator[DecodedImage, None, bool]:
    """A recording's images, lap after lap, until its timing changes. Returns True if `wait` says that it has to end."""
    first_s = video.times_s[0]
    timing = playback.timing(camera.name, first_s)
    times_s = [time_s + timing.shift_s for time_s in video.times_s]

    # The first lap begins where the other recordings are now, later laps at position 0.
    now_s = time.monotonic()
    lap_start_s = playback.lap_start_s(now_s)
    position_s = now_s - lap_start_s
    while True:
        for index, frame in decode(video, bisect_left(times_s, position_s - ROUNDING_S), threads=1):
            if times_s[index] >= timing.lap_s - ROUNDING_S:
                break
            due_s = lap_start_s + times_s[index]
            if due_s < time.monotonic() - LATE_S:
                continue
            if wait(due_s - time.monotonic()):
                return True
            if playback.timing(camera.name, first_s) != timing:
                return False
            yield DecodedImage(frame, due_s - camera.offset_s)

        # Begin the next lap. If this recording has fallen behind, join the lap that the others are in.
        lap_start_s = max(lap_start_s + timing.lap_s, playback.lap_start_s(time.monotonic()))
        position_s = 0.0
        if wait(lap_start_s - time.monotonic()):
            return True
        if playback.timing(camera.name, first_s) != timing:
            return False


def _open_stream(camera: LiveCamera, silent_s: float) -> "InputContainer":
    """Open the camera's address, for a stream that is never silent for this many seconds.

    Raises:
        OSError: it does not answer, or has no video.
    """
    import av

    scheme = camera.url.partition("://")[0]
    options = FFMPEG_OPTIONS | SCHEME_OPTIONS.get(scheme, {}) | dict(camera.options)
    try:
        timeout = (max(OPEN_S, silent_s), silent_s)
        container = av.open(camera.url, format=camera.format, options=options, timeout=timeout)
    except (av.FFmpegError, ValueError) as error:
        raise OSError(_describe(error)) from None
    if not container.streams.video:
        container.close()
        raise OSError("expected a video stream, got none")
    return container


def _describe(error: Exception) -> str:
    """FFmpeg's message, without its error number and the address, which may contain a password."""
    import av

    if isinstance(error, av.ExitError):  # the time limit has passed
        return "it is silent"
    return getattr(error, "strerror", None) or str(error).partition(":")[0]


class DamageFilter:
    """Rejects damaged images, and later ones that may have been predicted from them."""

    def __init__(self, counts: "Counter[str]") -> None:
        self._counts = counts
        self._has_begun = False
        """Whether an image was accepted since the stream was opened."""
        self._damaged_s: float | None = None
        """When the last damaged image arrived; None after an image was accepted."""

    def note_damaged(self, now_s: float) -> None:
        """Note that a damaged image has arrived."""
        self._count_rejected()
        self._damaged_s = now_s

    def accepts(self, frame: "VideoFrame", is_damaged: bool, now_s: float) -> bool:
        """Whether this image can be used; `is_damaged` says whether its packet is damaged."""
        if frame.is_corrupt or is_damaged:
            self.note_damaged(now_s)
            return False
        if self._damaged_s is not None and not frame.key_frame and now_s < self._damaged_s + DAMAGED_S:
            self._count_rejected()
            return False
        self._has_begun = True
        self._damaged_s = None
        return True

    def _count_rejected(self) -> None:
        """Count a rejected image, if one was accepted before: a stream that is joined midway starts with damage."""
        if self._has_begun:
            self._counts["torn"] += 1
