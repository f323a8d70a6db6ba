"""The protocol that every source of frames obeys."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame


@runtime_checkable
class CaptureSource(Protocol):
    """A calibrated multi-camera capture: a folder, the studio, a live rig."""

    @property
    def name(self) -> str:
        """What messages and titles call it."""
        ...

    @property
    def cameras(self) -> Cameras:
        """All cameras, after undistortion, in metres."""
        ...

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Ids of the frames in order of time; a static capture has one."""
        ...

    @property
    def fps(self) -> float | None:
        """Frames a second, None where unknown or static."""
        ...

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """World up, a default for viewers and orbits only."""
        ...

    @property
    def bounds(self) -> Bounds | None:
        """The volume that may hold the subject, where it is known."""
        ...

    def read(self, time: int) -> MultiViewFrame:
        """All cameras at index `time` of `frame_ids`; a camera without a frame then is absent.

        Raises:
            CaptureError: a file is missing for every camera, unreadable or of the wrong size.
            IndexError: `time` is not in the capture.
        """
        ...


class OfSource:
    """What a capture made from another has from it; whoever changes one of these says so."""

    source: CaptureSource

    @property
    def name(self) -> str:
        """The source's."""
        return self.source.name

    @property
    def cameras(self) -> Cameras:
        """The source's."""
        return self.source.cameras

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """The source's."""
        return self.source.frame_ids

    @property
    def fps(self) -> float | None:
        """The source's."""
        return self.source.fps

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """The source's."""
        return self.source.up

    @property
    def bounds(self) -> Bounds | None:
        """The source's."""
        return self.source.bounds
