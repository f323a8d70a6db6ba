"""The objective of section 8 as a module, so that gradients of many processes meet in its backward pass."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.training.losses import ImageLoss, image_loss, slivers
from viewmend.training.plan import Recipe
from viewmend.training.samples import Sample
from viewmend.training.through_tokens import encode_and_decode
from viewmend.training.true_images import true_image
from viewmend.views import ContextViews


@dataclass(frozen=True)
class StepOutput:
    """What a model made of a batch, and its loss."""

    image: ImageLoss
    total: Float[Tensor, ""]
    """The weighted sum, without L_adv."""
    completed: tuple[Float[Tensor, "3 _h _w"], ...]
    """Fhat of each view, upon the model's background; samples one after the other, each as a clip. Empty where only
    rays are trained."""


class Objective(nn.Module):
    """L without L_adv, of a batch of samples of any sizes."""

    def __init__(self, model: Chain | PatchTransformer, recipe: Recipe) -> None:
        super().__init__()
        self.model = model
        self.recipe = recipe
        self.progress = 0.0
        """How much of the run is over: what is annealed, is by this."""
        self.patches.context_gradients = recipe.context_gradients

    @property
    def patches(self) -> PatchTransformer:
        """What attends and decodes."""
        return self.model.patches if isinstance(self.model, Chain) else self.model

    def contexts(self, samples: Sequence[Sample]) -> Sequence[Sequence[ContextFrame | ContextViews]]:
        """What each sample's view is completed from.

        Raises:
            ValueError: a sample's context is encoded already, by what would not learn with it.
        """
        if any(sample.encoded is not None for sample in samples):
            raise ValueError(
                "expected samples with the images of their context, got encoded ones; train `tokens` on them, or give "
                "the shards that they were encoded from"
            )
        return [sample.context for sample in samples]

    def forward(self, batch: list[Sample]) -> StepOutput:
        """All terms of `batch`.

        Raises:
            ValueError: attention is to be taught, and a sample does not say by what; or a sample is of another kind
                than what is trained.
        """
        weights = self.recipe.loss
        views = [sample for last in batch for sample in last.clip]
        if weights.attention and any(sample.matches is None for sample in views):
            raise ValueError(
                "expected samples that say where their context shows what they miss, got one that does not; make "
                "samples with --matches, or train without --attention"
            )
        contexts = self.contexts(views)
        kept = None
        if weights.autoencoder:
            looked_at = [self.patches.looked_at(s.view, s.context) for s in views]
            contexts, kept = encode_and_decode(self.patches, looked_at, weights.channels)
        predictions = self.model(
            [s.view for s in views],
            contexts,
            ray_views=[s.ray_views for s in views],
            matches=[s.matches for s in views] if weights.attention else (),
        )
        made, counted = [p.inpainted for p in predictions], [p.coverage for p in predictions]
        if weights.outside == "image":
            pairs = zip(predictions, made, strict=True)
            made = [torch.where(p.coverage > 0, image, p.upon_own.detach()) for p, image in pairs]
            counted = [torch.ones_like(coverage) for coverage in counted]
        truth = [true_image(s, self.model.background) for s in views]
        error = [s.view.error for s in views]
        for n, part in enumerate(s.view.part for s in views):
            if part is not None:
                error[n], counted[n] = error[n] * part.inner[0], counted[n] * part.inner[0]
        if self.progress < weights.wide_first:
            counts = [(~slivers(E)).float() for E in error]
            error, counted = ([x * own for x, own in zip(many, counts, strict=True)] for many in (error, counted))
        image = image_loss(made, counted, error, truth, weights.channels)
        total = weights.image * (image.inside + image.outside) + weights.log_error * image.log_error
        missed = [p.missed for p in predictions if p.missed is not None]
        if missed:
            total = total + weights.attention * (1 - self.progress) * torch.stack(missed).mean()
        if kept is not None:
            total = total + weights.autoencoder * kept
        return StepOutput(image, total, tuple(p.upon_own for p in predictions))
