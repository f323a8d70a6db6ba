"""Aggregates what the source cameras show of each ray sample, and scores whether the surface is there."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.threads import all_threads, parallel_for
from viewmend.models.views.config import COLOUR, CONTRAST, IN_VIEW, NUM_FEATURES, NUM_STATISTICS, RGBA
from viewmend.models.views.sampler import RaySamples

BAND = 1024
"""A thread aggregates about this many samples at a time."""


class AggregatedSamples(NamedTuple):
    """Ray samples after aggregation over cameras."""

    rgba: Float[Tensor, "ray sample 4"]
    """The weighted means of the cameras' RGB on black, and of their masks."""
    features: Float[Tensor, "ray sample feature"]
    score: Float[Tensor, "ray sample"]
    """Evidence that the surface is at the sample."""
    trust: Float[Tensor, "ray sample view"]
    """Weights of the cameras; the sum is 1, or 0 where none has the sample in view."""

    @classmethod
    def cat(cls, parts: Sequence["AggregatedSamples"]) -> "AggregatedSamples":
        """All rays of these parts."""
        if len(parts) == 1:
            return parts[0]
        return cls(*(torch.cat(values) for values in zip(*parts, strict=True)))


class SampleAggregator(nn.Module):
    """One hidden layer per camera and sample, a softmax over cameras, and a small network per sample."""

    def __init__(self, width: int, channels: int) -> None:
        super().__init__()
        self.camera = nn.Linear(NUM_FEATURES, width)
        self.all_cameras = nn.Linear(NUM_STATISTICS, width)
        self.trust = nn.Linear(width, 1)
        inputs = width + NUM_FEATURES + 3 + NUM_STATISTICS + 1
        self.sample = nn.Sequential(
            nn.Linear(inputs, 2 * width),
            nn.ReLU(),
            nn.Linear(2 * width, channels + 1),
        )

    def forward(
        self, samples: RaySamples, prior: Float[Tensor, "ray sample view"] | None = None
    ) -> AggregatedSamples:
        """The aggregated samples; `prior` replaces the initial weights of the cameras."""
        features = samples.features
        statistics = samples.statistics
        if prior is None:
            prior = samples.prior
        if features.device.type == "cpu" and not torch.is_grad_enabled():
            return self._aggregate_numba(samples, prior)

        # The trust in each camera
        hidden = F.relu(self.camera(features) + self.all_cameras(statistics)[:, :, None])
        score = self.trust(hidden)[..., 0].float() + (prior + 1e-3).log()
        inside = features[..., IN_VIEW]
        trust = inside * score.masked_fill(inside == 0, -1e4).softmax(2)

        # What the trusted cameras show, and how much they agree
        summary = _weighted_sum(trust.to(hidden), hidden)
        with torch.autocast(features.device.type, enabled=False):  # colours need more than eight bits
            mean = _weighted_sum(trust, features)
            square = _weighted_sum(trust, features[..., COLOUR].square())
        colour = mean[..., COLOUR]
        variance = CONTRAST * torch.addcmul(square, colour, colour, value=-1).clamp_min(0)
        certainty = trust.square().sum(2, keepdim=True)
        out = self.sample(torch.cat([summary.float(), mean, variance, statistics, certainty], -1))
        return AggregatedSamples(mean[..., RGBA], out[..., :-1], out[..., -1], trust)

    def _aggregate_numba(
        self, samples: RaySamples, prior: Float[Tensor, "ray sample view"]
    ) -> AggregatedSamples:
        """`forward` in float32 by a compiled loop: sums over a few cameras are slow in PyTorch."""
        from viewmend.models.views._sampler_numba import aggregate

        count, per_ray, views = prior.shape
        with torch.autocast("cpu", enabled=False), all_threads():
            hidden = samples.features @ self.camera.weight.T.float()
            shared = self.all_cameras(samples.statistics) + self.camera.bias.float()
            weight = self.trust.weight[0].float()
            bias = float(self.trust.bias)
            inputs = torch.zeros(count, per_ray, len(weight) + NUM_FEATURES + 3 + NUM_STATISTICS + 1)
            trust = torch.empty(count, per_ray, views)
            tensors = (
                samples.features,
                samples.statistics,
                prior.contiguous(),
                hidden,
                shared,
                weight,
                inputs,
                trust,
            )
            arrays = [tensor.numpy() for tensor in tensors]
            rays = -(-BAND // per_ray)

            def work(band: int) -> None:
                aggregate(band * rays, min(count, (band + 1) * rays), bias, *arrays)

            parallel_for(work, -(-count // rays))
            out = self.sample(inputs)
        mean = inputs[..., len(weight) :]
        return AggregatedSamples(mean[..., RGBA], out[..., :-1], out[..., -1], trust)


def _weighted_sum(
    trust: Float[Tensor, "ray sample view"], values: Float[Tensor, "ray sample view value"]
) -> Float[Tensor, "ray sample value"]:
    """Sums over cameras."""
    rays, samples, views, channels = values.shape  # -1 would be ambiguous without rays
    weights = trust.reshape(rays * samples, 1, views)
    summed = torch.bmm(weights, values.reshape(rays * samples, views, channels))
    return summed.view(rays, samples, channels)
