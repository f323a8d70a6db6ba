"""From tokens to pixels, patch by patch (section 7)."""

from jaxtyping import Float
from torch import Tensor, nn

from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.patches import PATCH_CELLS
from viewmend.models.paper.tokenizer import SLOPE


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
