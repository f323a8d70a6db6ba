"""Inpainters without learned parameters: what the models must beat."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.models.base import ContextProvider
from viewmend.models.paper.config import PaperConfig
from viewmend.models.paper.context import window_times
from viewmend.models.smooth_fill import Fill, fill
from viewmend.models.views.config import NEAR
from viewmend.models.views.pyramids import SourceCameras
from viewmend.models.views.ray_fill import sample_behind_proxy
from viewmend.models.views.sampler import CameraFeatures
from viewmend.types import IncompleteView

RADIUS_PX = 3.0
"""Neighbourhood of OpenCV's fills."""
TOLERANCE = 0.02
"""A camera sees a point if the proxy's depth in it is at most this much nearer, in subject sizes."""
FRONTAL_POWER = 8.0
"""Weight of a camera's colour is exp(this times the cosine of the angle to the viewer's ray)."""


class Telea(Fill):
    """OpenCV's fast-marching fill of E (Telea 2004), in 8 bits."""

    method = 1
    """`cv2.INPAINT_TELEA`."""

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Float[Tensor, "3 height width"]:
        """The view filled by `cv2.inpaint`."""
        import cv2

        missing = (view.error > 0).cpu().numpy().astype(np.uint8)
        image = (view.rgb.detach().clamp(0, 1) * 255).round().byte().cpu().movedim(0, -1).contiguous().numpy()
        filled = torch.from_numpy(cv2.inpaint(image, missing, RADIUS_PX, self.method))
        return filled.movedim(-1, 0).to(view.rgb) / 255


class NavierStokes(Telea):
    """OpenCV's fill of E along isophotes (Bertalmio et al. 2001), in 8 bits."""

    method = 0
    """`cv2.INPAINT_NS`."""


class Unfilled(Fill):
    """The view as rendered."""

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Float[Tensor, "3 height width"]:
        """The view's own colours, black in its holes."""
        return view.rgb


class NearestColour(Fill):
    """Each pixel of E takes the colour of the nearest pixel of the subject with E = 0."""

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Float[Tensor, "3 height width"]:
        """Colours of the nearest correct pixels; the view's own colours if there are none."""
        import cv2

        correct = ((view.error == 0) & (view.mask > 0.5)).cpu().numpy()
        if not correct.any():
            return view.rgb
        wrong = (~correct).astype(np.uint8)
        _, labels = cv2.distanceTransformWithLabels(wrong, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
        pixel_of_label = np.zeros(int(labels.max()) + 1, np.int64)
        pixel_of_label[np.asarray(labels)[correct].astype(np.int64)] = np.flatnonzero(correct)
        nearest = torch.from_numpy(pixel_of_label[np.asarray(labels).astype(np.int64)]).to(view.rgb.device)
        return view.rgb.flatten(1)[:, nearest]


class ReprojectionFill(Fill):
    """Each pixel of E takes the colour that the cameras have at its point on the proxy.

    The cameras closest to the view are sampled first, in its own frame, then the source
    views in past frames, the latest first. Points that no camera sees are filled smoothly
    from their surroundings.
    """

    def __init__(self, cameras: int = 8) -> None:
        self.cameras = cameras
        self.config = PaperConfig()

    def fill_view(self, view: IncompleteView, context: ContextProvider) -> Float[Tensor, "3 height width"]:
        """Sample the cameras' images."""
        missing = view.error > 0
        filled = fill(view.rgb, missing, view.mask > 0).movedim(0, -1).clone()
        left = torch.nonzero(missing & (view.depth > 0).any())
        nearest = view.closest_views(self.cameras)
        for time in window_times(view.time, self.config):
            seen = context(time, nearest if time == view.time else view.source_views) if len(left) else None
            if seen is None:
                continue
            silhouettes = view.silhouettes if time == view.time else None  # those of another frame differ
            sources = SourceCameras.of(seen, silhouettes, context)
            point = CameraFeatures.unstack(sample_behind_proxy(view, left, sources, offsets=(0.0,)).features)
            near = point.depth_difference.abs() < math.tanh(TOLERANCE / NEAR)
            visible = (point.in_view > 0) & (point.mask > 0.5) & near
            weight = visible * (FRONTAL_POWER * point.viewing_cosine).exp()
            total = weight.sum(2)[:, 0]
            colour = (weight * point.colour).sum(2)[:, 0] / total.clamp_min(1e-9)
            found = total[:, 0] > 0
            filled[tuple(left[found].unbind(1))] = colour[found]
            left = left[~found]
        return filled.movedim(-1, 0).clamp(0, 1)
