"""The encoder and the decoder that DSTT, FuseFormer and E2FGVI share: frames to features at 1/4, and back."""

from collections.abc import Iterable

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

SLOPE = 0.2
"""Slope of every LeakyReLU in encoder and decoder."""
STRIDE_PX = 4
"""Pixels per feature cell."""
SHALLOW, FEATURES = 256, 128
"""Channels after the first four convolutions (what later ones see again) and at the end."""


class HierarchicalEncoder(nn.Module):
    """Nine convolutions in one list, as FuseFormer and E2FGVI name them: `layers.0, .2, ... .16`."""

    def __init__(self, channels: int = 3) -> None:
        super().__init__()
        deep = ((256, 384, 1), (640, 512, 2), (768, 384, 4), (640, 256, 8), (512, FEATURES, 1))
        self.layers = nn.Sequential(
            *shallow_layers(channels), *_with_leaks(_convolution(i, o, 1, g) for i, o, g in deep)
        )

    def forward(self, frames: Float[Tensor, "frame channel height width"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features at a quarter of the size; height and width are multiples of 4."""
        layers = list(self.layers)
        return with_skips(layers[8:], nn.Sequential(*layers[:8])(frames))


class DeepLayers(nn.Module):
    """DSTT's second half of the encoder: five convolutions on 256 channels, `layers.0, .2, ... .8`."""

    def __init__(self) -> None:
        super().__init__()
        deep = ((256, 256, 1), (512, 256, 2), (512, 256, 4), (512, 256, 8), (512, FEATURES, 1))
        self.layers = nn.Sequential(*_with_leaks(_convolution(i, o, 1, g) for i, o, g in deep))

    def forward(self, shallow: Float[Tensor, "frame 256 rows cols"]) -> Float[Tensor, "frame 128 rows cols"]:
        """Features of the same size as `shallow`, the first four convolutions' output."""
        return with_skips(list(self.layers), shallow)


class UpsampledConvolution(nn.Module):
    """Twice the size, bilinear with corners aligned, then a 3 x 3 convolution."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, 1, 1)

    def forward(self, features: Float[Tensor, "frame inputs rows cols"]) -> Float[Tensor, "frame outputs height width"]:
        """Features of twice the size."""
        return self.conv(nn.functional.interpolate(features, scale_factor=2, mode="bilinear", align_corners=True))


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

    def forward(self, features: Float[Tensor, "frame 128 rows cols"]) -> Float[Tensor, "frame 3 height width"]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Frames of four times the size, in [-1, 1]."""
        # Not in bfloat16, where tanh near 1 is 1 and has no slope: who learned black would never leave it.
        return super().forward(features).float().tanh()


def shallow_layers(channels: int = 3) -> nn.Sequential:
    """The first four convolutions, `0, 2, 4, 6`: to 256 channels at a quarter of the size."""
    shapes = ((channels, 64, 2), (64, 64, 1), (64, 128, 2), (128, SHALLOW, 1))
    return nn.Sequential(*_with_leaks(_convolution(i, o, stride) for i, o, stride in shapes))


def with_skips(
    layers: list[nn.Module], shallow: Float[Tensor, "frame 256 rows cols"]
) -> Float[Tensor, "frame channel rows cols"]:
    """Runs the layers; every convolution but the first also sees `shallow`, a slice of it for each of its groups."""
    features = shallow
    for number, layer in enumerate(layers):
        if number > 0 and isinstance(layer, nn.Conv2d):
            features = _interleave(shallow, features, layer.groups)
        features = layer(features)
    return features


def _interleave(
    first: Float[Tensor, "frame a rows cols"], second: Float[Tensor, "frame b rows cols"], groups: int
) -> Float[Tensor, "frame c rows cols"]:
    split = [rearrange(x, "f (g c) h w -> f g c h w", g=groups) for x in (first, second)]
    return rearrange(torch.cat(split, 2), "f g c h w -> f (g c) h w")


def _convolution(inputs: int, outputs: int, stride: int = 1, groups: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, 1, groups=groups)


def _with_leaks(convolutions: Iterable[nn.Conv2d]) -> Iterable[nn.Module]:
    for convolution in convolutions:
        yield convolution
        yield nn.LeakyReLU(SLOPE, inplace=True)
