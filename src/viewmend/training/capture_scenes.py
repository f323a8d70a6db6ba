"""Real captures as scenes: a camera is left out, and its own image is the truth."""

from collections.abc import Sequence
from dataclasses import replace
from random import Random

from viewmend.capture.prepare import PreparedCapture, prepare
from viewmend.capture.reduction import reduced
from viewmend.capture.source import CaptureSource
from viewmend.geometry.cameras import Cameras
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.training.plan import DataPlan
from viewmend.training.samples import Sample
from viewmend.training.scenes import SceneSource, rig_samples


class CaptureScenes:
    """Moments of captures, reduced to the plan's sizes; each is aligned on the cameras that are not left out."""

    def __init__(
        self,
        captures: Sequence[CaptureSource],
        plan: DataPlan,
        seed: str,
        left_out: Sequence[str | None] | None = None,
    ) -> None:
        """`left_out` names the one camera of each capture that is left out; None where each is, in turn."""
        self.captures = captures
        self.left_out = left_out or [None] * len(captures)
        self.plan = plan
        self.seed = seed
        self._prepared: dict[tuple[int, str], PreparedCapture] = {}

    def scene(self, number: int) -> list[Sample]:
        """One moment of one capture with its past."""
        random = Random(f"{self.seed}/{number}")
        which = random.randrange(len(self.captures))
        capture = self.captures[which]
        last = len(capture.frame_ids) - 1
        first = random.randint(0, max(0, last - max(self.plan.times)))
        size_px = random.choice(self.plan.sizes_px)
        times = sorted({min(first + offset, last) for offset in self.plan.times})
        frames = {time: reduced(capture.read(time), size_px).to(self.plan.data_device) for time in times}
        # A camera that has no image at some of these times cannot be judged then.
        always = [n for n in frames[times[-1]].cameras.names if all(n in f.cameras.names for f in frames.values())]
        frames = {time: frame.select(always) for time, frame in frames.items()}

        def cameras(held: str) -> Cameras:
            if (which, held) not in self._prepared:  # aligned when this camera is first left out
                self._prepared[which, held] = prepare(
                    capture, [n for n in capture.cameras.names if n != held], match_colours=False
                )
            return replace(self._prepared[which, held], longest_px=size_px).cameras.to(self.plan.data_device)

        return rig_samples(LeaveOneOut(frames, capture.bounds, cameras), self.plan, random, self.left_out[which])


class MixedScenes:
    """Two sources, of which `fraction` of the scenes come from the first."""

    def __init__(self, first: SceneSource[Sample], second: SceneSource[Sample], fraction: float, seed: str) -> None:
        self.first = first
        self.second = second
        self.fraction = fraction
        self.seed = seed

    def scene(self, number: int) -> Sequence[Sample]:
        """A scene of either."""
        source = self.first if Random(f"{self.seed}/which/{number}").random() < self.fraction else self.second
        return source.scene(number)
