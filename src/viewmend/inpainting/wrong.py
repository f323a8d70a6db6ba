"""The error rule `wrong`: what a model that knows all cameras takes for wrong. Ours."""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import ContextProvider, ViewInpainter
from viewmend.inpainting.sweep.error_net import most_wrong
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.views import IncompleteView

WHOLE_VIEWS = "views"
"""The shipped model that is asked where the inpainter cannot tell."""


def wrong_error(
    view: IncompleteView, inpainter: ViewInpainter, context: ContextProvider, fraction: float
) -> Float[Tensor, "height width"]:
    """E where most is to be gained, of the subject's part of a view; as it was where no camera may be looked at.

    Args:
        view: what was rendered, from any inpainter's stream.
        inpainter: is asked if it is a `SweepNet`; else the one that is shipped is.
        context: what the cameras saw.
        fraction: at most this part of the proxy's pixels, beside the paper's E.

    Raises:
        ValueError: the inpainter was trained without an `ErrorNet`.
    """
    net = inpainter if isinstance(inpainter, SweepNet) else _shipped(view.rgb.device)
    found = net.error_map(view, context)
    return view.error if found is None else most_wrong(view, found, fraction)


@lru_cache(maxsize=2)
def _shipped(device: torch.device) -> SweepNet:
    net = load_network(WHOLE_VIEWS, device)
    assert isinstance(net, SweepNet), "which is what is shipped under this name"
    return net
