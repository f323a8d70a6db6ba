"""A method of your own in one file: a subclass of `Inpainter` with a `step`.

    viewmend evaluate P --methods telea,examples/03_own_method.py:Afterimage --out out/mine

`Afterimage` fills a hole with the colours of the same pixels in previous views, darkened, and otherwise with the mean
colour of the view. It uses no camera; a method that does calls `context(time, view.source_views)`, which returns
their images and the hull's depth in them for any `time` up to the view's own.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from viewmend import CompletedView, ContextProvider, IncompleteView, Inpainter, State


@dataclass(frozen=True)
class Memory(State):
    """State that a stream carries from view to view. It is a value, so streams cannot interfere."""

    rgb: Tensor | None = None
    seen: Tensor | None = None


class Afterimage(Inpainter):
    """Created with the device. Everything its output depends on is an attribute, by which results are cached."""

    def __init__(self, device: str, fading: float = 0.9) -> None:
        self.fading = fading

    def initial_state(self) -> Memory:
        return Memory()

    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, Memory]:
        whole = (view.mask > 0) & (view.error == 0)
        mean = view.rgb[:, whole].mean(1) if bool(whole.any()) else view.rgb.new_zeros(3)
        fill = mean[:, None, None].expand_as(view.rgb)
        seen = torch.zeros_like(whole)
        if isinstance(state, Memory) and state.rgb is not None and state.rgb.shape == view.rgb.shape:
            seen = state.seen
            fill = torch.where(seen, self.fading * state.rgb, fill)
        # Pixels with an error of 0 must not change; the evaluation checks that.
        completed = torch.where(view.error > 0, view.error * fill + (1 - view.error) * view.rgb, view.rgb)
        return CompletedView(view, completed), replace(Memory(), rgb=completed, seen=whole | seen)
