"""RGVI (Cho et al. 2025), reference-guided video inpainting, as the offline upper bound of the paper.

It pulls pixels of the past along optical flow into the holes. As in the paper, past frames are the
true images and only the newest frame has holes, so there is one direction to pull from. Flow is
torchvision's RAFT (Teed & Deng 2020) where its weights are available, otherwise OpenCV's. The
smooth fill completes the flow, and what no past frame shows.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import interpolate, max_pool2d

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.sampling import sample_bilinear
from viewmend.metrics.weights import checked_weights, find_weights, known_weights
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.compositing import blend
from viewmend.models.smooth_fill import fill
from viewmend.types import CompletedView, IncompleteView
from viewmend.utils.weight_files import construct, load_weights

Image = Float[Tensor, "3 height width"]
FlowMap = Float[Tensor, "2 height width"]
"""Where each pixel's point is in another image, relative to the pixel: x right, y down, pixels."""
DISAGREEMENT = (0.01, 0.5)
"""Forward and backward flow may differ, squared, by this fraction of their squares plus this many
square pixels."""
RAFT_CELL_PX = 8
"""Sides of RAFT's input are multiples of this."""
RAFT_MIN_PX = 128
"""Shortest side of RAFT's input, which its coarsest correlation needs."""
RAFT_MAX_PX = 864
"""Longest side of RAFT's input; RGVI uses 480 x 864 pixels."""
PAST_FRAMES = 10
"""Number of past frames that are kept."""
FLOW_MARGIN_PX = 4
"""Flow within this distance of a hole is completed too, since it depends on the fill; pixels."""
Flow = Callable[[Image, Image], FlowMap]
"""Estimates the flow from an image to another one, both in [0, 1]."""


def dis_flow(image: Image, other: Image) -> FlowMap:
    """Dense inverse search (Kroeger et al. 2016), OpenCV's, from images in [0, 1]."""
    import cv2

    grey = [
        cv2.cvtColor(
            (x.clamp(0, 1) * 255).round().byte().cpu().movedim(0, -1).contiguous().numpy(), cv2.COLOR_RGB2GRAY
        )
        for x in (image, other)
    ]
    found = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(
        grey[0], grey[1], np.zeros((0, 0))
    )
    return torch.from_numpy(np.ascontiguousarray(found)).movedim(-1, 0).to(image)


def pull(
    image: Float[Tensor, "channel height width"], flow: FlowMap
) -> tuple[Float[Tensor, "channel height width"], Bool[Tensor, "height width"]]:
    """The other image warped by the flow (bilinear), and where all samples lie inside it."""
    height, width = flow.shape[1:]
    at = pixel_centers(width, height, flow.device) + flow.movedim(0, -1)
    inside = ((at >= 0.5) & (at <= at.new_tensor([width, height]) - 0.5)).all(-1)
    return sample_bilinear(image[None], at.flatten(0, 1)[None], "border")[0].T.unflatten(
        1, (height, width)
    ), inside


def disagreeing(flow: FlowMap, back: FlowMap) -> Bool[Tensor, "height width"]:
    """Where forward and backward flow disagree (Sundaram et al. 2010), or the flow leaves the image."""
    returned, inside = pull(back, flow)
    share, square_px = DISAGREEMENT
    allowed = share * (flow.square().sum(0) + returned.square().sum(0)) + square_px
    return ~inside | ((flow + returned).square().sum(0) > allowed)


@torch.inference_mode()
def raft_flow(network: nn.Module, image: Image, other: Image) -> FlowMap:
    """Where the image's pixels are in the other one, by torchvision's RAFT (large); images in [0, 1], of any size."""
    height, width = image.shape[1:]
    scale = min(1.0, RAFT_MAX_PX / max(height, width))
    size = [max(RAFT_MIN_PX, round(s * scale / RAFT_CELL_PX) * RAFT_CELL_PX) for s in (height, width)]
    pair = interpolate(torch.stack([image, other]) * 2 - 1, size, mode="bilinear", antialias=True)
    flow = interpolate(network(pair[:1], pair[1:])[-1], (height, width), mode="bilinear")[0]
    return flow * flow.new_tensor([width / size[1], height / size[0]])[:, None, None]


