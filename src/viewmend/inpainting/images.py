"""From images to tokens: what the encoder is shown, and which patches are kept (sections 3 and 4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.coordinates import relative_depth
from viewmend.inpainting.encoder import CELL_PX, Encoder
from viewmend.inpainting.patches import (
    PATCH_CELLS,
    STEP_CELLS,
    STEP_PX,
    any_in_patch,
    crop,
    crop_windows,
    split,
)
from viewmend.views import ContextViews, IncompleteView, WindowPart

Shown = tuple[Float[Tensor, "channel _h _w"], Bool[Tensor, "_rows _cols"]]
"""What the encoder is shown of one image, and the patches that are kept."""


@dataclass(frozen=True)
class Images:
    """Images of one size, as the encoder is shown them, and their foreground."""

    channels: Float[Tensor, "view channel height width"]
    foreground: Bool[Tensor, "view height width"]
    kept: Bool[Tensor, "view rows cols"]
    """Patches with any foreground: all others are discarded."""

    @property
    def places(self) -> Int[Tensor, "patch 3"]:
        """View, row and column of each kept patch."""
        return torch.nonzero(self.kept)


def context_images(views: ContextViews, config: InpainterConfig) -> Images:
    """Camera images of one time. Without masks, what the proxy covers is the foreground."""
    frame = views.frame
    rgb = frame.rgb.float() / 255
    mask = (views.depth > 0).float() if frame.mask is None else frame.mask.float() / 255
    inside = torch.ones_like(mask)
    for image, (width, height) in zip(inside, frame.cameras.size_px.tolist(), strict=True):
        image[height:], image[:, width:] = 0, 0
    if config.background != "recorded":
        white = (inside * (1 - mask))[:, None]  # beyond an image there is nothing, not even a background
        rgb = rgb * mask[:, None] + (config.background == "white") * white
    return _images(rgb, mask, views.depth, inside, mask > config.min_foreground, config, views.part)


def target_images(view: IncompleteView, rgb: Float[Tensor, "3 height width"], config: InpainterConfig) -> Images:
    """The novel view with these colours, a stack of one; what is missing is foreground, too.

    Upon white, what is missing is black, unless a coarse fill shows something there.
    """
    mask = view.mask[None]
    if config.background == "white":
        rgb = rgb + (1 - mask)
        rgb = rgb * (1 - view.error) if config.coarse_fill == "none" else rgb
    foreground = (mask > 0) | (view.error[None] > 0)
    return _images(rgb[None], mask, view.depth[None], 1 - view.error[None], foreground, config, view.part)


def _images(
    rgb: Tensor,
    mask: Tensor,
    depth: Tensor,
    validity: Tensor,
    foreground: Tensor,
    config: InpainterConfig,
    part: WindowPart | None,
) -> Images:
    channels = [rgb]
    if config.use_mask:
        channels.append(mask[:, None])
    if config.use_depth:
        channels.append(relative_depth(depth, None if part is None else part.reference_m)[:, None])
    if config.use_validity:
        channels.append(validity[:, None])
    kept = any_in_patch(foreground)
    if part is not None:
        kept &= ~any_in_patch(~part.inner)
    return Images(torch.cat(channels, 1), foreground, kept)


class Tokeniser(nn.Module):
    """Encoder, patches, and one linear layer, 7 x 7 x C -> D, with a norm where the config has one."""

    def __init__(self, config: InpainterConfig) -> None:
        super().__init__()
        self.encoder = Encoder(config)
        self.linear = nn.Linear(config.patch_channels * PATCH_CELLS**2, config.dim)
        self.colour_skip = config.colour_skip
        self.norm = nn.LayerNorm(config.dim) if config.token_norms else nn.Identity()

    def forward(self, stacks: Sequence[Images], gradients: float = 1.0) -> Float[Tensor, "patch dim"]:
        """Tokens of all kept patches of all stacks, in order.

        With `gradients` below 1, where any are computed, they flow through the encoding of this share of the images,
        which chance takes and which count for the others: the mean of the encoder's gradient stays. Most of a training
        step is that encoding, of 22 images for one.

        Only a crop around each image's kept patches is encoded, with the encoder's receptive radius in zeros
        beyond the image: so nothing depends on the size of the crop, nor on what else is in the batch.
        """
        images = [pair for stack in stacks for pair in zip(stack.channels, stack.kept, strict=True)]
        if gradients < 1 and torch.is_grad_enabled():
            patches = self._learned_in_part(images, gradients)
        else:
            patches = torch.cat(self._patches(images))
        return self.norm(self.linear(patches.flatten(1)))

    def _learned_in_part(self, images: Sequence[Shown], share: float) -> Float[Tensor, "patch feature 7 7"]:
        """The patches of all images, with gradients of this share of them, each so many times as large."""
        chosen = (torch.rand(len(images)) < share).tolist()
        with torch.no_grad():
            others = iter(self._patches([own for own, taken in zip(images, chosen, strict=True) if not taken]))
        taught = self._patches([own for own, taken in zip(images, chosen, strict=True) if taken])
        learned = iter(own.detach() + (own - own.detach()) / share for own in taught)
        return torch.cat([next(learned if taken else others) for taken in chosen])

    def _patches(self, images: Sequence[Shown]) -> list[Float[Tensor, "_patch feature 7 7"]]:
        """The kept patches of each image."""
        if not images:
            return []
        # A batch pads all crops to the largest: worth it on a device that wants large batches, not on a CPU.
        batches = [[pair] for pair in images] if images[0][0].device.type == "cpu" else [images]
        counts = [int(kept.sum()) for _, kept in images]
        return list(torch.cat([self._encoded(batch) for batch in batches]).split(counts))

    def _encoded(self, images: Sequence[Shown]) -> Float[Tensor, "patch feature 7 7"]:
        """The kept patches of these images' features, encoded in one batch."""
        crops = [crop_windows(kept[None]) for _, kept in images]
        size = (max(s[0] for _, s in crops), max(s[1] for _, s in crops))
        windows, places = [], []
        for number, ((image, kept), (origins, _)) in enumerate(zip(images, crops, strict=True)):
            top, left = (origins[0] * STEP_PX).tolist()
            windows.append(crop(image, top, left, size))
            local = torch.nonzero(kept) - origins
            places.append(torch.cat([torch.full_like(local[:, :1], number), local], 1))
        batch = torch.stack(windows)
        features = self.encoder(batch)
        if self.colour_skip:
            features = torch.cat([features, nn.functional.avg_pool2d(batch, CELL_PX).to(features)], 1)
        return split(features, torch.cat(places), PATCH_CELLS, STEP_CELLS)
