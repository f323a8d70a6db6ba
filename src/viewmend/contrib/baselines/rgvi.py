"""RGVI (Cho et al. 2025), reference-guided video inpainting, as the offline reference of the paper: it sees the truth.

The stages are the published ones, each with a network that can be put in: optical flow, its completion in holes,
one-shot pulling along accumulated flow, a reference frame, completion of what is left. Without weights, flow is
OpenCV's, and the others are the best fill that nothing was trained for. As in the paper, past frames are the truth and
only the newest one has holes; so there is one direction to pull from, and the frame with most to fill, the reference
frame, is the newest: all that cannot be pulled is its network's.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from viewmend.contrib.baselines.diffusion_fill import find_diffusion
from viewmend.contrib.baselines.raft import load_raft
from viewmend.contrib.baselines.rgvi_flow import FlowMap, Image, dis_flow, disagreeing, pull
from viewmend.metrics.weights import find_weights, known_weights
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.compositing import blend
from viewmend.models.smooth_fill import fill
from viewmend.types import CompletedView, IncompleteView

PAST_FRAMES = 10
"""How far back it pulls from."""
FLOW_MARGIN_PX = 4
"""Flow this near to a hole was made from what fills it, and is completed, too."""

Flow = Callable[[Image, Image], FlowMap]
"""flow(image, other), of images in [0, 1]."""
Completion = Callable[
    [Float[Tensor, "channel height width"], Bool[Tensor, "height width"], Bool[Tensor, "height width"]],
    Float[Tensor, "channel height width"],
]
"""completion(image, missing, subject): the image with its missing pixels filled, the others as they are."""


@dataclass(frozen=True)
class RgviParts:
    """What stands for each of the published networks."""

    flow: Flow = dis_flow
    """RAFT."""
    complete_flow: Completion = fill
    """The recurrent flow completion network."""
    reference: Completion = fill
    """Stable Diffusion 2 inpainting, of what nothing can be pulled into; NaN where it leaves pixels to `rest`."""
    rest: Completion = fill
    """The per-frame completion network: of what the reference leaves, which the published one never does here."""


@dataclass(frozen=True)
class RgviState(State):
    """The past that a stream was shown."""

    past: tuple[Image, ...] = ()
    """The frames that it was shown, the latest first."""
    flows: tuple[FlowMap, ...] = ()
    """The flow from each of these frames to the next older one."""


class Rgvi(Inpainter):
    """RGVI on a stream of views. Without `reveal_truth`, its own results are its past."""

    def __init__(self, parts: RgviParts | None = None) -> None:
        self.parts = parts or RgviParts()

    def initial_state(self) -> State:
        """Nothing seen yet."""
        return RgviState()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """Fills from the past along flow, the rest from the view alone; `context` is never asked."""
        assert isinstance(state, RgviState), "the state of another inpainter"
        past = state.past if not state.past or state.past[0].shape == view.rgb.shape else ()
        missing, subject = view.error > 0, view.mask > 0
        image, left = view.rgb, missing
        if bool(missing.any()) and past:
            image, left = self._pull(view, past, state.flows)
        if bool(left.any()):
            image = self.parts.reference(image, left, subject)
            left = left & image.isnan().any(0)
        if bool(left.any()):
            image = self.parts.rest(torch.where(left, 0.0, image), left, subject)
        mended = blend(view.rgb, view.error, image, torch.ones_like(view.error))
        return CompletedView(view, mended), self._remember(mended, past, state.flows if past else ())

    def reveal_truth(self, state: State, truth: Image) -> State:
        """The newest past frame becomes the truth."""
        assert isinstance(state, RgviState), "the state of another inpainter"
        return self._remember(truth, state.past[1:], state.flows[1:])

    def _pull(
        self, view: IncompleteView, past: tuple[Image, ...], flows: tuple[FlowMap, ...]
    ) -> tuple[Image, Bool[Tensor, "height width"]]:
        """The view with pixels of E from the latest past frame that has them, and the pixels that none has."""
        missing, subject = view.error > 0, view.mask > 0
        # Flow wants something to look at in the holes; what it says there, and close by, does not count.
        guess = fill(view.rgb, missing, subject)
        size = 2 * FLOW_MARGIN_PX + 1
        unknown = max_pool2d(missing[None, None].float(), size, 1, FLOW_MARGIN_PX)[0, 0] > 0
        flow = self.parts.flow(guess, past[0])
        unknown = unknown | disagreeing(flow, self.parts.flow(past[0], guess))
        flow = self.parts.complete_flow(flow, unknown, subject)
        image, left, seen = view.rgb, missing, torch.ones_like(missing)
        for age, frame in enumerate(past):
            if age:
                older, inside = pull(flows[age - 1], flow)
                flow, seen = flow + older, seen & inside
            pulled, inside = pull(frame, flow)
            found = left & seen & inside
            image, left = torch.where(found, pulled, image), left & ~found
        return image, left

    def _remember(self, image: Image, past: tuple[Image, ...], flows: tuple[FlowMap, ...]) -> RgviState:
        older = past[: PAST_FRAMES - 1]
        newest = (self.parts.flow(image, older[0]),) if older else ()
        return replace(RgviState(), past=(image, *older), flows=(*newest, *flows)[: len(older)])


def make_rgvi(device: torch.device | str = "cpu") -> Rgvi:
    """RGVI with RAFT and Stable Diffusion 2 where their weights are, and with what needs none elsewhere.

    Raises:
        WeightsError: a file of RAFT's name is damaged or another.
    """
    raft = find_weights(known_weights("raft"))
    flow = dis_flow if raft is None else load_raft(device)
    return Rgvi(RgviParts(flow=flow, reference=find_diffusion(device) or fill))
