"""Training pairs through the production pipeline: leave a camera out, hull, render, holes (section 8)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.views import ContextViews, IncompleteView, MultiViewFrame


@dataclass(frozen=True)
class Sample:
    """A rendered view, what the cameras saw, and what a camera that was left out saw in its place (F*)."""

    view: IncompleteView
    context: tuple[ContextViews, ...]
    """The source views, one element a time, the view's own time first."""
    nearby: ContextViews | None
    """What the cameras near the view, the chosen ones first, saw at its time: for an inpainter that reads rays."""
    truth: UInt8[Tensor, "3 height width"]
    """F*, background black."""
    previous: "Sample | None" = None
    """The same camera one frame before, for losses over time."""
    alpha: UInt8[Tensor, "height width"] | None = None
    """How much of each pixel the subject truly covers, in 255ths; None where nobody knows."""
    depth: Float[Tensor, "height width"] | None = None
    """True z-depth, metres, 0 where there is no surface; None where nobody knows."""

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


class LeaveOneOut:
    """What a rig without one of its cameras saw (`LeaveOneOutFrames.inputs`); proxies are computed once a time."""

    def __init__(self, inputs: Mapping[int, MultiViewFrame], bounds: Bounds | None, hull: HullConfig):
        self.frames = inputs
        self.bounds = bounds
        self.hull = hull
        self._proxies: dict[int, GeometryProxy] = {}

    def proxy(self, time: int) -> GeometryProxy:
        """G[time], from the masks of the cameras that are left."""
        if time not in self._proxies:
            frame = self.frames[time]
            assert frame.mask is not None, "what trains has masks"
            self._proxies[time] = reconstruct(frame.mask, frame.cameras, self.bounds, self.hull)
        return self._proxies[time]

    def sample(
        self,
        time: int,
        times: Sequence[int],
        truth: MultiViewFrame,
        render: RenderConfig,
        min_hole_px: int,
        cameras: tuple[int, int] = (0, 0),
        widened_px: int = 0,
    ) -> Sample | None:
        """The pair at `time` with context from these `times`, its own first; None if fewer pixels are missing.

        truth: the held camera at `time`, one view.
        cameras: how many are context at least, and how many `nearby`.
        widened_px: by how much its holes are larger than what the source views do not see.
        """
        view = render_view(self.frames[time], self.proxy(time), truth.cameras, render)
        if float(view.error.sum()) < min_hole_px:
            return None
        view = widened(view, widened_px)
        wanted = view.closest_views(max(len(view.source_views), cameras[0]))
        context = []
        for tau in times:
            names = [n for n in wanted if n in self.frames[tau].cameras.names]
            frame = self.frames[tau].select(names)
            context.append(ContextViews(frame, self.proxy(tau).depth(frame.cameras)))
        assert truth.mask is not None, "what trains has masks"
        around = view.closest_views(cameras[1])
        near = self.frames[time].select(around)
        nearby = ContextViews(near, self.proxy(time).depth(near.cameras)) if around else None
        black = truth.rgb[0].float() * (truth.mask[0].float() / 255)
        return Sample(view, tuple(context), nearby, black.round().to(torch.uint8))


def widened(view: IncompleteView, reach_px: int) -> IncompleteView:
    """The view with everything on the subject missing that is at most so far, along rows and columns, from a hole."""
    if not reach_px:
        return view
    near = F.max_pool2d((view.error[None, None] > 0).float(), 2 * reach_px + 1, 1, reach_px)[0, 0] > 0
    missing = near & (view.mask > 0)
    kept = ~missing
    return replace(view, rgb=view.rgb * kept, error=view.error.masked_fill(missing, 1.0), weights=view.weights * kept)
