"""The subject cut out of a view, as pictures have it."""

import numpy as np
from jaxtyping import UInt8

from viewmend.contact_sheet import picture
from viewmend.views import CompletedView


def cutout(completed: CompletedView) -> UInt8[np.ndarray, "height width 4"]:
    """The subject alone: colours as they are, not multiplied by the alpha that comes fourth."""
    return np.dstack([picture(completed.straight_rgb), picture(completed.opacity[None])[..., 0]])
