"""What patches of camera images keep when each passes through its own token and back: how much a token holds. Ours."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.inpainting.context import ContextFrame
from viewmend.inpainting.images import Images, context_images
from viewmend.inpainting.patch_transformer import PatchTransformer
from viewmend.inpainting.patches import PATCH_PX, STEP_PX, crop, grid_shape, padded_size, split
from viewmend.views import ContextViews

DECODED = 6
"""The patches of so many times and views of a batch are decoded; chance takes them."""


def through_tokens(model: PatchTransformer, stacks: list[Images]) -> tuple[Tensor, Tensor]:
    """The kept patches (patch, 3, 28, 28) of images through a token each and back, and as the encoder was shown them.

    Raises:
        ValueError: no patch is kept.
    """
    if not sum(len(stack.places) for stack in stacks):
        raise ValueError("expected images of a subject, got none that shows any; make the samples anew")
    with model.autocast():
        return _decoded(model, model.tokeniser(stacks), stacks)


def encode_and_decode(
    model: PatchTransformer, contexts: Sequence[Sequence[ContextFrame | ContextViews]], channels: str
) -> tuple[list[list[ContextFrame]], Float[Tensor, ""]]:
    """The contexts encoded, and L1 between some of their patches and what the decoder makes of these's tokens.

    Args:
        model: what encodes.
        contexts: camera images of each view, one element a time; what is encoded already stays.
        channels: 'mean' or 'sum', as `LossWeights.channels`.
    """
    views = [one for context in contexts for one in context if isinstance(one, ContextViews)]
    encoded = model.encode_contexts(views)
    remaining = iter(encoded)
    frames = [
        [frame for one in context for frame in (next(remaining) if isinstance(one, ContextViews) else (one,))]
        for context in contexts
    ]
    taken = torch.randperm(len(views))[:DECODED].tolist()
    tokens = [frame.tokens for n in taken for frame in encoded[n]]
    if not sum(map(len, tokens)):
        return frames, torch.zeros((), device=next(model.parameters()).device)
    with model.autocast():
        made, shown = _decoded(model, torch.cat(tokens), [context_images(views[n], model.config) for n in taken])
    return frames, patch_loss(made, shown, channels)


def patch_loss(made: Tensor, shown: Tensor, channels: str) -> Float[Tensor, ""]:
    """L1 of patches (patch, 3, 28, 28), the channels' mean or their sum."""
    away = (made - shown).abs()
    return (away.sum(1) if channels == "sum" else away.mean(1)).mean()


def _decoded(model: PatchTransformer, tokens: Tensor, stacks: Sequence[Images]) -> tuple[Tensor, Tensor]:
    """What the decoder makes of the tokens of all kept patches, and these patches."""
    shown = []
    for stack in stacks:
        size = padded_size(*grid_shape(*stack.channels.shape[2:]))
        whole = torch.stack([crop(image, 0, 0, size) for image in stack.channels])
        shown.append(split(whole, stack.places, PATCH_PX, STEP_PX))
    pixels = torch.cat(shown)
    return model.decoder(tokens, pixels)[:, :3].float(), pixels[:, :3]
