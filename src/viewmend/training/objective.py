"""The objective of section 8 as a module, so that gradients of many processes meet in its backward pass."""

from dataclasses import dataclass
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.patch_transformer import PatchTransformer, Prediction
from viewmend.training.losses import ImageLoss, image_loss
from viewmend.training.perceptual_loss import load_vgg16, perceptual_loss
from viewmend.training.plan import Recipe
from viewmend.training.samples import Sample
from viewmend.training.temporal_loss import temporal_loss
from viewmend.views import CompletedView


@dataclass(frozen=True)
class StepOutput:
    """What a model made of a batch, and what that costs; a term that is switched off is 0."""

    image: ImageLoss
    temporal: Float[Tensor, ""]
    perceptual: Float[Tensor, ""]
    total: Float[Tensor, ""]
    """The weighted sum, without L_adv."""
    completed: tuple[Float[Tensor, "3 _h _w"], ...]
    """Fhat of each view, samples one after the other, each as a clip; empty where only rays are trained."""


class Objective(nn.Module):
    """L without L_adv, of a batch of samples of any sizes."""

    def __init__(self, model: Chain | PatchTransformer, recipe: Recipe) -> None:
        super().__init__()
        self.model = model
        self.recipe = recipe
        self.features = load_vgg16(recipe.loss.perceptual_weights) if recipe.loss.perceptual else None

    def forward(self, batch: list[Sample]) -> StepOutput:
        """All terms of `batch`."""
        weights = self.recipe.loss
        views = [sample for last in batch for sample in last.clip]
        predictions = self.model(
            [s.view for s in views], [list(s.context) for s in views], ray_views=[s.nearby for s in views]
        )
        image = patches_loss(predictions, views)
        completed = tuple(p.completed for p in predictions)
        temporal, perceptual = self._temporal(batch, completed), self._perceptual(views, completed)
        total = weights.image * (image.inside + image.outside) + weights.log_error * image.log_error
        total = total + weights.temporal * temporal + weights.perceptual * perceptual
        return StepOutput(image, temporal, perceptual, total, completed)

    def _temporal(self, batch: list[Sample], completed: tuple[Tensor, ...]) -> Float[Tensor, ""]:
        """The change between consecutive views of each clip."""
        if not self.recipe.loss.temporal:
            return completed[0].new_zeros(())
        made = iter(completed)
        clips = [[(CompletedView(s.view, next(made)), s.truth.float() / 255) for s in last.clip] for last in batch]
        pairs = [pair for clip in clips for pair in pairwise(clip)]
        return temporal_loss(
            [before for (before, _), _ in pairs],
            [now for _, (now, _) in pairs],
            [(earlier, later) for (_, earlier), (_, later) in pairs],
        )

    def _perceptual(self, views: list[Sample], completed: tuple[Tensor, ...]) -> Float[Tensor, ""]:
        """The difference of VGG16's features around the holes."""
        if self.features is None:
            return completed[0].new_zeros(())
        truth = [s.truth.float() / 255 for s in views]
        return perceptual_loss(self.features, completed, [s.view.error for s in views], truth)


def patches_loss(predictions: list[Prediction], samples: list[Sample]) -> ImageLoss:
    """L_in and L_out of section 8, on Ftilde."""
    return image_loss(
        [p.inpainted for p in predictions],
        [p.coverage for p in predictions],
        [s.view.error for s in samples],
        [s.truth.float() / 255 for s in samples],
    )
