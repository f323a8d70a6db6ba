"""Views upon white: the background is white, holes stay black; and what was painted there, taken back upon black.

Section 13: the paper's images are matted on white. What fills by what it is shown fills there as well as upon black;
a network that was trained upon one of the two is shown its own, whatever it is scored upon.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background
from viewmend.inpainting.protocol import (
    ContextProvider,
    RenderQuality,
    State,
    ViewInpainter,
    crop_margin_px,
    own_error_rule,
    state_after,
)
from viewmend.views import CompletedView, IncompleteView


def covered(view: IncompleteView) -> Float[Tensor, "height width"]:
    """What is not background of a view whose E was painted upon white: M, and all of E."""
    return 1 - (1 - view.mask) * (1 - view.error)


def view_upon(background: Background, view: IncompleteView) -> IncompleteView:
    """A view as what fills by what it is shown is shown it: its background so, its holes black."""
    return view if background == "black" else replace(view, rgb=view.rgb + (1 - view.mask) * (1 - view.error))


@dataclass(frozen=True)
class UponWhite:
    """An inpainter that is shown views upon white."""

    inner: ViewInpainter

    @property
    def error_rule(self) -> str:
        """The inner inpainter's."""
        return own_error_rule(self.inner)

    def crop_margin_px(self, quality: RenderQuality) -> int | None:
        """The inner inpainter's."""
        return crop_margin_px(self.inner, quality)

    def initial_state(self) -> State:
        """The inner inpainter's."""
        return self.inner.initial_state()

    def state_after(self, view: IncompleteView, state: State) -> State | None:
        """The inner inpainter's, of the view upon white."""
        return state_after(self.inner, view_upon("white", view), state)

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """The completed view; laid upon white, it is what the inner inpainter made."""
        completed, state = self.inner.step(view_upon("white", view), context, state)
        alpha = covered(view) if completed.alpha is None else completed.alpha
        rgb = torch.where(view.error > 0, completed.rgb - (1 - covered(view)), view.rgb)
        return replace(completed, view=view, rgb=rgb, alpha=alpha), state


def fill_upon(fill: ViewInpainter, background: Background) -> ViewInpainter:
    """What fills by what it is shown, shown views upon this background."""
    return UponWhite(fill) if background == "white" else fill
