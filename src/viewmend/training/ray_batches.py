"""Samples as the ray reader alone needs them: some missing pixels, looked up in the cameras once. Ours.

A hundredth of a sample's size, and most of a step's work: a buffer, or a folder of shards, holds thousands of scenes.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.ray_blend_net import RayBlendNet, RayInputs, look_around
from viewmend.inpainting.ray_sampling import CELL_CHANNELS, RayFeatures
from viewmend.training.losses import mean_loss, pixel_loss
from viewmend.training.objective import StepOutput
from viewmend.training.plan import Recipe
from viewmend.training.samples import Sample, to_device
from viewmend.training.scenes import SceneSource

DARKEST = 0.6
"""Least of the gains of augmented colours."""
BLINDED_SHARE, MOST_BLIND = 0.3, 3
"""Share of the augmented samples that lose cameras, and how many at most."""


@dataclass(frozen=True)
class RayBatch:
    """What the cameras show along the rays of some missing pixels of a sample."""

    features: Float[Tensor, "pixel point view 14"]
    """`RayInputs.features`, half precision."""
    occupancy: Float[Tensor, "pixel point 4"]
    around: UInt8[Tensor, "pixel 8 11 11"]
    """The view about each pixel, in 255ths."""
    far: UInt8[Tensor, "place 12 11 11"]
    """What is farther around each distinct place, in 255ths."""
    place: Int[Tensor, "pixel"]
    """Index into `far` of each pixel's place."""
    truth: UInt8[Tensor, "pixel 3"]
    """F* of each pixel, in 255ths."""

    def to(self, device: torch.device | str) -> "RayBatch":
        """The same on `device`."""
        return to_device(self, device)

    def inputs(self) -> RayInputs:
        """The rays as `RayBlendNet` takes them."""
        around, far = self.around.float() / 255, self.far.float() / 255
        return RayInputs(self.features.float(), self.occupancy.float(), around, far, self.place)


class RayBatchScenes:
    """A source's scenes, of each sample at most so many random missing pixels; the same for the same number."""

    def __init__(self, scenes: SceneSource[Sample | RayBatch], seed: str, most_px: int) -> None:
        self.scenes = scenes
        self.seed = seed
        self.most_px = most_px

    def scene(self, number: int) -> list[RayBatch]:
        """Scene `number`; what was looked up before stays as it is."""
        random = Random(f"{self.seed}/pixels/{number}")
        return [s if isinstance(s, RayBatch) else ray_batch(s, self.most_px, random) for s in self.scenes.scene(number)]


def ray_batch(sample: Sample, most_px: int, random: Random) -> RayBatch:
    """The sample at no more than `most_px` of its missing pixels."""
    missing = torch.nonzero(sample.view.error > 0)
    pixels = missing[random.sample(range(len(missing)), min(most_px, len(missing)))]
    seen = look_around(sample.view, sample.ray_views, pixels)
    return RayBatch(
        seen.features.half(),
        seen.consistency.half(),
        (255 * seen.window).round().to(torch.uint8),
        (255 * seen.surroundings).round().to(torch.uint8),
        seen.place,
        sample.truth[:, *pixels.unbind(1)].T.contiguous(),
    )


def augmented(batch: RayBatch) -> RayBatch:
    """The same pixels as they might have been, by torch's random numbers: other colours, turned, with fewer cameras.

    Channels change places and everything gets darker, for cameras, surroundings and truth alike; the surroundings are
    flipped and turned; of three tenths of the samples up to three cameras that did not colour the view see nothing.
    """
    channels, gain = torch.randperm(3), float(torch.empty(()).uniform_(DARKEST, 1))
    features, around, far = (values.clone() for values in (batch.features, batch.around, batch.far))
    seen = RayFeatures.unstack(features)
    for colour in (seen.colour, seen.mean_colour):
        colour[...] = gain * colour[..., channels]
    for values, first in ((around, 0), (around, 5), (far, 0), (far, CELL_CHANNELS)):
        values[:, first : first + 3] = (gain * values[:, first + channels].float()).round().to(torch.uint8)
    flipped = [axis for axis in (2, 3) if bool(torch.rand(()) < 0.5)]
    around, far = around.flip(flipped), far.flip(flipped)
    if bool(torch.rand(()) < 0.5):
        around, far = around.transpose(2, 3), far.transpose(2, 3)
    if bool(torch.rand(()) < BLINDED_SHARE) and features.numel():
        blind = torch.randperm(features.shape[2])[: int(torch.randint(1, MOST_BLIND + 1, ()))].to(features.device)
        sources = (seen.is_source[:, :, blind] > 0).flatten(0, 1).any(0)[:, 0]
        features[:, :, blind[~sources]] = 0
    truth = (gain * batch.truth[:, channels].float()).round().to(torch.uint8)
    return RayBatch(features, batch.occupancy, around, far, batch.place, truth)


class RaysObjective(nn.Module):
    """L_in, and the logarithmic error, of what the ray reader makes of the pixels of a batch."""

    def __init__(self, model: Chain, recipe: Recipe) -> None:
        super().__init__()
        self.model = model
        self.recipe = recipe

    def forward(self, batch: Sequence[RayBatch]) -> StepOutput:
        """Both terms, the means over the samples."""
        assert isinstance(self.model.coarse, RayBlendNet), "recipes that train rays have a model that reads them"
        batch = [augmented(one) for one in batch] if self.recipe.augment else batch
        told = RayInputs.cat([one.inputs() for one in batch])
        colours = self.model.coarse.mix(told).float().split([len(b.truth) for b in batch])
        loss = mean_loss([pixel_loss(c, b.truth.float() / 255) for c, b in zip(colours, batch, strict=True)])
        weights = self.recipe.loss
        return StepOutput(loss, weights.image * loss.inside + weights.log_error * loss.log_error, ())
