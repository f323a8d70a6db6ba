"""Fills that know nothing but the view itself: what the network must beat."""

from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.inpainting.protocol import ContextProvider, State
from viewmend.views import CompletedView, IncompleteView

RADIUS_PX = 3.0
"""How far from a hole OpenCV's fills look."""


class ViewFill(Protocol):
    """A `ViewInpainter` that looks at the view alone; `context` is never asked, nothing is remembered."""

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, context: ContextProvider, state: State) -> tuple[CompletedView, State]:
        """The view with its holes filled; one without holes comes back as it is."""
        if not bool((view.error > 0).any()):
            return CompletedView(view, view.rgb), state
        mended = view.error * self.fill(view) + (1 - view.error) * view.rgb
        return CompletedView(view, torch.where(view.error > 0, mended, view.rgb)), state

    def fill(self, view: IncompleteView) -> Float[Tensor, "3 height width"]:
        """Colours for the pixels of E; what it says of others does not count."""
        ...


class Telea(ViewFill):
    """OpenCV's fast-marching fill of E (Telea 2004), in 8 bits."""

    method = 1
    """`cv2.INPAINT_TELEA`."""

    def fill(self, view: IncompleteView) -> Float[Tensor, "3 height width"]:
        """The view filled by `cv2.inpaint`."""
        import cv2

        holes = (view.error > 0).cpu().numpy().astype(np.uint8)
        image = (view.rgb.detach().clamp(0, 1) * 255).round().byte().cpu().movedim(0, -1).contiguous().numpy()
        filled = torch.from_numpy(cv2.inpaint(image, holes, RADIUS_PX, self.method))
        return filled.movedim(-1, 0).to(view.rgb) / 255


class NavierStokes(Telea):
    """OpenCV's fill of E along lines of equal brightness (Bertalmio et al. 2001), in 8 bits."""

    method = 0
    """`cv2.INPAINT_NS`."""


class Unfilled(ViewFill):
    """The rendered view as it is: what every fill is measured from."""

    def fill(self, view: IncompleteView) -> Float[Tensor, "3 height width"]:
        """The view's own pixels, black in its holes."""
        return view.rgb


class NearestColour(ViewFill):
    """Each pixel of E takes the colour of the nearest pixel of the subject that is right."""

    def fill(self, view: IncompleteView) -> Float[Tensor, "3 height width"]:
        """Colours of the nearest right pixels; without any the view stays as it is."""
        import cv2

        right = ((view.error == 0) & (view.mask > 0.5)).cpu().numpy()
        if not right.any():
            return view.rgb
        _, labels = cv2.distanceTransformWithLabels(
            (~right).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        places = np.zeros(int(labels.max()) + 1, np.int64)
        places[np.asarray(labels)[right].astype(np.int64)] = np.flatnonzero(right)
        nearest = torch.from_numpy(places[np.asarray(labels).astype(np.int64)]).to(view.rgb.device)
        return view.rgb.flatten(1)[:, nearest]
