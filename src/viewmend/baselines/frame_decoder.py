"""The decoder that DSTT, FuseFormer and E2FGVI share: features to frames in [-1, 1]."""

from jaxtyping import Float
from torch import Tensor, nn

from viewmend.baselines.hierarchical_encoder import FEATURES, SLOPE


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
