"""Encoder and decoder learn first what a token can hold: an autoencoder of patches, without attention. Ours."""

import torch

from viewmend.inpainting.images import context_images
from viewmend.training.losses import LEAST_SQUARE, ImageLoss
from viewmend.training.objective import Objective, StepOutput
from viewmend.training.samples import Sample
from viewmend.training.through_tokens import patch_loss, through_tokens


class AutoencoderObjective(Objective):
    """L1 between the patches of camera images and what the decoder makes of their tokens."""

    def forward(self, batch: list[Sample]) -> StepOutput:
        """The loss of each sample's cameras at one time, which chance takes."""
        views = [s.context[int(torch.randint(len(s.context), ()))] for s in batch if s.context]
        made, shown = through_tokens(self.patches, [context_images(one, self.patches.config) for one in views])
        inside = patch_loss(made, shown, self.recipe.loss.channels)
        log_error = ((made - shown).square().mean() + LEAST_SQUARE).log10()
        loss = ImageLoss(inside, torch.zeros_like(inside), log_error)
        return StepOutput(loss, self.recipe.loss.image * inside + self.recipe.loss.log_error * log_error, ())
