"""Training pairs of the leave-one-out data set, by the stream that everybody drives (section 8)."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.baselines.classical import Unfilled
from viewmend.geometry.hull import HullConfig
from viewmend.inpainting.correspondences import Correspondences
from viewmend.leave_one_out.scenes import LeaveOneOut
from viewmend.observation import Observation
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.training.encoded import EncodedContext
from viewmend.views import ContextViews, IncompleteView


@dataclass(frozen=True)
class Sample:
    """A rendered view, what the cameras saw, and what a camera that was left out saw in its place (F*)."""

    view: IncompleteView
    context: tuple[ContextViews, ...]
    """The source views, one element a time, the view's own time first."""
    ray_views: ContextViews | None
    """What the cameras near the view, the chosen ones first, saw at its time: for an inpainter that reads rays."""
    truth: UInt8[Tensor, "3 height width"]
    """F*, background black."""
    previous: "Sample | None" = None
    """The same camera one frame before, for losses over time."""
    alpha: UInt8[Tensor, "height width"] | None = None
    """How much of each pixel the subject truly covers, in 255ths; None where nobody knows."""
    depth: Float[Tensor, "height width"] | None = None
    """True z-depth, metres, 0 where there is no surface; None where nobody knows."""
    matches: Correspondences | None = None
    """Where the context truly shows what the view misses; None where nobody knows."""

    encoded: EncodedContext | None = None
    """The context as an encoder made it, instead of `context`; None where the images are there."""

    @property
    def clip(self) -> tuple["Sample", ...]:
        """This sample after those before it, the oldest first."""
        return (self,) if self.previous is None else (*self.previous.clip, self)

    def to(self, device: torch.device | str) -> "Sample":
        """The same sample on `device`."""
        return to_device(self, device)


def to_device(value: Any, device: torch.device | str) -> Any:
    """The tensor, or the tuple or dataclass with all of its tensors, on `device`; anything else as it is."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple):
        return tuple(to_device(item, device) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: to_device(getattr(value, f.name), device) for f in fields(value)})
    return value


class HeldOutCamera:
    """One camera of a rig left out, and the stream of what the others see; hulls are carved once a time."""

    def __init__(
        self, rig: LeaveOneOut, held: str, hull: HullConfig, dropped: Mapping[int, Collection[str]] | None = None
    ) -> None:
        """`dropped` are names of cameras without a frame at a time."""
        self.rig = rig
        self.held = held
        self.dropped = dropped or {}
        self.stream = Stream(Unfilled(), StreamConfig(hull=hull, memory_mb=None), rig.bounds)

    def observation(self, time: int) -> Observation:
        """What the others saw at a time, and the hull that they carve."""
        return self.stream.push(self.rig.inputs(self.held, time, self.dropped.get(time, ())))

    def sample(
        self,
        time: int,
        times: Sequence[int],
        render: RenderConfig,
        min_hole_px: int,
        cameras: tuple[int, int] = (0, 0),
        widened_px: int = 0,
    ) -> Sample | None:
        """The pair at `time` with context from these `times`, its own first; None if fewer pixels are missing.

        cameras: how many are context at least, and how many `ray_views`.
        widened_px: by how much its holes are larger than what the source views do not see.
        """
        now = self.observation(time)
        target = self.rig.calibration(self.held, time).select([self.held])
        view = self.stream.rendered_by(render).render(target, time)
        if float(view.error.sum()) < min_hole_px:
            return None
        view = widened(view, widened_px)
        wanted = view.closest_views(max(len(view.source_views), cameras[0]))
        context = [self.observation(tau).context(wanted) for tau in times]
        ray_views, truth = now.context(view.closest_views(cameras[1])), self.rig.truth(self.held, time)
        assert truth.mask is not None, "what trains has masks"
        black = truth.rgb[0].float() * (truth.mask[0].float() / 255)
        seen = tuple(c for c in context if c is not None)
        matches = None
        if self.rig.correspondences is not None and times:
            matches = self.rig.correspondences(self.held, times, wanted, view.error > 0)
        return Sample(view, seen, ray_views, black.round().to(torch.uint8), alpha=truth.mask[0], matches=matches)


def widened(view: IncompleteView, reach_px: int) -> IncompleteView:
    """The view with everything on the subject missing that is at most so far, along rows and columns, from a hole."""
    if not reach_px:
        return view
    near = F.max_pool2d((view.error[None, None] > 0).float(), 2 * reach_px + 1, 1, reach_px)[0, 0] > 0
    missing = near & (view.mask > 0)
    kept = ~missing
    return replace(view, rgb=view.rgb * kept, error=view.error.masked_fill(missing, 1.0), weights=view.weights * kept)
