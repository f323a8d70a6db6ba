"""Fills that hardly differ from the last view's, at the same point of the proxy, are averaged with them. Ours.

A stream's holes flicker: each view is filled anew, from masks and images with noise. Where nothing changed, what the
proxy carries over from the last view says the same again; where colours differ, the subject moved: the new fill stands.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.backgrounds import Background
from viewmend.geometry.cameras import Cameras, project, unproject
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.inpainting.protocol import (
    ContextProvider,
    RenderQuality,
    State,
    ViewInpainter,
    crop_margin_px,
    encode_cameras,
    encode_past,
    own_background,
)
from viewmend.views import CompletedView, ContextViews, IncompleteView

STALE = 3
"""Views of more than so many frames ago are not looked at."""
COARSE = 0.9
"""Nor views whose focal length, in pixels, is below this share of the new one's: they would blur its fill."""
SAME_COLOUR = 0.07
"""Root mean square difference of colours, in [0, 1], at which a carried fill counts 1/e of what it could."""
SAME_PLACE = 0.01
"""Fraction of its depth at which a point is not the last view's surface any more."""


@dataclass(frozen=True)
class LastView:
    """What is kept of a completed view."""

    camera: Cameras
    rgb: Float[Tensor, "3 height width"]
    depth: Float[Tensor, "height width"]
    time: int

    @classmethod
    def of(cls, completed: CompletedView) -> "LastView":
        """What the next view needs of this one."""
        view = completed.view
        return cls(view.camera, completed.rgb, view.depth, view.time)


@dataclass(frozen=True)
class AccumulationState(State):
    """The inner inpainter's state, and the stream's last view."""

    inner: State
    last: LastView | None = None


class TemporalAccumulation(nn.Module):
    """An inpainter whose fills are averaged with those of its stream's last view, where both agree."""

    def __init__(self, inner: ViewInpainter, weight: float) -> None:
        """Wrap `inner`; `weight`, in [0, 1), is that of a carried fill that agrees."""
        super().__init__()
        self.inner, self.weight = inner, weight
        self.config = getattr(inner, "config", None)

    @property
    def background(self) -> Background | None:
        """The inner inpainter's."""
        return own_background(self.inner)

    def crop_margin_px(self, quality: RenderQuality) -> int | None:
        """The inner inpainter's."""
        return crop_margin_px(self.inner, quality)

    def encode_past(self, view: IncompleteView, context: ContextProvider) -> None:
        """The inner inpainter's."""
        encode_past(self.inner, view, context)

    def encode_cameras(self, views: ContextViews, context: ContextProvider) -> None:
        """The inner inpainter's."""
        encode_cameras(self.inner, views, context)

    def initial_state(self) -> AccumulationState:
        """The state before the first view of a stream."""
        return AccumulationState(self.inner.initial_state())

    @torch.no_grad()
    def step(
        self, view: IncompleteView, context: ContextProvider, state: AccumulationState
    ) -> tuple[CompletedView, AccumulationState]:
        """The inner inpainter's view, accumulated."""
        completed, inner = self.inner.step(view, context, state.inner)
        shown = accumulate(completed, state.last, self.weight)
        return shown, AccumulationState(inner, LastView.of(shown))


def accumulate(completed: CompletedView, last: LastView | None, weight: float) -> CompletedView:
    """The view, its fill averaged with what `last` showed at the same points; known pixels stay bit for bit.

    Args:
        completed: of any camera and size.
        last: the stream's last view; None for its first.
        weight: of a carried fill that agrees, in [0, 1); 0 leaves the view as it is.
    """
    view = completed.view
    if not weight or last is None or not 0 <= view.time - last.time <= STALE:
        return completed
    if float(last.camera.K[0, 0, 0]) < COARSE * float(view.camera.K[0, 0, 0]):
        return completed
    pixels = torch.nonzero((view.error > 0) & (view.depth > 0))
    index = tuple(pixels.unbind(1))
    points = unproject((pixels.flip(1) + 0.5).to(view.depth)[None], view.depth[index][None], view.camera)[0]
    at, z = project(points, last.camera)
    inside = in_view(at, z, last.camera)[0]
    before = sample_bilinear(last.rgb[None], at, "border")[0]
    column, row = torch.where(inside[:, None], at[0], 0.0).long().unbind(-1)
    there, z = last.depth[row, column], z[0]
    now = completed.rgb.movedim(0, -1)[index]
    agree = (-(((before - now) / SAME_COLOUR) ** 2).mean(1)).exp()
    same = inside & (there > 0) & ((there - z).abs() < SAME_PLACE * z)
    carried = (weight * agree * same * view.error[index])[:, None]
    rgb = completed.rgb.movedim(0, -1).index_put(index, torch.lerp(now, before, carried)).movedim(-1, 0)
    return CompletedView(view, rgb)
