"""Encoder and decoder learn first what a token can hold: an autoencoder of patches, without attention. Ours."""

import torch
from torch import Tensor, nn

from viewmend.inpainting.chain import Chain
from viewmend.inpainting.images import Images, context_images
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.patches import PATCH_PX, STEP_PX, crop, grid_shape, padded_size, split
from viewmend.training.losses import LEAST_SQUARE, ImageLoss
from viewmend.training.objective import StepOutput
from viewmend.training.plan import Recipe
from viewmend.training.samples import Sample

PARTS = ("tokeniser", "decoder")
"""The modules that learn."""


class AutoencoderObjective(nn.Module):
    """L1 between the patches of camera images and what the decoder makes of their tokens."""

    def __init__(self, model: Chain | PatchTransformer, recipe: Recipe) -> None:
        super().__init__()
        self.model = model
        self.recipe = recipe

    def forward(self, batch: list[Sample]) -> StepOutput:
        """The loss of each sample's cameras at one time, which chance takes."""
        patches = self.model.patches if isinstance(self.model, Chain) else self.model
        views = [s.context[int(torch.randint(len(s.context), ()))] for s in batch if s.context]
        made, shown = through_tokens(patches, [context_images(one, patches.config) for one in views])
        away = (made - shown).abs()
        inside = (away.sum(1) if self.recipe.loss.channels == "sum" else away.mean(1)).mean()
        log_error = (away.square().mean() + LEAST_SQUARE).log10()
        loss = ImageLoss(inside, torch.zeros_like(inside), log_error)
        return StepOutput(loss, self.recipe.loss.image * inside + self.recipe.loss.log_error * log_error, ())


def through_tokens(model: PatchTransformer, stacks: list[Images]) -> tuple[Tensor, Tensor]:
    """The kept patches (patch, 3, 28, 28) of images through a token each and back, and as the encoder was shown them.

    Raises:
        ValueError: no patch is kept.
    """
    if not sum(len(stack.places) for stack in stacks):
        raise ValueError("expected images of a subject, got none that shows any; make the samples anew")
    shown = []
    for stack in stacks:
        size = padded_size(*grid_shape(*stack.channels.shape[2:]))
        whole = torch.stack([crop(image, 0, 0, size) for image in stack.channels])
        shown.append(split(whole, stack.places, PATCH_PX, STEP_PX))
    pixels = torch.cat(shown)
    with model.autocast():
        made = model.decoder(model.tokeniser(stacks), pixels)
    return made[:, :3].float(), pixels[:, :3]
