"""RGVI (Cho et al. 2025), reference-guided video inpainting, as the offline upper bound of the paper.

It pulls pixels of the past along optical flow into the holes. As in the paper, past frames are the true images and only
the newest frame has holes, so there is one direction to pull from. Flow is RAFT's (Teed & Deng 2020) where its weights
are available, otherwise OpenCV's. Completed flow, and pixels that no past frame shows, come from the smooth fill.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.functional import max_pool2d

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.sampling import sample_bilinear
from viewmend.metrics.weights import checked_weights, find_weights, known_weights
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.compositing import blend
from viewmend.models.smooth_fill import fill
from viewmend.types import CompletedView, IncompleteView
from viewmend.utils.weight_files import load_weights

Image = Float[Tensor, "3 height width"]
FlowMap = Float[Tensor, "2 height width"]
"""Where each pixel's point is in another image, relative to the pixel: x right, y down, pixels."""


DISAGREEMENT = (0.01, 0.5)
"""Forward and backward flow may differ, squared, by this fraction of their squares plus this many square pixels."""


def dis_flow(image: Image, other: Image) -> FlowMap:
    """Dense inverse search (Kroeger et al. 2016), OpenCV's, from images in [0, 1]."""
    import cv2

    grey = [
        cv2.cvtColor((x.clamp(0, 1) * 255).round().byte().cpu().movedim(0, -1).contiguous().numpy(), cv2.COLOR_RGB2GRAY)
        for x in (image, other)
    ]
    found = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(grey[0], grey[1], np.zeros((0, 0)))
    return torch.from_numpy(np.ascontiguousarray(found)).movedim(-1, 0).to(image)


def pull(
    image: Float[Tensor, "channel height width"], flow: FlowMap
) -> tuple[Float[Tensor, "channel height width"], Bool[Tensor, "height width"]]:
    """The other image warped by the flow (bilinear), and where all samples lie inside it."""
    height, width = flow.shape[1:]
    at = pixel_centers(width, height, flow.device) + flow.movedim(0, -1)
    inside = ((at >= 0.5) & (at <= at.new_tensor([width, height]) - 0.5)).all(-1)
    return sample_bilinear(image[None], at.flatten(0, 1)[None], "border")[0].T.unflatten(1, (height, width)), inside


def disagreeing(flow: FlowMap, back: FlowMap) -> Bool[Tensor, "height width"]:
    """Where forward and backward flow disagree (Sundaram et al. 2010), or the flow leaves the image."""
    returned, inside = pull(back, flow)
    share, square_px = DISAGREEMENT
    allowed = share * (flow.square().sum(0) + returned.square().sum(0)) + square_px
    return ~inside | ((flow + returned).square().sum(0) > allowed)


WIDTHS = (64, 64, 96, 128, 256)
"""Channels of an encoder's first layer, of its three pairs of blocks, and of its features."""
HIDDEN = 128
LEVELS, RADIUS = 4, 4
"""Number of resolutions of the correlation look-up, and its radius in each."""
UPDATES = 12
CELL_PX = 8
"""Features are at 1/8."""
LEAST_PX, MOST_PX = 128, 864
"""Sides of the network's input: the coarsest correlation needs 128 px; RGVI uses 480 x 864."""


