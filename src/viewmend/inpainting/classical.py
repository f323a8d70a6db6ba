"""Fills that know nothing but the view itself: what the network must beat."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.inpainting.coarse_fill import fill
from viewmend.inpainting.protocol import Source, State
from viewmend.views import CompletedView, IncompleteView


class Telea:
    """OpenCV's fast-marching fill of E (Telea 2004), in 8 bits."""

    def __init__(self, radius_px: float = 3.0) -> None:
        self.radius_px = radius_px

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        """Fills from the view alone; `source` is never asked."""
        import cv2

        return CompletedView(view, _opencv(view, self.radius_px, cv2.INPAINT_TELEA)), state


class NavierStokes:
    """OpenCV's fill of E along lines of equal brightness (Bertalmio et al. 2001), in 8 bits."""

    def __init__(self, radius_px: float = 3.0) -> None:
        self.radius_px = radius_px

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        """Fills from the view alone; `source` is never asked."""
        import cv2

        return CompletedView(view, _opencv(view, self.radius_px, cv2.INPAINT_NS)), state


class SmoothFill:
    """The smooth fill that our model falls back to (`prefill.fill`), on its own."""

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        """Fills from the view alone; `source` is never asked."""
        return CompletedView(view, _blended(view, fill(view.rgb, view.error > 0, view.mask > 0))), state


class Unfilled:
    """The rendered view as it is: what every fill is measured from."""

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        """The view's own pixels, black in its holes."""
        return CompletedView(view, view.rgb), state


class NearestColour:
    """Each pixel of E takes the colour of the nearest pixel of the subject that is right."""

    def initial_state(self) -> State:
        """Nothing to remember."""
        return State()

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        """Fills from the view alone; `source` is never asked. Without a right pixel the view stays as it is."""
        import cv2

        right = ((view.error == 0) & (view.mask > 0.5)).cpu().numpy()
        if not bool((view.error > 0).any()) or not right.any():
            return CompletedView(view, view.rgb), state
        _, labels = cv2.distanceTransformWithLabels(
            (~right).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        places = np.zeros(int(labels.max()) + 1, np.int64)
        places[np.asarray(labels)[right].astype(np.int64)] = np.flatnonzero(right)
        nearest = torch.from_numpy(places[np.asarray(labels).astype(np.int64)]).to(view.rgb.device)
        return CompletedView(view, _blended(view, view.rgb.flatten(1)[:, nearest])), state


def _opencv(view: IncompleteView, radius_px: float, method: int) -> Float[Tensor, "3 height width"]:
    """Fhat by `cv2.inpaint`."""
    import cv2

    holes = (view.error > 0).cpu().numpy().astype(np.uint8)
    if not holes.any():
        return view.rgb
    image = (view.rgb.detach().clamp(0, 1) * 255).round().byte().cpu().movedim(0, -1).contiguous().numpy()
    filled = torch.from_numpy(cv2.inpaint(image, holes, radius_px, method))
    return _blended(view, filled.movedim(-1, 0).to(view.rgb) / 255)


def _blended(view: IncompleteView, filled: Float[Tensor, "3 height width"]) -> Float[Tensor, "3 height width"]:
    """Fhat = E filled + (1 - E) F, bit for bit F where E is 0."""
    mended = view.error * filled + (1 - view.error) * view.rgb
    return torch.where(view.error > 0, mended, view.rgb)
