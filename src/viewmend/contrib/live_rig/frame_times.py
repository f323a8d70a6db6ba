"""When a stream's images were taken, from its timestamps or from the arrival of its packets."""

import time
from collections import Counter, deque
from typing import TYPE_CHECKING

from viewmend.contrib.live_rig.rig_file import LiveCamera
from viewmend.contrib.live_rig.sender_clock import SenderClock
from viewmend.data.videos import WITHOUT_TIMES

if TYPE_CHECKING:
    from av import Packet, VideoFrame
    from av.container import InputContainer

MAX_DRIVER_DELAY_S = 1.0
"""A driver's timestamp is on a clock of this machine if it lies at most this many seconds before
the arrival."""
LAG_PACKETS = {"rtsp": 1, "rtp": 1, "mpegts": 2}
"""FFmpeg delays images by these numbers of packets: its parsers detect an image's end by the next
one's start."""
UNTIMED_FORMATS = WITHOUT_TIMES | {"mpjpeg", "rawvideo", "image2pipe", "jpeg_pipe"}
"""These formats of FFmpeg have no meaningful timestamps."""


class ArrivalTimes:
    """Images are taken when their packets arrive."""

    def __init__(self) -> None:
        self._last_pts: int | None = None

    def add_packet(self, packet: "Packet", arrived_s: float, waited: bool) -> None:
        """Note that a packet has arrived; `waited` is whether the reader waited for it."""

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """When an image was taken; None if unknown."""
        return arrived_s

    def is_new(self, frame: "VideoFrame", counts: "Counter[str]") -> bool:
        """Whether the image has another timestamp than the last one."""
        is_repeated = frame.pts is not None and frame.pts == self._last_pts
        self._last_pts = frame.pts
        counts["duplicated"] += is_repeated
        return not is_repeated


class SenderTimes(ArrivalTimes):
    """The sender's timestamps, on this machine's clock."""

    def __init__(self, lag_packets: int = 0) -> None:
        super().__init__()
        self._clock = SenderClock()
        self._arrivals_s: deque[float | None] = deque(maxlen=lag_packets + 1)
        """When the reader received the last packets; None for one that was in a queue. FFmpeg lags
        `lag_packets` behind, so the newest packet's data arrived at the first of these times."""

    def add_packet(self, packet: "Packet", arrived_s: float, waited: bool) -> None:
        """See `ArrivalTimes.add_packet`."""
        self._arrivals_s.append(arrived_s if waited else None)
        if len(self._arrivals_s) < (self._arrivals_s.maxlen or 0):
            return
        data_arrived_s = self._arrivals_s[0]
        if data_arrived_s is not None and packet.dts is not None and packet.time_base is not None:
            self._clock.add_packet(float(packet.dts * packet.time_base), data_arrived_s)

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """See `ArrivalTimes.taken_s`."""
        return None if frame.time is None else self._clock.to_local_s(frame.time)


class DriverTimes(SenderTimes):
    """The kernel's timestamps, which are on one of this machine's clocks if the driver is correct."""

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """See `ArrivalTimes.taken_s`."""
        monotonic_offset_s = 0.0
        wall_offset_s = time.time() - time.monotonic()
        for offset_s in (monotonic_offset_s, wall_offset_s):
            if frame.time is not None and 0 <= arrived_s - (frame.time - offset_s) < MAX_DRIVER_DELAY_S:
                return frame.time - offset_s
        return super().taken_s(frame, arrived_s)


def frame_times(camera: LiveCamera, container: "InputContainer") -> ArrivalTimes:
    """The times of a camera's images, by its setting `clock` and the stream's format."""
    formats = container.format.name.split(",")
    if camera.clock == "arrival" or (camera.clock == "auto" and set(formats) & UNTIMED_FORMATS):
        return ArrivalTimes()
    if camera.clock == "auto" and "v4l2" in formats:
        return DriverTimes()
    return SenderTimes(max(LAG_PACKETS.get(name, 0) for name in formats))
