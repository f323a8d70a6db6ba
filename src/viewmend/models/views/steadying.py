"""Reduces flicker: small changes from a viewer's last view, moved along with the subject, are partly undone.

Every frame is predicted on its own, so outlines, colours and small pieces flicker where cameras are
few. Dense optical flow (DIS; Kroeger et al., ECCV 2016) aligns the last completed view with the new
one. Their difference is split into means over small squares and the detail around these. Where
either is small, a part of it is undone; large differences are real changes, or errors of the flow.
Detail must differ much less than means to be changed, so that it stays as sharp as it was predicted.
"""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.models.base import State
from viewmend.types import CompletedView

Channels = Float32[np.ndarray, "height width 4"]
"""RGB on black, and alpha."""
MEAN_WEIGHT = 0.7
"""The largest share of a difference of means that is undone."""
MEAN_SIMILAR = 0.2
"""The share falls to 1/e of `MEAN_WEIGHT` at this difference of means, in [0, 1]."""
DETAIL_WEIGHT = 0.5
"""The largest share of a difference of detail that is undone."""
DETAIL_SIMILAR = 0.05
"""The share falls to 1/e of `DETAIL_WEIGHT` at this difference of detail, in [0, 1]."""
MEAN_PX = 5
"""The means are over squares of this side, pixels."""
MAX_GAP = 3
"""The last view is used if it is at most this many frames older."""
MAX_TURN_DEG = 8.0
"""The last view is used if the camera has turned, and moved as seen from the subject, by less than this
angle, degrees."""
MAX_ZOOM = 0.1
"""The last view is used if the focal length has changed by less than this share."""


@dataclass(frozen=True)
class LastView(State):
    """The last completed view of a viewer, or the part of it that shows the subject."""

    image: Float[Tensor, "4 height width"]
    """RGB on black, and alpha."""
    camera: Cameras
    time: int
    """Index of its frame."""
    depth_m: float
    """Median z-depth of its subject, metres."""

    def precedes(self, camera: Cameras, time: int) -> bool:
        """Whether a view of this camera at the frame `time` shows almost the same, a little later."""
        if not 0 < time - self.time <= MAX_GAP:
            return False
        before = self.camera.on_host
        now = camera.on_host
        largest_rad = math.radians(MAX_TURN_DEG)
        poses = (before.world_from_camera[0], now.world_from_camera[0])
        turned = [float(poses[0][:3, axis] @ poses[1][:3, axis]) for axis in (0, 2)]
        moved_m = float((poses[1][:3, 3] - poses[0][:3, 3]).norm())
        zoom = float(now.K[0, 0, 0] / before.K[0, 0, 0])
        return (
            min(turned) > math.cos(largest_rad)
            and moved_m < math.tan(largest_rad) * self.depth_m
            and abs(zoom - 1) < MAX_ZOOM
        )

    def placed_in(self, camera: Cameras) -> Channels:
        """The image with its principal point where `camera` has it: both may be crops of larger views."""
        width, height = camera.max_size_px
        shift_px = (camera.on_host.K - self.camera.on_host.K)[0, :2, 2].double().numpy()
        matrix = np.hstack([np.eye(2), shift_px[:, None]])
        return np.asarray(cv2.warpAffine(_channels(self.image), matrix, (width, height)))


def steady(
    completed: CompletedView, predicted: Bool[Tensor, "height width"], last: State, depth_m: float
) -> tuple[CompletedView, LastView]:
    """A view whose predicted pixels flicker less than they did, and the viewer's next state.

    Without a last view, or if it shows something else (`LastView.precedes`), the view is unchanged. `depth_m`
    is the median z-depth of its subject, metres.
    """
    view = completed.view
    assert completed.alpha is not None, "the model predicts alpha"
    image = torch.cat([completed.rgb, completed.alpha[None]])
    if isinstance(last, LastView) and last.precedes(view.camera, view.time):
        change = steadying_change(_channels(image), last.placed_in(view.camera))
        weight = view.error * predicted
        image = (image + weight * torch.from_numpy(change).to(image).permute(2, 0, 1)).clamp(0, 1)
        completed = replace(completed, rgb=image[:3], alpha=image[3])
    return completed, LastView(image, view.camera, view.time, depth_m)


def steadying_change(now: Channels, before: Channels) -> Channels:
    """The change of a view that reduces flicker, given the last view in the same image coordinates."""
    height, width = now.shape[:2]
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    flow = search.calc(_grey(now), _grey(before), None)  # pyrefly: ignore[no-matching-overload]
    flow_px = np.asarray(flow, np.float32)
    x_px = np.arange(width, dtype=np.float32) + flow_px[..., 0]
    y_px = np.arange(height, dtype=np.float32)[:, None] + flow_px[..., 1]
    moved = np.asarray(cv2.remap(before, x_px, y_px, cv2.INTER_CUBIC)).clip(0, 1)

    difference = moved - now
    means = np.asarray(cv2.blur(difference, (MEAN_PX, MEAN_PX)))
    from_means = _part(means, MEAN_WEIGHT, MEAN_SIMILAR)
    return from_means + _part(difference - means, DETAIL_WEIGHT, DETAIL_SIMILAR)


def _part(difference: Channels, weight: float, similar: float) -> Channels:
    """The part of a difference to undo: nearly `weight` of small ones, little of those above `similar`."""
    largest = np.abs(difference).max(-1, keepdims=True)
    return weight * np.exp(-((largest / similar) ** 2)) * difference


def _grey(image: Channels) -> UInt8[np.ndarray, "height width"]:
    return np.asarray(cv2.cvtColor((255 * image[..., :3]).astype(np.uint8), cv2.COLOR_RGB2GRAY))


def _channels(image: Float[Tensor, "4 height width"]) -> Channels:
    return image.permute(1, 2, 0).float().cpu().contiguous().numpy()
