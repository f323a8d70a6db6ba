"""Turns images into tokens (sections 3 and 4), and tokens into pixels, patch by patch (section 7)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.models.paper.config import ENCODER_GROUPS, PaperConfig
from viewmend.models.paper.patches import (
    PATCH_CELLS,
    STEP_CELLS,
    STEP_PX,
    any_in_patch,
    crop,
    padded_size,
    split,
)
from viewmend.types import ContextViews, IncompleteView
from viewmend.utils.cancellation import stop_if_cancelled

RECEPTIVE_RADIUS_PX = 29
"""Distance from a cell of the feature map within which pixels influence its features."""
MARGIN_STEPS = -(-RECEPTIVE_RADIUS_PX // STEP_PX)
"""The receptive radius in patch steps, rounded up."""
CROP_STEPS = 4
"""Crop sizes are multiples of this number of patch steps, because convolutions are compiled for
each new size."""
SLOPE = 0.2
"""Negative slope of all leaky ReLUs."""


@dataclass(frozen=True)
class EncoderInput:
    """Encoder input of a stack of images of one size."""

    channels: Float[Tensor, "view channel height width"]
    """RGB, then mask and relative depth, if the config has them."""
    foreground: Bool[Tensor, "view height width"]
    kept: Bool[Tensor, "view rows cols"]
    """Patches with any foreground; all others are discarded (section 4)."""

    @cached_property
    def kept_on_host(self) -> Bool[Tensor, "view rows cols"]:
        """`kept` on the CPU, where it decides what is cropped; a device is read once."""
        return self.kept.cpu()

    @cached_property
    def places(self) -> Int[Tensor, "patch 3"]:
        """View, row and column of each kept patch."""
        return torch.nonzero(self.kept_on_host).to(self.kept.device)


def build_context_input(views: ContextViews, config: PaperConfig) -> EncoderInput:
    """Encoder input of camera images of one frame. Without masks, the proxy's silhouette is the foreground."""
    frame = views.frame
    rgb = frame.rgb.float() / 255
    mask = (views.depth > 0).float() if frame.mask is None else frame.mask.float() / 255
    inside = torch.ones_like(mask)
    for image, (width, height) in zip(inside, frame.cameras.sizes, strict=True):
        image[height:] = 0
        image[:, width:] = 0
    if not config.use_mask:  # neither matting nor pruning of patches
        return _stack_channels(rgb, mask, views.depth, inside > 0, config)
    rgb = rgb * mask[:, None]
    if config.background == "white":
        rgb = rgb + (inside * (1 - mask))[:, None]  # a smaller image of the stack is padded with black
    return _stack_channels(rgb, mask, views.depth, mask > 0, config)


def build_target_input(view: IncompleteView, config: PaperConfig) -> EncoderInput:
    """Encoder input of a novel view. Missing pixels are black and count as foreground, but not where M_t is 0."""
    if not config.use_mask:  # F as it was rendered, and every patch
        everywhere = torch.ones_like(view.mask[None])
        return _stack_channels(view.rgb[None], everywhere, view.depth[None], everywhere > 0, config)
    rgb = view.cut_rgb[None]
    mask = view.silhouette[None]
    missing = view.missing
    if config.background == "white":
        rgb = (rgb + (1 - mask)) * (1 - missing)
    foreground = (mask > 0) | (missing[None] > 0)
    return _stack_channels(rgb, mask, view.depth[None], foreground, config)


def _stack_channels(
    rgb: Float[Tensor, "view 3 height width"],
    mask: Float[Tensor, "view height width"],
    depth: Float[Tensor, "view height width"],
    foreground: Bool[Tensor, "view height width"],
    config: PaperConfig,
) -> EncoderInput:
    channels = [rgb]
    if config.use_mask:
        channels.append(mask[:, None])
    if config.use_depth:
        channels.append(relative_depth(depth)[:, None])
    return EncoderInput(torch.cat(channels, 1), foreground, any_in_patch(foreground))


def relative_depth(depth: Float[Tensor, "view height width"]) -> Float[Tensor, "view height width"]:
    """4 (z / z_ref - 1), with z_ref the median depth of each image; 0 without a surface (section 3).

    It is independent of the rig's scale and of the target view, so features computed from it can be cached.
    """
    surface = torch.where(depth > 0, depth, torch.nan)
    reference = surface.flatten(1).nanmedian(1).values.nan_to_num(1.0)
    return torch.where(depth > 0, 4 * (depth / reference[:, None, None] - 1), 0.0)


class Encoder(nn.Module):
    """FuseFormer's hierarchical encoder (section 3): nine 3 x 3 convolutions, features at 1/4 of the resolution.

    From the sixth convolution on, the channels of the early features (the fourth convolution's
    output) and of the latest features are split into as many groups as the convolution has, and
    concatenated group by group.
    """

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        widths = config.widths
        early = config.widths[3]
        inputs = (config.in_channels, *widths[:4], *(early + w for w in widths[4:8]))
        strides = (2, 1, 2, 1, 1, 1, 1, 1, 1)
        self.layers = nn.ModuleList(
            nn.Conv2d(i, o, 3, stride, 1, groups=groups)
            for i, o, stride, groups in zip(inputs, widths, strides, ENCODER_GROUPS, strict=True)
        )
        for layer in self.layers:
            assert isinstance(layer, nn.Conv2d) and layer.bias is not None
            nn.init.kaiming_normal_(layer.weight, a=SLOPE)
            nn.init.zeros_(layer.bias)
            layer.weight.data = layer.weight.data.contiguous(memory_format=torch.channels_last)

    def forward(
        self, images: Float[Tensor, "view channel height width"]
    ) -> Float[Tensor, "view feature height/4 width/4"]:
        """Features of images whose sides are multiples of 4."""
        x = images.contiguous(memory_format=torch.channels_last)
        early = x
        for number, layer in enumerate(self.layers):
            stop_if_cancelled()
            if number > 4:
                x = _interleave(early, x, ENCODER_GROUPS[number])
            x = F.leaky_relu(layer(x), SLOPE, inplace=True)
            if number == 3:
                early = x
        return x


