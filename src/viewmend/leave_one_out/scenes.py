"""The leave-one-out data set: what a rig without one of its cameras saw, and what that camera saw."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.correspondences import Correspondences
from viewmend.leave_one_out.true_visibility import SurfaceSeen
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class LeaveOneOutFrame:
    """One time of a rig, one of whose cameras is left out."""

    inputs: MultiViewFrame
    """What the rig saw, without the camera that was left out, and without true depth."""
    truth: MultiViewFrame
    """What that camera saw (one view), with its mask."""
    bounds: Bounds | None
    """The volume that may hold the subject, None to find it."""
    backward_flow_px: Float[Tensor, "height width 2"] | None = None
    """Where in the previous true image each pixel's surface point was (`backward_flow`); None where nobody knows."""
    seen: SurfaceSeen | None = None
    """Which of the inputs' cameras saw, now and at the window's times, what each pixel truly shows; None where nobody
    knows."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Some times of a rig, each of whose cameras can be left out."""

    frames: Mapping[int, MultiViewFrame]
    """What all cameras saw, by time."""
    bounds: Bounds | None = None
    """The volume that may hold the subject, None to find it."""
    cameras: Callable[[str], Cameras] | None = None
    """cameras(held): the rig's calibration as it is known without that camera's image; None where it is the frames'."""
    true_view: Callable[[str, int], MultiViewFrame] | None = None
    """true_view(held, time): what that camera should have seen; None where its own image is the truth."""
    correspondences: Callable[[str, Sequence[int], Sequence[str], Bool[Tensor, "_h _w"]], Correspondences] | None = None
    """correspondences(held, times, names, missing): where these cameras truly saw, at these times, what the missing
    pixels of that camera show at the first; None where nobody knows."""

    def frame(self, held: str, time: int) -> LeaveOneOutFrame:
        """One time without a camera, and its truth."""
        return LeaveOneOutFrame(self.inputs(held, time), self.truth(held, time), self.bounds)

    def inputs(self, held: str, time: int, dropped: Collection[str] = ()) -> MultiViewFrame:
        """What the others saw, without true depth; `dropped` are names of cameras that have no frame at that time."""
        frame = replace(self.frames[time], depth=None).without((held, *dropped))
        return replace(frame, cameras=self.calibration(held, time).select(frame.cameras.names))

    def truth(self, held: str, time: int) -> MultiViewFrame:
        """What the camera that is left out should see (one view), with its mask."""
        seen = self.frames[time].select([held]) if self.true_view is None else self.true_view(held, time)
        return replace(seen, cameras=self.calibration(held, time).select([held]))

    def calibration(self, held: str, time: int) -> Cameras:
        """All cameras of that time, as they are known without the image of one."""
        there = self.frames[time].cameras
        return there if self.cameras is None else self.cameras(held).select(there.names)


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
    scored_from: int = 0
    """The first time that is scored; those before are looked at alone."""

    @property
    @abstractmethod
    def definition(self) -> str:
        """All that its frames depend on, in words that are the same on every machine."""

    @abstractmethod
    def frames(self, device: str) -> Iterator[LeaveOneOutFrame]:
        """The scene's frames in order of time, on a device."""