class Raft(nn.Module):
    """Flow between two images. Keys as in torchvision's `raft_large`; `load_raft` loads its weights."""

    def __init__(self) -> None:
        super().__init__()
        self.feature_encoder = _Encoder(nn.InstanceNorm2d)
        self.context_encoder = _Encoder(nn.BatchNorm2d)
        self.update_block = _Update()
        self.mask_predictor = nn.Module()
        self.mask_predictor.convrelu = _Conv(HIDDEN, 256, 3)
        self.mask_predictor.conv = nn.Conv2d(256, 9 * CELL_PX**2, 1)

    @torch.no_grad()
    def forward(self, image: Image, other: Image) -> FlowMap:
        """Where the image's pixels are in the other one, pixels; images in [0, 1], of any size."""
        height, width = image.shape[1:]
        scale = min(1.0, MOST_PX / max(height, width))
        size = [max(LEAST_PX, round(s * scale / CELL_PX) * CELL_PX) for s in (height, width)]
        pair = F.interpolate(torch.stack([image, other]) * 2 - 1, size, mode="bilinear", antialias=True)
        flow = self.of_pair(pair)
        flow = F.interpolate(flow, (height, width), mode="bilinear")[0]
        return flow * flow.new_tensor([width / size[1], height / size[0]])[:, None, None]

    def of_pair(self, pair: Float[Tensor, "2 3 height width"]) -> Float[Tensor, "1 2 height width"]:
        """Flow from the first to the second image in [-1, 1], of a size that is a multiple of `CELL_PX`."""
        first, second = self.feature_encoder(pair).split(1)
        pyramid = correlations(first, second)
        hidden, context = self.context_encoder(pair[:1]).split(HIDDEN, 1)
        hidden, context = hidden.tanh(), context.relu()
        rows, columns = first.shape[2:]
        start = pixel_centers(columns, rows, pair.device).movedim(-1, 0)[None].to(pair)
        flow = torch.zeros_like(start)
        for _ in range(UPDATES):
            hidden, step = self.update_block(hidden, context, index_pyramid(pyramid, start + flow), flow)
            flow = flow + step
        predictor = self.mask_predictor
        assert isinstance(predictor.convrelu, nn.Module) and isinstance(predictor.conv, nn.Module)
        return upsampled(flow, 0.25 * predictor.conv(predictor.convrelu(hidden)))


def load_raft(device: torch.device | str = "cpu") -> Raft:
    """RAFT with torchvision's weights.

    Raises:
        MissingWeightsError: their file was not found.
        WeightsError: it is damaged or holds another network.
    """
    return load_weights(Raft(), checked_weights(known_weights("raft")), device).requires_grad_(False)


def correlations(
    first: Float[Tensor, "1 channel rows cols"], second: Float[Tensor, "1 channel rows cols"]
) -> list[Float[Tensor, "place 1 _rows _cols"]]:
    """Correlations of each place of the first with all of the second, at full and halved resolutions."""
    _, channels, rows, columns = first.shape
    volume = first[0].flatten(1).T @ second[0].flatten(1) / channels**0.5
    levels = [volume.view(-1, 1, rows, columns)]
    for _ in range(LEVELS - 1):
        levels.append(F.avg_pool2d(levels[-1], 2))
    return levels


def index_pyramid(
    pyramid: Sequence[Float[Tensor, "place 1 _rows _cols"]], at: Float[Tensor, "1 2 rows cols"]
) -> Float[Tensor, "1 channel rows cols"]:
    """Correlations around the position `at` (x, y) of each place: level by level, columns of the square first."""
    offset = torch.arange(-RADIUS, RADIUS + 1, device=at.device, dtype=at.dtype)
    square = torch.stack(torch.meshgrid(offset, offset, indexing="ij"), -1)  # the first index moves x
    center = at[0].flatten(1).T[:, None, None]
    found = []
    for level, volume in enumerate(pyramid):
        # Positions are relative to the centre of the first pixel of each level.
        places = (center - 0.5) / 2**level + 0.5 + square
        found.append(sample_bilinear(volume, places.flatten(1, 2))[..., 0])
    return torch.cat(found, 1).T.reshape(1, -1, *at.shape[2:])


def upsampled(
    flow: Float[Tensor, "1 2 rows cols"], mask: Float[Tensor, "1 channel rows cols"]
) -> Float[Tensor, "1 2 height width"]:
    """Eight times as large: each pixel a convex combination of the 3 x 3 coarse ones around it."""
    rows, columns = flow.shape[2:]
    weights = mask.view(9, CELL_PX, CELL_PX, rows, columns).softmax(0)
    around = F.unfold(CELL_PX * flow, 3, padding=1).view(2, 9, rows, columns)
    return torch.einsum("nabrc,dnrc->dracb", weights, around).reshape(1, 2, rows * CELL_PX, columns * CELL_PX)


