"""A method that tells alpha, confidence and depth, so that what is done with them can be seen."""

import torch
from torch.nn import functional as F

from viewmend.models.base import Inpainter
from viewmend.types import CompletedView

COLOUR = (0.8, 0.4, 0.2)
SURE, UNSURE = 0.75, 0.25


class TellsAll(Inpainter):
    """One colour wherever E allows, fading to the outline, a hand nearer than the proxy; sure of what was rendered."""

    def __init__(self, device):
        self.colour = torch.tensor(COLOUR, device=device)[:, None, None]

    def step(self, view, context, state):
        alpha = F.avg_pool2d(view.mask[None, None], 7, 1, 3)[0, 0] * view.mask
        painted = self.colour * alpha
        rgb = torch.where(view.error > 0, torch.lerp(view.rgb, painted, view.error), view.rgb)
        confidence = torch.where(view.holes, UNSURE, SURE) * (view.mask > 0)
        return CompletedView(view, rgb, alpha, confidence, (view.depth - 0.1) * (view.depth > 0)), state
