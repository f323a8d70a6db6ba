"""Training of the ray fill, `rays`, alone: on pixels whose rays are sampled once, and stored instead of their views.

A batch of rays takes a hundredth of a sample's size and holds most of a step's work, so a buffer or
a folder of shards covers thousands of scenes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Annotated

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from viewmend.models.views.config import RaysConfig
from viewmend.models.views.pyramids import SourceCameras
from viewmend.models.views.ray_fill import RayFill, RayInputs, gather_ray_inputs
from viewmend.training.config import ObjectiveConfig, SamplingConfig, SceneConfig, SceneSource, TrainConfig
from viewmend.training.objective import (
    MIN_SQUARE,
    HoleValidation,
    ImageLoss,
    Objective,
    StepOutput,
    load_start,
    mean_loss,
)
from viewmend.training.samples import Sample
from viewmend.training.scenes import sample_scenes, validation_scenes
from viewmend.training.shards import storable
from viewmend.utils.options import HIDDEN

PIXELS_PER_VIEW = 64
"""Hole pixels of a view whose rays are kept, at most."""


@storable
@dataclass(frozen=True)
class RayBatch:
    """`RayInputs` of some hole pixels of a view, in few bytes, with their ground truth."""

    features: Float[Tensor, "pixel point view 14"]
    """Half precision."""
    smallest_masks: Float[Tensor, "pixel point 4"]
    """Half precision."""
    window: UInt8[Tensor, "pixel 8 11 11"]
    """`RayInputs.window` in 255ths."""
    neighbourhoods: UInt8[Tensor, "neighbourhood 12 11 11"]
    """`RayInputs.neighbourhoods` in 255ths."""
    neighbourhood_index: Int[Tensor, "pixel"]
    """Index into `neighbourhoods` of each pixel."""
    truth: UInt8[Tensor, "pixel 3"]
    """F* of each pixel, in 255ths."""

    @classmethod
    def of(cls, sample: Sample, max_pixels: int, random: Random) -> "RayBatch":
        """Random hole pixels of a sample."""
        holes = torch.nonzero(sample.view.error > 0)
        pixels = holes[random.sample(range(len(holes)), min(max_pixels, len(holes)))]
        sources = SourceCameras.of(sample.ray_views, sample.view.silhouettes) if sample.ray_views else None
        inputs = gather_ray_inputs(sample.view, sources, pixels)
        return cls(
            inputs.features.half(),
            inputs.smallest_masks.half(),
            (255 * inputs.window).round().to(torch.uint8),
            (255 * inputs.neighbourhoods).round().to(torch.uint8),
            inputs.neighbourhood_index,
            sample.truth[:, *pixels.unbind(1)].T.contiguous(),
        )

    def inputs(self) -> RayInputs:
        """The inputs of `RayFill`."""
        window = self.window.float() / 255
        neighbourhoods = self.neighbourhoods.float() / 255
        masks = self.smallest_masks.float()
        return RayInputs(self.features.float(), masks, window, neighbourhoods, self.neighbourhood_index)


@dataclass(frozen=True)
class RayBatchScenes:
    """The samples of a source as batches of rays."""

    scenes: SceneSource[Sample]
    seed: str
    max_pixels: int = PIXELS_PER_VIEW

    def scene(self, number: int) -> list[RayBatch]:
        """A batch for each sample of scene `number`."""
        random = Random(f"{self.seed}/pixels/{number}")
        return [RayBatch.of(sample, self.max_pixels, random) for sample in self.scenes.scene(number)]


class RaysObjective(Objective[RayFill]):
    """L1 and logarithmic error of the colours of hole pixels."""

    def __init__(self, config: TrainConfig, options: "RaysObjectiveConfig", start: nn.Module | None) -> None:
        super().__init__(config, RayFill(options.model))
        load_start(self.model, start)
        self.log_error = options.log_error
        self.loss_summary = f"L1 in the holes, {options.log_error:g} x log error"
        scenes = validation_scenes(config.scenes, options.sampling)
        self.validation = HoleValidation(scenes, config.validation_views, _complete, "black")

    def forward(self, batch: Sequence[RayBatch]) -> StepOutput:
        """Both terms, the means over the views."""
        inputs = RayInputs.cat([one.inputs() for one in batch])
        colours = self.model.mix(inputs).float().split([len(one.truth) for one in batch])
        pairs = zip(colours, batch, strict=True)
        loss = mean_loss([pixel_loss(colour, one.truth.float() / 255) for colour, one in pairs])
        return StepOutput(loss, loss.inside + self.log_error * loss.log_error)


@dataclass(frozen=True, kw_only=True)
class RaysObjectiveConfig(ObjectiveConfig):
    """Trains `RayFill`."""

    model: Annotated[RaysConfig, HIDDEN] = field(default_factory=RaysConfig)
    sampling: Annotated[SamplingConfig, HIDDEN] = field(
        default_factory=lambda: SamplingConfig(num_ray_views=8, min_hole_px=15)
    )
    make_objective = RaysObjective
    item = RayBatch
    log_error: float = 2.0
    """Weight of log10 of a view's squared error in the holes; their L1 has weight 1."""

    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[RayBatch]:
        """See `ObjectiveConfig.make_scenes`."""
        return RayBatchScenes(sample_scenes(scenes, self.sampling, seed), seed)


def pixel_loss(predicted: Float[Tensor, "pixel 3"], truth: Float[Tensor, "pixel 3"]) -> ImageLoss:
    """The losses of some hole pixels of a view; 0 if there are none."""
    if not len(truth):
        zero = predicted.sum()
        return ImageLoss(zero, zero, zero)
    squares = (predicted - truth).square().mean()
    return ImageLoss(
        (predicted - truth).abs().mean(), torch.zeros_like(squares), (squares + MIN_SQUARE).log10()
    )


def _complete(model: nn.Module, sample: Sample) -> Float[Tensor, "3 height width"]:
    """The view with its holes filled."""
    assert isinstance(model, RayFill)
    sources = SourceCameras.of(sample.ray_views, sample.view.silhouettes) if sample.ray_views else None
    return model(sample.view, sources)