class _Conv(nn.Sequential):
    """Convolution, optional normalisation, optional ReLU."""

    def __init__(
        self,
        before: int,
        channels: int,
        kernel: int,
        stride: int = 1,
        norm: type[nn.Module] | None = None,
        relu: bool = True,
    ) -> None:
        layers: list[nn.Module] = [nn.Conv2d(before, channels, kernel, stride, kernel // 2)]
        layers += [norm(channels)] if norm is not None else []
        super().__init__(*layers, *([nn.ReLU()] if relu else []))


class _Block(nn.Module):
    def __init__(self, before: int, channels: int, stride: int, norm: type[nn.Module]) -> None:
        super().__init__()
        self.convnormrelu1 = _Conv(before, channels, 3, stride, norm)
        self.convnormrelu2 = _Conv(channels, channels, 3, 1, norm)
        self.downsample = _Conv(before, channels, 1, stride, norm, relu=False) if stride > 1 else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.downsample(x) + self.convnormrelu2(self.convnormrelu1(x)))


class _Encoder(nn.Module):
    """Features at 1/8."""

    def __init__(self, norm: type[nn.Module]) -> None:
        super().__init__()
        first, *widths, last = WIDTHS
        self.convnormrelu = _Conv(3, first, 7, 2, norm)
        before = first
        for number, (channels, stride) in enumerate(zip(widths, (1, 2, 2), strict=True), 1):
            pair = nn.Sequential(_Block(before, channels, stride, norm), _Block(channels, channels, 1, norm))
            self.add_module(f"layer{number}", pair)
            before = channels
        self.conv = nn.Conv2d(before, last, 1)

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.children():
            x = layer(x)
        return x


class _Motion(nn.Module):
    """Correlations and flow, as 128 channels of which the last two are the flow itself."""

    def __init__(self) -> None:
        super().__init__()
        self.convcorr1 = _Conv(LEVELS * (2 * RADIUS + 1) ** 2, 256, 1)
        self.convcorr2 = _Conv(256, 192, 3)
        self.convflow1 = _Conv(2, 128, 7)
        self.convflow2 = _Conv(128, 64, 3)
        self.conv = _Conv(192 + 64, 126, 3)

    def forward(self, flow: Tensor, seen: Tensor) -> Tensor:
        both = torch.cat([self.convcorr2(self.convcorr1(seen)), self.convflow2(self.convflow1(flow))], 1)
        return torch.cat([self.conv(both), flow], 1)


class _Gru(nn.Module):
    def __init__(self, kernel: tuple[int, int]) -> None:
        super().__init__()
        padding = (kernel[0] // 2, kernel[1] // 2)
        self.convz, self.convr, self.convq = (nn.Conv2d(3 * HIDDEN, HIDDEN, kernel, padding=padding) for _ in range(3))

    def forward(self, hidden: Tensor, x: Tensor) -> Tensor:
        both = torch.cat([hidden, x], 1)
        update, reset = self.convz(both).sigmoid(), self.convr(both).sigmoid()
        new = self.convq(torch.cat([reset * hidden, x], 1)).tanh()
        return (1 - update) * hidden + update * new


class _Update(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.motion_encoder = _Motion()
        self.recurrent_block = nn.Module()
        self.recurrent_block.convgru1 = _Gru((1, 5))
        self.recurrent_block.convgru2 = _Gru((5, 1))
        self.flow_head = nn.Module()
        self.flow_head.conv1 = nn.Conv2d(HIDDEN, 256, 3, padding=1)
        self.flow_head.conv2 = nn.Conv2d(256, 2, 3, padding=1)

    def forward(self, hidden: Tensor, context: Tensor, seen: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        x = torch.cat([context, self.motion_encoder(flow, seen)], 1)
        for gru in self.recurrent_block.children():
            hidden = gru(hidden, x)
        first, second = self.flow_head.children()
        return hidden, second(F.relu(first(hidden)))


PAST_FRAMES = 10
"""Number of past frames that are kept."""
FLOW_MARGIN_PX = 4
"""Flow this near to a hole depends on the fill, and is completed, too."""

Flow = Callable[[Image, Image], FlowMap]
"""flow(image, other), of images in [0, 1]."""
Completion = Callable[
    [Float[Tensor, "channel height width"], Bool[Tensor, "height width"], Bool[Tensor, "height width"]],
    Float[Tensor, "channel height width"],
]
"""completion(image, missing, subject): the image with its missing pixels filled, the others as they are."""


@dataclass(frozen=True)
class RgviState(State):
    """The past frames of a stream."""

    past: tuple[Image, ...] = ()
    """Completed or true frames, the latest first."""
    flows: tuple[FlowMap, ...] = ()
    """The flow from each of these frames to the next older one."""


class Rgvi(Inpainter):
    """RGVI on a stream of views. Without `reveal_truth`, its own results are its past.

    Args:
        flow: optical flow between two frames.
        complete_flow: completes flow in and near holes.
        complete: fills pixels that cannot be pulled from the past.
    """

    def __init__(self, flow: Flow = dis_flow, complete_flow: Completion = fill, complete: Completion = fill) -> None:
        self.flow, self.complete_flow, self.complete = flow, complete_flow, complete

    def initial_state(self) -> State:
        """A stream without a past."""
        return RgviState()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """Fills from the past along flow, the rest from the view alone; `context` is not used."""
        assert isinstance(state, RgviState), "the state of another inpainter"
        past = state.past if not state.past or state.past[0].shape == view.rgb.shape else ()
        missing, subject = view.error > 0, view.mask > 0
        image, left = view.rgb, missing
        if bool(missing.any()) and past:
            image, left = self._pull(view, past, state.flows)
        if bool(left.any()):
            image = self.complete(image, left, subject)
        mended = blend(view.rgb, view.error, image, torch.ones_like(view.error))
        return CompletedView(view, mended), self._remember(mended, past, state.flows if past else ())

    def reveal_truth(self, state: State, truth: Image) -> State:
        """The newest past frame becomes the truth."""
        assert isinstance(state, RgviState), "the state of another inpainter"
        return self._remember(truth, state.past[1:], state.flows[1:])

    def _pull(
        self, view: IncompleteView, past: tuple[Image, ...], flows: tuple[FlowMap, ...]
    ) -> tuple[Image, Bool[Tensor, "height width"]]:
        """The view with masked pixels from the latest past frame that shows them, and the pixels that none shows."""
        missing, subject = view.error > 0, view.mask > 0
        # Flow needs colours in the holes; flow estimated there, and close by, is replaced.
        guess = fill(view.rgb, missing, subject)
        size = 2 * FLOW_MARGIN_PX + 1
        unknown = max_pool2d(missing[None, None].float(), size, 1, FLOW_MARGIN_PX)[0, 0] > 0
        flow = self.flow(guess, past[0])
        unknown = unknown | disagreeing(flow, self.flow(past[0], guess))
        flow = self.complete_flow(flow, unknown, subject)
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
        newest = (self.flow(image, older[0]),) if older else ()
        return replace(RgviState(), past=(image, *older), flows=(*newest, *flows)[: len(older)])


def make_rgvi(device: torch.device | str = "cpu") -> Rgvi:
    """RGVI with RAFT if its weights are available, otherwise with OpenCV's flow.

    Raises:
        WeightsError: the file of RAFT's weights is damaged or holds another network.
    """
    return Rgvi(dis_flow if find_weights(known_weights("raft")) is None else load_raft(device))
