"""Overlapping patches as tokens, and back (FuseFormer): soft split, soft composition, fusion feed-forward."""

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import fold, unfold

from viewmend.contrib.baselines.frame_coder import FEATURES, STRIDE_PX

PATCH_CELLS, STEP_CELLS, MARGIN_CELLS = 7, 3, 3
"""Patches are 7 x 7 feature cells, one every 3, with 3 cells of zeros around the map."""
STEP_PX = STRIDE_PX * STEP_CELLS
"""Pixels from token to token."""
DIM = 512
"""Channels of a token."""
FUSION_CHANNELS = 40
"""Channels of the map in which the fusion feed-forward lets neighbouring patches mix."""

Tokens = Float[Tensor, "frame rows cols 512"]
"""Tokens in the grid of their patches: ceil(height / 3) x ceil(width / 3) of a feature map."""


def token_grid(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of tokens of a feature map."""
    rows, cols = (-(-cells // STEP_CELLS) for cells in (height, width))
    return rows, cols


def part_of(learned: Float[Tensor, "channel rows cols"], size: tuple[int, int]) -> Float[Tensor, "channel _r _c"]:
    """A map learned for frames of one size; in training on smaller frames, a part of it, each time another."""
    spare = [whole - part for whole, part in zip(learned.shape[-2:], size, strict=True)]
    top, left = (int(torch.randint(n + 1, ())) if n else 0 for n in spare)
    return learned[:, top : top + size[0], left : left + size[1]]


class SoftSplit(nn.Module):
    """A token for each patch, by a linear layer `embedding`."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding = nn.Linear(FEATURES * PATCH_CELLS**2, DIM)

    def forward(self, features: Float[Tensor, "frame 128 height width"]) -> Tokens:
        """Tokens of overlapping patches."""
        rows, cols = token_grid(*features.shape[-2:])
        return rearrange(self.embedding(_patches(features)), "f (r c) d -> f r c d", r=rows, c=cols)


class SoftComposition(nn.Module):
    """Patches from tokens, added up where they overlap.

    Keys: `embedding`; FuseFormer and E2FGVI add a learned map `bias` that fixes the size, `bias_size`; E2FGVI-HQ runs
    a convolution `bias_conv` instead; DSTT does neither.
    """

    def __init__(self, bias_size: tuple[int, int] | None = None, bias_convolution: bool = False) -> None:
        super().__init__()
        self.embedding = nn.Linear(DIM, FEATURES * PATCH_CELLS**2)
        self.bias = nn.Parameter(torch.zeros(FEATURES, *bias_size)) if bias_size else None
        self.bias_conv = nn.Conv2d(FEATURES, FEATURES, 3, 1, 1) if bias_convolution else None

    def forward(self, tokens: Tokens, size: tuple[int, int]) -> Float[Tensor, "frame 128 height width"]:
        """The feature map of this (height, width)."""
        features = _add_up(self.embedding(rearrange(tokens, "f r c d -> f (r c) d")), size)
        if self.bias is not None:
            features = features + part_of(self.bias, size)
        return features if self.bias_conv is None else self.bias_conv(features)


class FusionFeedForward(nn.Module):
    """Feed-forward whose hidden patches are averaged where they overlap; keys `conv1.0` and `conv2.<last>`.

    `between` is what stands before the second linear layer and so counts in its key: FuseFormer has a ReLU and a
    dropout (that drops nothing), `conv2.2`; E2FGVI a GELU alone, `conv2.1`.
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


def _patches(
    features: Float[Tensor, "frame channel height width"],
) -> Float[Tensor, "frame token patch"]:
    return unfold(features, PATCH_CELLS, padding=MARGIN_CELLS, stride=STEP_CELLS).transpose(1, 2)


def _add_up(
    patches: Float[Tensor, "frame token patch"], size: tuple[int, int]
) -> Float[Tensor, "frame channel height width"]:
    return fold(patches.transpose(1, 2), size, PATCH_CELLS, padding=MARGIN_CELLS, stride=STEP_CELLS)
