"""How far a reader's alpha may be trusted on a rig that it has never seen: learned from the rig's own cameras. Ours.

A net is as sure of an outline as the studio's calibration and masks allow; a real rig's are worse. So each logit of
alpha is multiplied by one number (temperature scaling, Guo et al., ICML 2017), the one that fits views of cameras of
the rig that were left out.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

SLOPES = tuple(0.5 + 0.05 * step for step in range(15))
"""What logits may be multiplied by: 1 leaves alpha as it is, less makes it softer."""
FAINTEST = 1e-4
"""Alpha is no closer to 0 or 1 before it is changed."""


def with_slope(alpha: Float[Tensor, "*pixel"], slope: float | Float[Tensor, ""]) -> Float[Tensor, "*pixel"]:
    """Alpha with its logits multiplied by `slope`; what is 0 stays 0."""
    changed = (slope * alpha.clamp(FAINTEST, 1 - FAINTEST).logit()).sigmoid()
    return torch.where(alpha > 0, changed, 0.0)


def recomposed(
    rgb: Float[Tensor, "channel *pixel"], alpha: Float[Tensor, "*pixel"], changed: Float[Tensor, "*pixel"]
) -> Float[Tensor, "channel *pixel"]:
    """Colours upon black with another alpha."""
    return changed * (rgb / alpha.clamp_min(FAINTEST)).clamp(0, 1)


def fitted_slope(
    views: Sequence[tuple[Float[Tensor, "3 _pixel"], Float[Tensor, "_pixel"], Float[Tensor, "3 _pixel"]]],
) -> float:
    """The slope by which the squared error of colours is least.

    Args:
        views: colours upon black, their alpha, and the true colours upon black, of the pixels of each view. Views count
            alike, whatever their number of pixels.
    """
    errors = torch.zeros(len(SLOPES), dtype=torch.double)
    for rgb, alpha, truth in views:
        images = (recomposed(rgb, alpha, with_slope(alpha, slope)) for slope in SLOPES)
        errors += torch.stack([(image - truth).square().double().mean().cpu() for image in images]).nan_to_num()
    return SLOPES[int(errors.argmin())] if bool((errors > 0).any()) else 1.0
