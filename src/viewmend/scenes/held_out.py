"""The leave-one-out data set: what a rig without one of its cameras saw, and what that camera saw."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.scenes.true_visibility import SurfaceSeen
from viewmend.types import MultiViewFrame, Silhouettes

Split = Literal["training", "validation", "test"]

Protocol = Literal["strict", "predicted-mask", "target-mask", "hull-with-target-mask"]
"""What is known of the held-out camera: nothing; nothing, but M_t of the view is predicted
(`MaskPredictor`); its mask, as M_t; or its mask, which carves the hull."""

PROCEDURAL_SEEDS: Mapping[Split, range] = {
    "training": range(9000),
    "validation": range(9000, 10000),
    "test": range(10000, 2**31),
}
"""Seeds of the studio's scenes and procedural people. No seed is in two splits."""
TEST_FOLDER = "test"
"""Characters, motions and captures in a folder of this name are kept for tests."""


def recordings(split: Split, places: Sequence[Path]) -> tuple[Path, ...]:
    """Folders or files of characters, motions or captures, as this split may use them.

    Validation uses none: its procedural people are new to every model. `viewmend evaluate` measures
    what a model gains on recordings that were kept for tests. ValueError if training or validation
    would look at what is kept for tests.
    """
    kept = [place for place in places if TEST_FOLDER in (place.resolve().name, place.resolve().parent.name)]
    if kept and split != "test":
        expected = "people, motions and captures that are not kept for tests"
        got = f"a folder named '{TEST_FOLDER}'"
        raise ValueError(f"{kept[0]}: expected {expected}, got {got}; give the one for training")
    return () if split == "validation" else tuple(places)


def reveal(
    protocol: Protocol, truth: MultiViewFrame | None
) -> tuple[Float[Tensor, "height width"] | None, Silhouettes | None]:
    """What a protocol reveals of the held-out camera (one view): M_t, and a silhouette that carves the hull."""
    if protocol in ("strict", "predicted-mask") or truth is None:
        return None, None
    assert truth.mask is not None, "held-out cameras have masks"
    if protocol == "target-mask":
        return truth.mask[0].float() / 255, None
    return None, Silhouettes(truth.mask, truth.cameras)


@dataclass(frozen=True)
class LeaveOneOutFrame:
    """One time of a rig, one of whose cameras is left out."""

    inputs: MultiViewFrame
    """What the rig saw, without the camera that was left out, and without true depth."""
    truth: MultiViewFrame
    """What that camera saw (one view), with its mask."""
    bounds: Bounds | None
    """The volume that may hold the subject, None to find it."""
    carving: Silhouettes | None = None
    """Masks of more cameras of the rig, which carve the hull, and whose images are not drawn."""
    backward_flow_px: Float[Tensor, "height width 2"] | None = None
    """Where in the previous true image each pixel's surface point was (`backward_flow`); None if unknown."""
    seen: SurfaceSeen | None = None
    """Which input cameras see, now and in the frames of the window, the surface in each pixel; None
    if unknown."""


@dataclass(frozen=True)
class LeaveOneOut:
    """Some times of a rig, each of whose cameras can be left out."""

    frames: Mapping[int, MultiViewFrame]
    """What all cameras saw, by time."""
    bounds: Bounds | None = None
    """The volume that may hold the subject, None to find it."""
    cameras: Callable[[str], Cameras] | None = None
    """cameras(held): the rig's calibration as it is known without that camera's image; None where
    it is the frames'."""
    true_view: Callable[[str, int], MultiViewFrame] | None = None
    """true_view(held, time): what that camera should have seen; None where its own image is the truth."""

    def frame(self, held: str, time: int) -> LeaveOneOutFrame:
        """One time without a camera, and its truth."""
        return LeaveOneOutFrame(self.inputs(held, time), self.truth(held, time), self.bounds)

    def inputs(self, held: str, time: int) -> MultiViewFrame:
        """The images of the other cameras, without true depth."""
        frame = replace(self.frames[time], depth=None).without((held,))
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
    """Which cameras look, for reports."""
    style: str
    """What happens, for reports."""
    held: str
    """The camera that is left out."""
    scored_from: int = 0
    """First frame that is scored; earlier ones are context only."""

    @property
    @abstractmethod
    def definition(self) -> str:
        """All that its frames depend on, in words that are the same on every machine."""

    @abstractmethod
    def frames(self) -> Iterator[LeaveOneOutFrame]:
        """The scene's frames in order of time."""
