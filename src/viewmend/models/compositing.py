"""Compositing on a background: black, or white as in the paper's experiments (section 13).

Elsewhere in the package, images of a subject are on black, that is, multiplied by alpha.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.types import CompletedView, IncompleteView, MultiViewFrame
from viewmend.utils.contact_sheet import picture

Background = Literal["black", "white"]
Image = Float[Tensor, "3 height width"]
Plane = Float[Tensor, "height width"]
RELIABLE = 0.25
"""The smallest alpha at which a pixel keeps its own colour where the target mask makes it
opaque."""
BLOCKS_PX = (4, 8, 16, 32, 64, 128)
"""Sizes of the blocks whose mean colour replaces that of pixels without a reliable one."""
OPAQUE_ENOUGH = 0.1
"""Smallest mean alpha of a block whose colour is used."""


def composite(background: Background, rgb: Image, alpha: Plane) -> Image:
    """An image on black, of this alpha, composited on a background; in [0, 1]."""
    return rgb if background == "black" else (rgb + (1 - alpha)).clamp(0, 1)


def camera_image(frame: MultiViewFrame, background: Background) -> Image:
    """The image of a frame of one view, composited on a background by its mask, which it must have; in [0, 1]."""
    assert frame.mask is not None, "expected a frame with a mask"
    alpha = frame.mask[0].float() / 255
    return composite(background, frame.rgb[0].float() / 255 * alpha, alpha)


def blend(
    known: Image,
    error: Plane,
    inpainted: Image,
    coverage: Shaped[Tensor, "height width"],
    clamp: bool = True,
) -> Image:
    """Fhat = E Ftilde + (1 - E) F (section 1). Bit-identical to F where E or the coverage of Ftilde is 0.

    With `clamp`, Ftilde is clamped to [0, 1] first.
    """
    completed = torch.lerp(known, inpainted.clamp(0, 1) if clamp else inpainted, error)
    return torch.where((error > 0) & (coverage > 0), completed, known)


def painted_alpha(view: IncompleteView) -> Plane:
    """Alpha of a view whose masked pixels were painted on white: M, and 1 on all of E.

    Where E lies on true background, the painted white counts as subject.
    """
    return 1 - (1 - view.mask) * (1 - view.error)


def cut(completed: CompletedView) -> CompletedView:
    """A completed view, composited by the target's mask: nothing outside of it is shown. Unchanged without one."""
    mask = completed.view.target_mask
    if mask is None:
        return completed
    alpha = completed.view.mask if completed.alpha is None else completed.alpha
    confidence, depth = (
        None if p is None else p * (mask > 0) for p in (completed.confidence, completed.depth)
    )
    return replace(
        completed, rgb=completed.rgb * mask, alpha=alpha * mask, confidence=confidence, depth=depth
    )


def cutout(completed: CompletedView) -> UInt8[np.ndarray, "height width 4"]:
    """The subject as an 8-bit RGBA image with straight alpha."""
    return np.dstack([picture(completed.straight_rgb), picture(completed.opacity[None])[..., 0]])


def to_background(background: Background, view: IncompleteView) -> IncompleteView:
    """A view on black as a view on this background; its holes stay black."""
    return view if background == "black" else replace(view, rgb=view.rgb + (1 - painted_alpha(view)))


def from_background(background: Background, completed: CompletedView, view: IncompleteView) -> CompletedView:
    """What was made of `to_background(background, view)`, on black again."""
    if background == "black":
        return completed
    alpha = painted_alpha(view)
    rgb = torch.where(view.error > 0, completed.rgb - (1 - alpha), view.rgb)
    return replace(completed, view=view, rgb=rgb, alpha=alpha if completed.alpha is None else completed.alpha)


def opaque_in_mask(completed: CompletedView) -> CompletedView:
    """The view with alpha 1 where E > 0 and the target mask shows the subject; unchanged without a target mask.

    There a lower alpha is an error: it would let the background through. Pixels whose own colour is
    unreliable, because their alpha is low, take the mean colour of the smallest block around them
    that is opaque enough.
    """
    view = completed.view
    alpha = completed.alpha
    if view.target_mask is None or alpha is None:
        return completed
    straight = completed.rgb / alpha.clamp(min=RELIABLE)
    found = alpha >= RELIABLE
    premultiplied = torch.cat([completed.rgb, alpha[None]])[None]
    for block in BLOCKS_PX:
        sides = [max(1, side // block) for side in alpha.shape]
        small = F.interpolate(premultiplied, sides, mode="area")
        *colour, opacity = F.interpolate(small, alpha.shape, mode="bilinear")[0]
        new = ~found & (opacity >= OPAQUE_ENOUGH)
        straight = torch.where(new, torch.stack(colour) / opacity.clamp(min=OPAQUE_ENOUGH), straight)
        found = found | new
    known = (view.target_mask > 0) & (view.error > 0)
    rgb = torch.where(known, straight.clamp(0, 1), completed.rgb)
    return replace(completed, rgb=rgb, alpha=torch.where(known, 1.0, alpha))
