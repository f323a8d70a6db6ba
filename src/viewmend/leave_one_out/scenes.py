"""A rig's frames without one of its cameras, and what that camera saw."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class SceneFrame:
    """One time of a scene."""

    inputs: MultiViewFrame
    """What the rig saw, without the camera that was left out, and without true depth."""
    truth: MultiViewFrame
    """What that camera saw (one view), with its mask."""
    bounds: Bounds | None
    """The volume that may hold the subject, None to find it."""
    backward_flow_px: Float[Tensor, "height width 2"] | None = None
    """Where in the previous true image each pixel's surface point was (`backward_flow`); None where nobody knows."""


@dataclass(frozen=True, kw_only=True)
class LeaveOneOutScene(ABC):
    """A stream with truth. Scenes can be pickled: they hold no frames, only how to get them."""

    name: str
    """Unique among the scenes of an evaluation."""
    set: str
    """The set it belongs to: scores are averaged over it."""
    rig: str
    """Which cameras look, for tables by kind."""
    style: str
    """What happens, for tables by kind."""
    held: str
    """The camera that is left out."""

    @property
    @abstractmethod
    def definition(self) -> str:
        """All that its frames depend on, in words that are the same on every machine."""

    @abstractmethod
    def frames(self, device: str) -> Iterator[SceneFrame]:
        """The scene's frames in order of time, on a device."""


def without_held(
    frame: MultiViewFrame, held: str, inputs: Collection[str] | None = None, dropped: Collection[str] = ()
) -> MultiViewFrame:
    """What may be looked at when a camera is left out: the inputs that are there, without true depth.

    Args:
        frame: what all cameras saw.
        held: the camera that is left out.
        inputs: names of those that may be looked at; None for all others.
        dropped: names of those that have no frame at this time.
    """
    names = frame.cameras.names
    seen = [n for n in names if n != held and n not in dropped and (inputs is None or n in inputs)]
    return replace(frame, depth=None).select(seen)


@dataclass(frozen=True)
class LeaveOneOutFrames:
    """Some times of a rig, each of whose cameras can be left out."""

    frames: Mapping[int, MultiViewFrame]
    """What all cameras saw, by time."""
    bounds: Bounds | None
    """The volume that may hold the subject, None to find it."""
    cameras: Callable[[str], Cameras]
    """cameras(held): the rig's calibration as it is known without that camera's image."""
    true_view: Callable[[str, int], MultiViewFrame] | None = None
    """true_view(held, time): what that camera should have seen; None where its own image is the truth."""

    def inputs(self, held: str, dropped: Mapping[int, Sequence[str]]) -> dict[int, MultiViewFrame]:
        """What the others saw, by time; `dropped` are names of cameras without a frame at a time."""
        return {
            time: self._calibrated(without_held(frame, held, dropped=dropped.get(time, ())), held)
            for time, frame in self.frames.items()
        }

    def truth(self, held: str, time: int) -> MultiViewFrame:
        """What the camera that is left out should see (one view), with its mask."""
        seen = self.frames[time].select([held]) if self.true_view is None else self.true_view(held, time)
        return self._calibrated(seen, held)

    def _calibrated(self, frame: MultiViewFrame, held: str) -> MultiViewFrame:
        return replace(frame, cameras=self.cameras(held).select(frame.cameras.names))
