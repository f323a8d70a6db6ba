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
"""A driver's timestamp is taken to be on one of this machine's clocks if, on that clock, it is less than this
many seconds before the image's arrival."""
LAG_PACKETS = {"rtsp": 1, "rtp": 1, "mpegts": 2}
"""How many packets FFmpeg's output lags behind its input, by format: its parsers find the end of an image only
at the start of the next one."""
UNTIMED_FORMATS = WITHOUT_TIMES | {"mpjpeg", "rawvideo", "image2pipe", "jpeg_pipe"}
"""These formats of FFmpeg have no meaningful timestamps."""


class ImageTimes:
    """When images were taken. In this base class, that is when their packets arrive."""

    def __init__(self) -> None:
        self._last_pts: int | None = None
        """The timestamp of the last image."""

    def add_packet(self, packet: "Packet", arrived_s: float, waited: bool) -> None:
        """Note that the reader has received a packet; `waited` is whether it had to wait for it.

        A packet that was not waited for may have been in a queue, so its arrival time means little. The
        base class needs no packets; `SenderTimes` overrides this.
        """

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """When an image was taken, on this machine's monotonic clock; None if unknown."""
        return arrived_s

    def is_new(self, frame: "VideoFrame", counts: "Counter[str]") -> bool:
        """Whether the image's timestamp differs from the previous one; counts a "duplicated" image if not."""
        is_repeated = frame.pts is not None and frame.pts == self._last_pts
        self._last_pts = frame.pts
        if is_repeated:
            counts["duplicated"] += 1
        return not is_repeated


class SenderTimes(ImageTimes):
    """The sender's timestamps, converted to this machine's clock."""

    def __init__(self, lag_packets: int = 0) -> None:
        """Set up; FFmpeg returns each packet only after it has received `lag_packets` more."""
        super().__init__()
        self._clock = SenderClock()
        self._lag_packets = lag_packets
        self._arrivals_s: deque[float | None] = deque(maxlen=lag_packets + 1)
        """When FFmpeg returned the last `lag_packets + 1` packets, the oldest first; None for those that the reader
        did not wait for. FFmpeg returns packet n when the data of packet n + `lag_packets` arrive. So the data of the
        packet that was returned last arrived when the first of these packets was returned."""

    def add_packet(self, packet: "Packet", arrived_s: float, waited: bool) -> None:
        """See `ImageTimes.add_packet`."""
        self._arrivals_s.append(arrived_s if waited else None)
        if len(self._arrivals_s) <= self._lag_packets:
            return
        data_arrived_s = self._arrivals_s[0]
        if data_arrived_s is not None and packet.dts is not None and packet.time_base is not None:
            self._clock.add_packet(float(packet.dts * packet.time_base), data_arrived_s)

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """See `ImageTimes.taken_s`."""
        return None if frame.time is None else self._clock.to_local_s(frame.time)


class DriverTimes(SenderTimes):
    """The kernel's timestamps, which are on one of this machine's clocks if the driver is correct."""

    def taken_s(self, frame: "VideoFrame", arrived_s: float) -> float | None:
        """See `ImageTimes.taken_s`; times on an unknown clock are converted like a sender's."""
        if frame.time is not None:
            from_monotonic_s = frame.time
            from_wall_clock_s = frame.time - (time.time() - time.monotonic())
            for taken_s in (from_monotonic_s, from_wall_clock_s):
                if 0 <= arrived_s - taken_s < MAX_DRIVER_DELAY_S:
                    return taken_s
        return super().taken_s(frame, arrived_s)


def frame_times(camera: LiveCamera, container: "InputContainer") -> ImageTimes:
    """Choose how to time a camera's images, by its setting `clock` and the stream's format."""
    formats = container.format.name.split(",")
    if camera.clock == "arrival" or (camera.clock == "auto" and set(formats) & UNTIMED_FORMATS):
        return ImageTimes()
    if camera.clock == "auto" and "v4l2" in formats:
        return DriverTimes()
    return SenderTimes(max(LAG_PACKETS.get(name, 0) for name in formats))
