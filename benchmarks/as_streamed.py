"""The shipped reader of whole views as a stream asks it, for benchmarks that call inpainters themselves."""

from viewmend.inpainting.checkpoint import load_inpainter
from viewmend.inpainting.protocol import ContextProvider, Memory, RenderQuality, State, ViewsAt
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.inpainting.wrong import narrowed
from viewmend.rendering.view import RenderConfig
from viewmend.views import CompletedView, IncompleteView

STREAMED = {
    "views-unseen": ("unseen", None),
    "views-wrong": ("all", RenderConfig().wrong_fraction),
    "views-all": ("all", None),
    "views-moving": ("all", 0.0),
}
"""What may change, and which part of the proxy is read at most, where most is to be gained; None for all of it."""


class Streamed:
    """`views` as a stream asks it: first where most is to be gained, then for that. What it encodes is made anew."""

    def __init__(self, views: ViewsAt, fraction: float | None, device: str) -> None:
        net = load_inpainter("views", device)
        assert isinstance(net, SweepNet), "which is what is shipped under this name"
        self.net, self._views, self.fraction = net, views, fraction

    def initial_state(self) -> State:
        return State()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        memory: Memory = {}
        own = ContextProvider(self._views, RenderQuality(read_fraction=self.fraction), memory=lambda _: memory)
        view = view if self.fraction is None else narrowed(view, self.net, own, self.fraction)
        return self.net.step(view, own, state)