@dataclass(frozen=True)
class RgviState(State):
    """The past frames of a stream."""

    past: tuple[Image, ...] = ()
    """Completed or true frames, the latest first."""
    flows: tuple[FlowMap, ...] = ()
    """The flow from each of these frames to the next older one."""


class Rgvi(Inpainter):
    """RGVI on a stream of views. Without `reveal_truth`, its own results are its past."""

    def __init__(self, flow: Flow = dis_flow) -> None:
        self.flow = flow

    def initial_state(self) -> State:
        """A stream without a past."""
        return RgviState()

    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, State]:
        """Fills from the past along flow, the rest from the view alone; `context` is not used."""
        assert isinstance(state, RgviState), "the state of another inpainter"
        past = state.past if not state.past or state.past[0].shape == view.rgb.shape else ()
        image = view.rgb
        left = view.error > 0
        subject = view.mask > 0
        if bool(left.any()) and past:
            image, left = self._pull(view, past, state.flows)
        if bool(left.any()):
            image = fill(image, left, subject)
        completed = blend(view.rgb, view.error, image, torch.ones_like(view.error))
        return CompletedView(view, completed), self._remember(completed, past, state.flows if past else ())

    def reveal_truth(self, state: State, truth: Image) -> State:
        """The newest past frame becomes the truth."""
        assert isinstance(state, RgviState), "the state of another inpainter"
        return self._remember(truth, state.past[1:], state.flows[1:])

    def _pull(
        self, view: IncompleteView, past: tuple[Image, ...], flows: tuple[FlowMap, ...]
    ) -> tuple[Image, Bool[Tensor, "height width"]]:
        """The view with masked pixels from the latest past frame that shows them, and the pixels that none shows."""
        missing = view.error > 0
        subject = view.mask > 0
        # Flow needs colours in the holes; flow estimated there, and close by, is replaced.
        guess = fill(view.rgb, missing, subject)
        size = 2 * FLOW_MARGIN_PX + 1
        near = max_pool2d(missing[None, None].float(), size, 1, FLOW_MARGIN_PX)[0, 0] > 0
        flow = self.flow(guess, past[0])
        unknown = near | disagreeing(flow, self.flow(past[0], guess))
        flow = fill(flow, unknown, subject)
        image = view.rgb
        left = missing
        seen = torch.ones_like(missing)
        for age, frame in enumerate(past):
            if age:
                older, inside = pull(flows[age - 1], flow)
                flow = flow + older
                seen = seen & inside
            pulled, inside = pull(frame, flow)
            found = left & seen & inside
            image = torch.where(found, pulled, image)
            left = left & ~found
        return image, left

    def _remember(self, image: Image, past: tuple[Image, ...], flows: tuple[FlowMap, ...]) -> RgviState:
        older = past[: PAST_FRAMES - 1]
        newest = (self.flow(image, older[0]),) if older else ()
        return RgviState(past=(image, *older), flows=(*newest, *flows)[: len(older)])


def make_rgvi(device: torch.device | str = "cpu") -> Rgvi:
    """RGVI with RAFT if its weights are available, otherwise with OpenCV's flow.

    Raises:
        WeightsError: the file of RAFT's weights is damaged or holds another network.
        ValueError: there are weights, but torchvision is not installed.
    """
    weights = known_weights("raft")
    if find_weights(weights) is None:
        return Rgvi()
    path = checked_weights(weights)
    try:
        from torchvision.models.optical_flow import raft_large
    except ImportError:
        raise ValueError(f"expected torchvision to run {path}, found none; pip install torchvision") from None
    return Rgvi(partial(raft_flow, load_weights(construct(raft_large), path, device)))
