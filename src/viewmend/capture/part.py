"""A part of a capture: some of its times, its images smaller."""

from dataclasses import dataclass

from viewmend.capture.reduction import resized_frame
from viewmend.capture.source import CaptureSource, OfSource
from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class CapturePart(OfSource):
    """Some times of a source, as a source."""

    source: CaptureSource
    times: range
    """Indices of the source's frames."""
    scale: float = 1.0
    """How the images' sides are scaled, at most 1; below 1 depth is left out."""

    @property
    def cameras(self) -> Cameras:
        """The cameras of the images as they come."""
        return self._scaled(self.source.cameras)

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Ids of the part's frames."""
        return tuple(self.source.frame_ids[time] for time in self.times)

    def read(self, time: int) -> MultiViewFrame:
        """The frame at index `time` of the part.

        Raises:
            CaptureError: the source cannot read it.
            IndexError: `time` is not in the part.
        """
        frame = self.source.read(self.times[time])
        small = resized_frame(frame, self._scaled(frame.cameras))
        return MultiViewFrame(small.cameras, small.rgb, small.mask, time, small.depth)

    def _scaled(self, cameras: Cameras) -> Cameras:
        if self.scale == 1:
            return cameras
        sizes = [[max(1, round(side * self.scale)) for side in size] for size in cameras.size_px.tolist()]
        return concatenate_cameras([cameras[view].resized(*size) for view, size in enumerate(sizes)])
