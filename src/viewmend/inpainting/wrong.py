"""The error rule `wrong`: what a model that knows all cameras takes for wrong. Ours."""

from dataclasses import replace
from functools import lru_cache

import torch

from viewmend.inpainting.checkpoint import load_network
from viewmend.inpainting.protocol import ContextProvider, ViewInpainter
from viewmend.inpainting.sweep.error_net import faded, most_wrong
from viewmend.inpainting.sweep.sweep_net import SweepNet
from viewmend.views import IncompleteView

WHOLE_VIEWS = "views"
"""The shipped model that is asked where the inpainter cannot tell."""


def narrowed(
    view: IncompleteView, inpainter: ViewInpainter, context: ContextProvider, fraction: float
) -> IncompleteView:
    """The view with E where most is to be gained; as it was where E is nothing but holes, or no camera may be seen.

    A `SweepNet` is asked itself, and gets a soft E: what it takes for background only fades. Others get 0 or 1, by the
    one that is shipped.

    Args:
        view: the subject's part of what was rendered, from any inpainter's stream.
        inpainter: who is to complete the view.
        context: what the cameras saw.
        fraction: at most this part of the proxy's pixels is read, beside what no camera colours.

    Raises:
        ValueError: the inpainter was trained without an `ErrorNet`.
    """
    if not bool(((view.error > 0) & ~view.holes).any()):
        return view
    own = isinstance(inpainter, SweepNet)
    found = (inpainter if own else _shipped(view.rgb.device)).error_map(view, context)
    if found is None:
        return view
    if own:
        return faded(view, found, fraction)
    return replace(view, error=torch.minimum(view.error, most_wrong(view, found.gain, fraction)))


@lru_cache(maxsize=2)
def _shipped(device: torch.device) -> SweepNet:
    net = load_network(WHOLE_VIEWS, device)
    assert isinstance(net, SweepNet), "which is what is shipped under this name"
    return net
