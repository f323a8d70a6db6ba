"""The model `views` as a stream uses it, for benchmarks that call inpainters directly."""

from viewmend.models.base import ContextProvider, Inpainter, Memory, RenderQuality, State, ViewsAt
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.views.model import ViewSynthNet
from viewmend.rendering.error_mask import decide_error_mask
from viewmend.rendering.view import RenderConfig
from viewmend.types import CompletedView, IncompleteView

STREAMED = {
    "views-unseen": ("holes", None),
    "views-wrong": ("all", RenderConfig().refine_fraction),
    "views-all": ("all", None),
    "views-moving": ("all", 0.0),
}
"""Error rule, and largest share of the hull that is refined (None: all of it)."""


class Streamed(Inpainter):
    """`views` as a stream uses it: predicted errors first, then refinement. It encodes the cameras in every step."""

    def __init__(self, views: ViewsAt, fraction: float | None, device: str) -> None:
        net = load_inpainter("views", device)
        assert isinstance(net, ViewSynthNet)
        self.net, self._views, self.fraction = net, views, fraction

    def initial_state(self) -> State:
        return State()

    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, State]:
        memory: Memory = {}
        own = ContextProvider(
            self._views, RenderQuality(refine_fraction=self.fraction), memory=lambda _: memory
        )
        view = decide_error_mask(view, None, "all", self.fraction, self.net, own)
        return self.net.step(view, own, state)
