"""Layers that DSTT, FuseFormer and E2FGVI share: encoder and decoder, and overlapping patches as tokens and back."""

from collections.abc import Iterable

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import fold, unfold

SLOPE = 0.2
"""Slope of every LeakyReLU in encoder and decoder."""
STRIDE_PX = 4
"""Pixels per feature cell."""
SHALLOW = 256
"""Channels after the first four convolutions; they are also an input of all later ones."""
FEATURES = 128
"""Channels of a feature map."""
PATCH_CELLS = 7
"""Height and width of a patch in feature cells."""
STEP_CELLS = 3
"""Feature cells from patch to patch."""
MARGIN_CELLS = 3
"""Cells of zeros around the feature map."""
STEP_PX = STRIDE_PX * STEP_CELLS
"""Pixels from token to token."""
DIM = 512
"""Channels of a token."""
FUSION_CHANNELS = 40
"""Channels of the map in which the fusion feed-forward lets neighbouring patches mix."""
FeatureMaps = Float[Tensor, "frame 128 height width"]
"""Features of frames, at a quarter of their size."""
Tokens = Float[Tensor, "frame rows cols 512"]
"""Tokens in the grid of their patches: ceil(height / 3) x ceil(width / 3) of a feature map."""


class HierarchicalEncoder(nn.Module):
    """Nine convolutions in one list, as FuseFormer and E2FGVI name them: `layers.0, .2, ... .16`."""

    def __init__(self) -> None:
        super().__init__()
        deep = ((256, 384, 1), (640, 512, 2), (768, 384, 4), (640, 256, 8), (512, FEATURES, 1))
        self.layers = nn.Sequential(*shallow_layers(), *_deep_layers(deep))

    def forward(self, frames: Float[Tensor, "frame 3 height width"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features at a quarter of the size; height and width are multiples of 4."""
        return with_skips(list(self.layers)[8:], self.layers[:8](frames))


class DeepLayers(nn.Module):
    """DSTT's second half of the encoder: five convolutions on 256 channels, `layers.0, .2, ... .8`."""

    def __init__(self) -> None:
        super().__init__()
        deep = ((256, 256, 1), (512, 256, 2), (512, 256, 4), (512, 256, 8), (512, FEATURES, 1))
        self.layers = _deep_layers(deep)

    def forward(self, shallow: Float[Tensor, "frame 256 rows cols"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features of the same size as `shallow`, the first four convolutions' output."""
        return with_skips(self.layers, shallow)


class UpsampledConvolution(nn.Module):
    """Twice the size, bilinear with corners aligned, then a 3 x 3 convolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, 1, 1)

    def forward(
        self, features: Float[Tensor, "frame inputs rows cols"]
    ) -> Float[Tensor, "frame outputs height width"]:
        """Features of twice the size."""
        return self.conv(
            nn.functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=True)
        )


class FrameDecoder(nn.Sequential):
    """Four convolutions, two of them upsampling; keys `0.conv, 2, 4.conv, 6`."""

    def __init__(self) -> None:
        super().__init__(
            UpsampledConvolution(FEATURES, 128),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Conv2d(128, 64, 3, 1, 1),
            nn.LeakyReLU(SLOPE, inplace=True),
            UpsampledConvolution(64, 64),
            nn.LeakyReLU(SLOPE, inplace=True),
            nn.Conv2d(64, 3, 3, 1, 1),
        )

    def forward(  # pyrefly: ignore[bad-override-param-name]
        self, features: Float[Tensor, "frame 128 rows cols"]
    ) -> Float[Tensor, "frame 3 height width"]:
        """Frames of four times the size, in [-1, 1]."""
        # Not in bfloat16, where tanh near 1 has no slope: a network that outputs black could never change.
        return super().forward(features).float().tanh()


def shallow_layers() -> nn.Sequential:
    """The first four convolutions, `0, 2, 4, 6`: to 256 channels at a quarter of the size."""
    shapes = ((3, 64, 2), (64, 64, 1), (64, 128, 2), (128, SHALLOW, 1))
    return _with_leaks([nn.Conv2d(i, o, 3, stride, 1) for i, o, stride in shapes])


def _deep_layers(shapes: tuple[tuple[int, int, int], ...]) -> nn.Sequential:
    """Convolutions of these inputs, outputs and groups."""
    return _with_leaks([nn.Conv2d(i, o, 3, 1, 1, groups=groups) for i, o, groups in shapes])


def _with_leaks(convolutions: list[nn.Conv2d]) -> nn.Sequential:
    return nn.Sequential(*(layer for c in convolutions for layer in (c, nn.LeakyReLU(SLOPE, inplace=True))))


def with_skips(
    layers: Iterable[nn.Module], shallow: Float[Tensor, "frame 256 rows cols"]
) -> Float[Tensor, "frame channel rows cols"]:
    """Run the layers; every convolution but the first also takes `shallow`, a slice of it per group."""
    features = shallow
    for number, layer in enumerate(layers):
        if number > 0 and isinstance(layer, nn.Conv2d):
            split = [rearrange(x, "f (g c) h w -> f g c h w", g=layer.groups) for x in (shallow, features)]
            features = torch.cat(split, 2).flatten(1, 2)
        features = layer(features)
    return features


def token_grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tokens of a feature map."""
    rows, cols = (-(-cells // STEP_CELLS) for cells in (height, width))
    return rows, cols


def part_of(
    learned: Float[Tensor, "channel rows cols"], size: tuple[int, int]
) -> Float[Tensor, "channel _r _c"]:
    """A map learned for frames of one size; a random part of it for smaller frames in training."""
    spare = [whole - part for whole, part in zip(learned.shape[-2:], size, strict=True)]
    top, left = (int(torch.randint(n + 1, ())) if n else 0 for n in spare)
    return learned[:, top : top + size[0], left : left + size[1]]


class SoftSplit(nn.Module):
    """A token for each patch, by a linear layer `embedding`."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding = nn.Linear(FEATURES * PATCH_CELLS**2, DIM)

    def forward(self, features: FeatureMaps) -> Tokens:
        """Tokens of overlapping patches."""
        rows, cols = token_grid(*features.shape[-2:])
        return rearrange(self.embedding(_patches(features)), "f (r c) d -> f r c d", r=rows, c=cols)


class SoftComposition(nn.Module):
    """Patches from tokens, added up where they overlap.

    Keys: `embedding`; FuseFormer and E2FGVI add a learned map `bias` that fixes the size,
    `bias_size`; E2FGVI-HQ runs a convolution `bias_conv` instead; DSTT does neither.
    """

    def __init__(self, bias_size: tuple[int, int] | None = None, bias_convolution: bool = False) -> None:
        super().__init__()
        self.embedding = nn.Linear(DIM, FEATURES * PATCH_CELLS**2)
        self.bias = nn.Parameter(torch.zeros(FEATURES, *bias_size)) if bias_size else None
        self.bias_conv = nn.Conv2d(FEATURES, FEATURES, 3, 1, 1) if bias_convolution else None

    def forward(self, tokens: Tokens, size: tuple[int, int]) -> FeatureMaps:
        """The feature map of this (height, width)."""
        features = _add_up(self.embedding(rearrange(tokens, "f r c d -> f (r c) d")), size)
        if self.bias is not None:
            features = features + part_of(self.bias, size)
        return features if self.bias_conv is None else self.bias_conv(features)


class FusionFeedForward(nn.Module):
    """Feed-forward whose hidden patches are averaged where they overlap; keys `conv1.0` and `conv2.<last>`.

    `between` are the layers before the second linear layer, whose number is in its key: FuseFormer
    has a ReLU and an (inactive) dropout, `conv2.2`; E2FGVI has a GELU, `conv2.1`.
    """

    def __init__(self, *between: nn.Module) -> None:
        super().__init__()
        hidden = FUSION_CHANNELS * PATCH_CELLS**2
        self.conv1 = nn.Sequential(nn.Linear(DIM, hidden))
        self.conv2 = nn.Sequential(*between, nn.Linear(hidden, DIM))

    def forward(self, tokens: Tokens, size: tuple[int, int]) -> Tokens:
        """The same grid of tokens; `size` is the (height, width) of the feature map they come from."""
        patches = self.conv1(rearrange(tokens, "f r c d -> f (r c) d"))
        overlaps = _add_up(patches.new_ones(1, patches.shape[1], PATCH_CELLS**2), size)
        mixed = _patches(_add_up(patches, size) / overlaps)
        return rearrange(self.conv2(mixed), "f (r c) d -> f r c d", r=tokens.shape[1])


def _patches(features: Float[Tensor, "frame channel height width"]) -> Float[Tensor, "frame token patch"]:
    return unfold(features, PATCH_CELLS, padding=MARGIN_CELLS, stride=STEP_CELLS).transpose(1, 2)


def _add_up(
    patches: Float[Tensor, "frame token patch"], size: tuple[int, int]
) -> Float[Tensor, "frame channel height width"]:
    return fold(patches.transpose(1, 2), size, PATCH_CELLS, padding=MARGIN_CELLS, stride=STEP_CELLS)
