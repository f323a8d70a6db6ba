"""From tokens to pixels, patch by patch, and the blend with what was known (section 7)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.encoder import SLOPE
from viewmend.inpainting.patches import PATCH_CELLS, PATCH_PX

KEEP = -2.0
"""Where a decoder that may keep the fill starts: it replaces an eighth."""


class Decoder(nn.Module):
    """Each token becomes 7 x 7 x C by a linear layer, then 28 x 28 RGB by deconvolutions that see no other patch."""

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        C = config.widths[-1]
        self.norm = nn.LayerNorm(config.dim) if config.token_norms else nn.Identity()
        self.features = C
        self.linear = nn.Linear(config.dim, (C + 3 * config.colour_skip) * PATCH_CELLS**2)
        self.layers = nn.Sequential(
            nn.LeakyReLU(SLOPE),
            nn.ConvTranspose2d(C, C, 4, 2, 1),
            nn.LeakyReLU(SLOPE),
            nn.ConvTranspose2d(C, C // 2, 4, 2, 1),
            nn.LeakyReLU(SLOPE),
        )
        self.refines = config.coarse_fill != "none"
        self.mix = _mix(C // 2 + config.in_channels, C // 2) if self.refines else None
        self.last = nn.Conv2d(C // 2, 3 + self.refines, 3, 1, 1)
        for layer in (*self.layers, self.last):
            if isinstance(layer, nn.ConvTranspose2d):
                # Each output pixel sees a quarter of the 4 x 4 kernel's taps.
                nn.init.normal_(layer.weight, 0, (2 / (layer.in_channels * 4)) ** 0.5)
            if isinstance(layer, nn.ConvTranspose2d | nn.Conv2d) and layer.bias is not None:
                nn.init.zeros_(layer.bias)
        if config.colour_skip:
            # Detail starts small upon the colours that are copied.
            self.last.weight.data.mul_(0.1)

    def forward(
        self, tokens: Float[Tensor, "patch dim"], pixels: Float[Tensor, "patch channel 28 28"]
    ) -> Float[Tensor, "patch output 28 28"]:
        """RGB patches, about [0, 1] but not clamped; upon a coarse fill also how much of it they replace, 0 to 1.

        `pixels` is what the encoder was shown of the patches; the paper's decoder does not look at it.
        """
        cells = self.linear(self.norm(tokens)).unflatten(1, (-1, PATCH_CELLS, PATCH_CELLS))
        detail = self.layers(cells[:, : self.features])
        if self.mix is not None:
            detail = self.mix(torch.cat([detail, pixels.to(detail)], 1))
        out = self.last(detail)
        rgb = out[:, :3]
        if cells.shape[1] > self.features:
            rgb = rgb + nn.functional.interpolate(cells[:, self.features :], size=PATCH_PX, mode="bilinear")
        return torch.cat([rgb, (out[:, 3:] + KEEP).sigmoid()], 1) if self.refines else rgb


def _mix(features: int, width: int) -> nn.Sequential:
    """Three convolutions by which a pixel sees seven others to each side."""
    return nn.Sequential(
        nn.Conv2d(features, width, 3, 1, 1),
        nn.LeakyReLU(SLOPE),
        nn.Conv2d(width, width, 3, 1, 2, dilation=2),
        nn.LeakyReLU(SLOPE),
        nn.Conv2d(width, width, 3, 1, 4, dilation=4),
        nn.LeakyReLU(SLOPE),
    )


def blend(
    known: Float[Tensor, "3 height width"],
    error: Float[Tensor, "height width"],
    inpainted: Float[Tensor, "3 height width"],
    coverage: Float[Tensor, "height width"],
    clamp: bool = True,
) -> Float[Tensor, "3 height width"]:
    """Fhat = E Ftilde + (1 - E) F; bit for bit F where E is 0 or where no patch was decoded.

    With `clamp`, Ftilde is clamped to [0, 1] first.
    """
    mended = error * (inpainted.clamp(0, 1) if clamp else inpainted) + (1 - error) * known
    return torch.where((error > 0) & (coverage > 0), mended, known)
