"""The strongest simple rival of our own idea: missing pixels from whichever camera saw the surface there."""

import math

import torch

from viewmend.inpainting.coarse_fill import fill
from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.context import window_times
from viewmend.inpainting.decoder import blend
from viewmend.inpainting.protocol import ContextProvider, State
from viewmend.inpainting.ray_sampling import NEAR, sample_along_rays
from viewmend.views import CompletedView, IncompleteView

TOLERANCE = 0.02
"""A camera sees a point at most this far behind the proxy, in subject sizes."""
FRONTAL_POWER = 8.0
"""How much a camera's colour counts by the cosine of the angle to the viewer's ray."""


class ReprojectionFill:
    """Each pixel of E takes the colour that cameras show at its point of the proxy, by geometry alone.

    The cameras nearest to the view are asked first, at its own time, then the source views at past times, latest
    first; where none saw the point, the hole is filled smoothly from its surroundings.
    """

    def __init__(self, cameras: int = 8) -> None:
        self.cameras = cameras
        self.config = InpainterConfig()

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """Fills from the cameras' images; a view without holes comes back at once."""
        missing = view.error > 0
        if not bool(missing.any()):
            return CompletedView(view, view.rgb), state
        filled = fill(view.rgb, missing, view.mask > 0).movedim(0, -1).clone()
        left = torch.nonzero(missing & (view.depth > 0).any())
        nearest = view.closest_views(self.cameras)
        for time in window_times(view.time, self.config):
            seen = context(time, nearest if time == view.time else view.source_views) if len(left) else None
            if seen is None:
                continue
            point = sample_along_rays(view, left, seen, offsets=(0.0,)).features
            near = point.depth_difference.abs() < math.tanh(TOLERANCE / NEAR)
            visible = (point.in_view > 0) & (point.mask > 0.5) & near
            weight = visible * (FRONTAL_POWER * point.viewing_cosine).exp()
            total = weight.sum(2)[:, 0]
            colour = (weight * point.colour).sum(2)[:, 0] / total.clamp_min(1e-9)
            found = total[:, 0] > 0
            filled[tuple(left[found].unbind(1))] = colour[found]
            left = left[~found]
        mended = blend(view.rgb, view.error, filled.movedim(-1, 0), torch.ones_like(view.error))
        return CompletedView(view, mended), state
