"""A method of your own in an evaluation, in one file: a class with `initial_state` and `step`.

    viewmend evaluate P --methods telea,examples/new_method.py:Afterimage --out out/mine

`Afterimage` fills a hole with the colours that it saw at the same pixels in the last views, darker the longer ago, and
with the mean colour of the view where it never saw any. It asks no camera; one that does asks
`context(time, view.source_views)` for their images and the geometry's depth in them, for any
`time` up to the view's own.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from viewmend.inpainting.protocol import ContextProvider, State
from viewmend.views import CompletedView, IncompleteView


@dataclass(frozen=True)
class Memory(State):
    """What one stream carries from view to view: a value, so that streams cannot interfere."""

    rgb: Tensor | None = None
    seen: Tensor | None = None


class Afterimage:
    """Made from the device. All that its output depends on is an attribute: by these, results are remembered."""

    def __init__(self, device: str, fading: float = 0.9) -> None:
        self.fading = fading

    def initial_state(self) -> Memory:
        return Memory()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, Memory]:
        whole = (view.mask > 0) & (view.error == 0)
        mean = view.rgb[:, whole].mean(1) if bool(whole.any()) else view.rgb.new_zeros(3)
        fill, seen = mean[:, None, None].expand_as(view.rgb), torch.zeros_like(whole)
        if isinstance(state, Memory) and state.rgb is not None and state.rgb.shape == view.rgb.shape:
            seen = state.seen
            fill = torch.where(seen, self.fading * state.rgb, fill)
        # Pixels with E = 0 stay as they are, bit for bit: the evaluation checks that.
        completed = torch.where(view.error > 0, view.error * fill + (1 - view.error) * view.rgb, view.rgb)
        return CompletedView(view, completed), replace(Memory(), rgb=completed, seen=whole | seen)
