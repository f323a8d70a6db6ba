"""Whether each camera's images are in time with its own masks: an outline lies where its image has edges."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.capture.finding import Finding
from viewmend.geometry.hull import FOREGROUND
from viewmend.views import MultiViewFrame

SHARPER = 1.015
"""Images are late if those of another time are that much steeper across the outlines."""
LEAST_TIMES = 3
"""So many outlines tell, by their median: one time may be spoilt."""


def images_out_of_time(frames: Sequence[MultiViewFrame]) -> tuple[Finding, ...]:
    """The cameras whose images fit their own masks at another time, as findings.

    `frames` of the same cameras follow each other in time, and should be small.
    """
    if any(frame.mask is None for frame in frames):
        return ()
    masks = [frame.mask for frame in frames if frame.mask is not None]
    edges = torch.stack([_slopes(frame.rgb.float()) for frame in frames])
    outlines = torch.stack([_slopes((mask > FOREGROUND).float()[:, None]) for mask in masks])
    outlines = F.normalize(outlines, dim=3)  # across the outline; 0 elsewhere
    reach = min(len(frames) // 2, len(frames) - LEAST_TIMES)
    delays = [delay for delay in range(-reach, reach + 1) if delay]
    if not delays:
        return ()
    sharper = torch.stack([_sharper(edges, outlines, delay) for delay in delays])
    text = "the images of camera '{}': {} against its masks; shift its images, or its masks, in time"
    return tuple(
        Finding(text.format(name, delay_text(delays[int(own.argmax())])))
        for name, own in zip(frames[0].cameras.names, sharper.unbind(1), strict=True)
        if float(own.max()) > SHARPER
    )


def delay_text(by: int) -> str:
    """What is found `by` frames later than it should be, in words."""
    return f"{'late' if by > 0 else 'early'} by about {abs(by)} frame{'s' if abs(by) > 1 else ''}"


def _slopes(image: Float[Tensor, "view channel height width"]) -> Float[Tensor, "view channel 2 height width"]:
    """The differences of each pixel's neighbours, by column and by row."""
    padded = F.pad(image, (1, 1, 1, 1), mode="replicate")
    return torch.stack(
        [padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2], padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]], 2
    )


def _sharper(
    edges: Float[Tensor, "time view channel 2 height width"],
    outlines: Float[Tensor, "time view 1 2 height width"],
    delay: int,
) -> Float[Tensor, "view"]:
    """How steep images so many frames later are across an outline, against its own image: the times' median."""
    first, count = max(0, -delay), len(edges) - abs(delay)
    own, shifted = (edges[start : start + count] for start in (first, first + delay))
    across = outlines[first : first + count]
    later, now = ((image * across).sum(3).abs().sum((2, 3, 4)) for image in (shifted, own))
    return (later / now.clamp(min=1.0)).median(0).values
