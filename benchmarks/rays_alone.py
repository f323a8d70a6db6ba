"""What `small` fills before its patches: viewmend evaluate ... --methods small,benchmarks/rays_alone.py:RaysAlone."""

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import ContextProvider, State
from viewmend.views import CompletedView, IncompleteView


class RaysAlone:
    """The coarse fill of the shipped `small`."""

    def __init__(self, device: str = "cpu") -> None:
        net = load_network("small", device)
        assert isinstance(net, Chain), "small reads rays, then fills patches"
        self.coarse = net.eval().coarse

    def initial_state(self) -> State:
        """Nothing is remembered."""
        return self.coarse.initial_state()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """Only what the cameras show along each missing pixel's ray."""
        return self.coarse.step(view, context, state)
