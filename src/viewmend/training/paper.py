"""Training of the paper's transformer by the paper's objective (section 8)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.config import paper as paper_model
from viewmend.models.paper.patch_transformer import PatchTransformer, Prediction
from viewmend.training.adversarial import GAN, Adversary, Discriminator, Judged
from viewmend.training.config import ObjectiveConfig, SamplingConfig, SceneConfig, SceneSource, TrainConfig
from viewmend.training.objective import (
    HoleValidation,
    ImageLoss,
    Objective,
    StepOutput,
    image_loss,
    load_start,
)
from viewmend.training.samples import Sample, true_image
from viewmend.training.scenes import sample_scenes, validation_scenes
from viewmend.training.shared_rigs import SharedRigScenes
from viewmend.utils.options import HIDDEN, NEGATED

WINDOW = (0, 10, 20, 27, 28, 29, 30)
"""The paper's temporal window of frame 30: t, t - 1, t - 2, t - 3, t - 10, t - 20 and t - 30."""
SAMPLING = SamplingConfig(
    frames=WINDOW,
    min_history=len(WINDOW) - 1,
    with_context=True,
    num_source_views=(3,),
    source_view_weights=(1,),
)
"""Samples with three source views and a complete window."""


class PaperObjective(Objective[PatchTransformer]):
    """Section 8: L1 inside and outside the holes, on the network's own image Ftilde, and L_adv on Fhat."""

    scores_training_views = True

    def __init__(self, config: TrainConfig, options: "PaperObjectiveConfig", start: nn.Module | None) -> None:
        super().__init__(config, PatchTransformer(options.model))
        load_start(self.model, start)
        self.loss_summary = "L1 inside and outside the holes (section 8)"
        if options.adversarial:
            self.loss_summary += f", {options.adversarial:g} x adversarial"
            self.adversary = Adversary(
                Discriminator("image"), GAN, options.adversarial, options.discriminator_rate
            )
        self.validation = HoleValidation(
            unseen_scenes(config.scenes, options.sampling),
            config.validation_views,
            _complete,
            options.model.background,
            {"seen": self.training_scenes(f"{config.seed}/0"), "alike": self._scenes_alike()},
        )
        if not options.train_encoder:
            self.model.tokeniser.requires_grad_(False)

    def _scenes_alike(self) -> SceneSource[Sample]:
        """New scenes of the people that the run trains on."""
        options = self.config.objective
        return options.make_scenes(self.config.scenes, f"{self.config.seed}/alike")

    def forward(self, batch: Sequence[Sample]) -> StepOutput:
        """All terms of a batch of samples of any sizes."""
        predictions = self.model([s.view for s in batch], [s.context for s in batch])
        truth = [true_image(s, self.model.config.background) for s in batch]
        missing = [s.view.missing for s in batch]
        masks = [s.view.target_mask for s in batch]
        inside = [
            torch.ones_like(s.view.mask) if mask is None else mask
            for s, mask in zip(batch, masks, strict=True)
        ]
        image = paper_image_loss(predictions, missing, truth, inside)
        judged = Judged(truth, [p.composited.float() for p in predictions], missing)
        return StepOutput(image, image.inside + image.outside, judged)


@dataclass(frozen=True, kw_only=True)
class PaperObjectiveConfig(ObjectiveConfig):
    """Trains `PatchTransformer`: L_in + L_out + lambda_adv L_adv."""

    model: Annotated[PaperConfig, HIDDEN] = field(default_factory=paper_model)
    sampling: Annotated[SamplingConfig, HIDDEN] = SAMPLING
    make_objective = PaperObjective
    item = Sample
    adversarial: float = 0.01
    """Weight lambda_adv of the adversarial loss; 0 trains without a discriminator."""
    discriminator_rate: float = 1e-4
    """Learning rate of the discriminator."""
    train_encoder: Annotated[bool, NEGATED] = True
    """Leave the encoder as it is, which takes half the time; for a run that starts from trained weights."""

    def make_scenes(self, scenes: SceneConfig, seed: str) -> SceneSource[Sample]:
        """See `ObjectiveConfig.make_scenes`."""
        if scenes.shared_hull and not scenes.captures:
            return SharedRigScenes(scenes, self.sampling, seed)
        return sample_scenes(scenes, self.sampling, seed)


def unseen_scenes(scenes: SceneConfig, sampling: SamplingConfig) -> SceneSource[Sample]:
    """Samples of procedural people reserved for validation, from rigs like those of the training."""
    if scenes.shared_hull:
        return SharedRigScenes(replace(scenes, num_holdout_views=3), sampling, "validation", "validation")
    return validation_scenes(scenes, sampling)


def paper_image_loss(
    predictions: Sequence[Prediction],
    error: Sequence[Float[Tensor, "_h _w"]],
    truth: Sequence[Float[Tensor, "3 _h _w"]],
    counted: Sequence[Float[Tensor, "_h _w"]] | None = None,
) -> ImageLoss:
    """L_in and L_out with channels summed, over all pixels or those `counted`.

    Where no patch was inpainted, the view itself stands for Ftilde.
    """
    made = [torch.where(p.coverage > 0, p.inpainted, p.composited.detach()) for p in predictions]
    return image_loss(
        made, counted or [torch.ones_like(p.coverage) for p in predictions], error, truth, "sum"
    )


def _complete(model: nn.Module, sample: Sample) -> Float[Tensor, "3 height width"]:
    """Fhat on the model's background."""
    assert isinstance(model, PatchTransformer)
    return model([sample.view], [list(sample.context)])[0].composited
