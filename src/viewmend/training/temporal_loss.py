"""The temporal term, ours and a switch: what changes between completed views where geometry says that nothing did.

Each pixel of the later view is carried through its own depth into the earlier one, where its colour is looked up. It
counts where the two views' proxies agree that this is one surface, and where either view was inpainted.

What it cannot tell: the proxy has no correspondence over time. A surface that slides along itself, a limb that moves
across the picture at its own depth, or a turning ball keep their depth while their colour rightly changes, and so do
colours that change with the light. The right answer therefore has a loss above zero (0.02 to 0.06 in four of the
studio's scenes, hardly less than a smooth fill's), and a large weight buys stillness with blur. Where the truth of
both times is known, as in training, it can be given: then only those changes count that the truth does not have, and
the truth has a loss of zero. What moved in depth by more than the tolerance is not counted in either case.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.sampling import bilinear_taps
from viewmend.views import CompletedView

TOLERANCE = 0.01
"""Two depths within this share of each other are one surface: 3 cm at 3 m."""
COVERED = 0.5
"""Mask from which a pixel belongs to the subject."""
Truth = tuple[Float[Tensor, "3 _height _width"], Float[Tensor, "3 _height _width"]]
"""F* of the earlier and of the later view."""
STEPS_PER_PX = 256
"""Places are rounded to such steps, far above the error of carrying, so that a camera that stands still reads one pixel
and not, by an error of the last digit, a share of a millionth of its neighbour, which may lie on another surface."""
LEAST = torch.finfo(torch.float32).tiny


def temporal_loss(
    before: Sequence[CompletedView],
    now: Sequence[CompletedView],
    truth: Sequence[Truth] | None = None,
    tolerance: float = TOLERANCE,
) -> Float[Tensor, ""]:
    """`temporal_change` of each pair of consecutive views, and its mean over the batch."""
    truths = [None] * len(now) if truth is None else truth
    changes = [temporal_change(b, n, t, tolerance) for b, n, t in zip(before, now, truths, strict=True)]
    return torch.stack(changes).mean()


def temporal_change(
    before: CompletedView, now: CompletedView, truth: Truth | None = None, tolerance: float = TOLERANCE
) -> Float[Tensor, ""]:
    """|w * (Fhat[t] - warped Fhat[t-1])|_1 / |w|_1, the mean of the channels; 0 with a zero gradient where w is.

    w is the larger of E[t] and the warped E[t-1] where the pixel and all of the up to four pixels that share its place
    in the earlier view lie on the subject, at a depth that agrees; else 0. Gradients flow into both views' colours, not
    into depth.

    Args:
        before: the view one step earlier; its camera may be another, and its image of another size.
        now: the view whose pixels are counted.
        truth: F*[t-1] and F*[t]; with them Fhat - F* stands in the formula for Fhat.
        tolerance: largest difference of depth, as a share of it.
    """
    view, past = now.view, before.view
    row, column = ((view.mask > COVERED) & (view.depth > 0)).nonzero(as_tuple=True)
    uv = torch.stack([column, row], -1).to(view.depth) + 0.5
    points = unproject(uv[None], view.depth[row, column][None], view.camera)[0]
    carried, z = (values[0] for values in project(points, past.camera))

    carried = (carried * STEPS_PER_PX).round() / STEPS_PER_PX
    height, width = past.depth.shape
    taps = zip(*bilinear_taps(carried, width, height), strict=True)
    rows, columns, share, inside = (torch.stack(values) for values in taps)
    there = past.depth[rows, columns]
    one_surface = (there > 0) & (past.mask[rows, columns] > COVERED) & ((there - z).abs() <= tolerance * z)
    valid = ((inside & one_surface) | (share == 0)).all(0) & (z > 0)

    weight = torch.maximum(view.error[row, column], (share * past.error[rows, columns]).sum(0)) * valid
    earlier, later = before.rgb.float(), now.rgb.float()
    if truth is not None:
        earlier, later = earlier - truth[0], later - truth[1]
    change = later[:, row, column] - (share * earlier[:, rows, columns]).sum(1)
    return (weight * change.abs().mean(0)).sum() / weight.sum().clamp_min(LEAST)