def _interleave(
    early: Float[Tensor, "view early height width"],
    late: Float[Tensor, "view late height width"],
    groups: int,
) -> Float[Tensor, "view early+late height width"]:
    """Both tensors' channels, group by group, early first."""
    # With channels last in memory, one concatenation is enough; it is three times as fast as one per group.
    parts = [x.movedim(1, -1).unflatten(-1, (groups, -1)) for x in (early, late)]
    return torch.cat(parts, -1).flatten(-2).movedim(-1, 1)


class Tokeniser(nn.Module):
    """Encoder, patches, and one linear layer, 7 x 7 x C -> D (section 4)."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        self.encoder = Encoder(config)
        self.linear = nn.Linear(config.widths[-1] * PATCH_CELLS**2, config.dim)

    def forward(self, stacks: Sequence[EncoderInput]) -> Float[Tensor, "patch dim"]:
        """Tokens of all kept patches of all stacks, in order.

        Only a crop around each image's kept patches is encoded, including the encoder's
        receptive radius. The result depends neither on the size of the crop nor on the
        other images of the batch.
        """
        images = [pair for stack in stacks for pair in zip(stack.channels, stack.kept_on_host, strict=True)]
        # A batch pads all crops to the largest one, which is worthwhile on a GPU but not on a CPU.
        batches = [[pair] for pair in images] if images[0][0].device.type == "cpu" else [images]
        return self.linear(torch.cat([self._encode(batch) for batch in batches]).flatten(1))

    def _encode(
        self, images: Sequence[tuple[Float[Tensor, "channel _h _w"], Bool[Tensor, "_rows _cols"]]]
    ) -> Float[Tensor, "patch feature 7 7"]:
        """Features of the kept patches of these images, in one batch."""
        crops = [find_crop(kept) for _, kept in images]
        size = (max(s[0] for _, s in crops), max(s[1] for _, s in crops))
        windows = []
        places = []
        for number, ((image, kept), ((row, col), _)) in enumerate(zip(images, crops, strict=True)):
            windows.append(crop(image, row * STEP_PX, col * STEP_PX, size))
            places.append(F.pad(torch.nonzero(kept) - torch.tensor([row, col]), (1, 0), value=number))
        features = self.encoder(torch.stack(windows))
        return split(features, torch.cat(places).to(features.device), PATCH_CELLS, STEP_CELLS)


def find_crop(kept: Bool[Tensor, "rows cols"]) -> tuple[tuple[int, int], tuple[int, int]]:
    """The crop of an image that contains all kept patches and the encoder's receptive radius around them.

    Returns its first (row, column) in patch steps, negative outside of the image, and its height
    and width in pixels.
    """
    used = [torch.nonzero(kept.any(axis))[:, 0].tolist() or [0] for axis in (1, 0)]
    row, col = (steps[0] - MARGIN_STEPS for steps in used)
    counts = (steps[-1] - steps[0] + 1 + 2 * MARGIN_STEPS for steps in used)
    return (row, col), padded_size(*(-(-count // CROP_STEPS) * CROP_STEPS for count in counts))


class Decoder(nn.Module):
    """Each token becomes 7 x 7 x C by a linear layer, then 28 x 28 RGB by deconvolutions within the patch."""

    def __init__(self, config: PaperConfig) -> None:
        super().__init__()
        C = config.widths[-1]
        self.linear = nn.Linear(config.dim, C * PATCH_CELLS**2)
        self.layers = nn.Sequential(
            nn.LeakyReLU(SLOPE),
            nn.ConvTranspose2d(C, C, 4, 2, 1),
            nn.LeakyReLU(SLOPE),
            nn.ConvTranspose2d(C, C // 2, 4, 2, 1),
            nn.LeakyReLU(SLOPE),
        )
        self.last = nn.Conv2d(C // 2, 3, 3, 1, 1)
        for layer in (*self.layers, self.last):
            if isinstance(layer, nn.ConvTranspose2d):
                # Each output pixel depends on a quarter of the 4 x 4 kernel.
                nn.init.normal_(layer.weight, 0, (2 / (layer.in_channels * 4)) ** 0.5)
            if isinstance(layer, nn.ConvTranspose2d | nn.Conv2d) and layer.bias is not None:
                nn.init.zeros_(layer.bias)

    def forward(self, tokens: Float[Tensor, "patch dim"]) -> Float[Tensor, "patch 3 28 28"]:
        """RGB patches, approximately in [0, 1] but not clamped."""
        cells = self.linear(tokens).unflatten(1, (-1, PATCH_CELLS, PATCH_CELLS))
        return self.last(self.layers(cells))
