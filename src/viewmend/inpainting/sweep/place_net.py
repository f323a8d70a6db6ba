"""Weighs the cameras at places along rays, and says what speaks for the surface being there. Ours."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import heavy_operations
from viewmend.inpainting.sweep.lookup import COLOUR, CONTRAST, FEATURES, IN_VIEW, MASK, STATS, Places


class Weighed(NamedTuple):
    """What was made of places along rays."""

    colour: Float[Tensor, "ray place 3"]
    """What the trusted cameras show, upon black."""
    mask: Float[Tensor, "ray place 1"]
    """What their masks show."""
    features: Float[Tensor, "ray place feature"]
    score: Float[Tensor, "ray place"]
    """How much speaks for the surface."""
    trust: Float[Tensor, "ray place view"]
    """Shares of the cameras; the sum is 1, or 0 where none has the place in view."""


class PlaceNet(nn.Module):
    """One hidden layer for each camera at each place, a softmax over cameras, and a small network for the place."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.camera = nn.Linear(FEATURES, width)
        self.all_cameras = nn.Linear(STATS, width)
        self.trust = nn.Linear(width, 1)
        told = width + FEATURES + 3 + STATS + 1
        self.place = nn.Sequential(nn.Linear(told, 2 * width), nn.ReLU(), nn.Linear(2 * width, channels + 1))

    def forward(self, places: Places, prior: Float[Tensor, "ray place view"] | None = None) -> Weighed:
        """The places, weighed; cameras are trusted by `prior` at first, or by the lookup's own opinion."""
        features, stats = places.features, places.stats
        prior = places.prior if prior is None else prior
        if features.device.type == "cpu" and not torch.is_grad_enabled():
            return self._weighed_numba(places, prior)
        hidden = F.relu(self.camera(features) + self.all_cameras(stats)[:, :, None])
        score = self.trust(hidden)[..., 0].float() + (prior + 1e-3).log()
        inside = features[..., IN_VIEW]
        trust = inside * score.masked_fill(inside == 0, -1e4).softmax(2)
        kept = _weighted(trust.to(hidden), hidden)
        with torch.autocast(features.device.type, enabled=False):  # colours need more than eight bits
            agreed = _weighted(trust, features)
            square = _weighted(trust, features[..., COLOUR].square())
        variance = CONTRAST * (square - agreed[..., COLOUR].square()).clamp_min(0)
        certain = trust.square().sum(2, keepdim=True)
        out = self.place(torch.cat([kept.float(), agreed, variance, stats, certain], -1))
        return Weighed(agreed[..., COLOUR], agreed[..., MASK], out[..., :-1], out[..., -1], trust)

    def _weighed_numba(self, places: Places, prior: Float[Tensor, "ray place view"]) -> Weighed:
        """The same in float32 by a compiled loop, since sums over so few cameras are slow in torch."""
        from viewmend.inpainting.sweep._weigh_numba import weigh_numba

        with torch.autocast("cpu", enabled=False), heavy_operations():
            hidden = places.features @ self.camera.weight.T.float()
            shared = self.all_cameras(places.stats) + self.camera.bias.float()
            weight, bias = self.trust.weight[0].float(), float(self.trust.bias)
            told, trust = weigh_numba(places, prior.contiguous(), hidden, shared, weight, bias)
            out, agreed = self.place(told), told[..., len(weight) :]
        return Weighed(agreed[..., COLOUR], agreed[..., MASK], out[..., :-1], out[..., -1], trust)


def _weighted(
    trust: Float[Tensor, "ray place view"], values: Float[Tensor, "ray place view value"]
) -> Float[Tensor, "ray place value"]:
    """Sums over cameras."""
    rays, places, views, channels = values.shape  # all named: there may be no rays
    summed = torch.bmm(trust.reshape(rays * places, 1, views), values.reshape(rays * places, views, channels))
    return summed.view(rays, places, channels)
