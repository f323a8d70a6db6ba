"""A capture whose masks are made as it is read, and their clean-up across cameras."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from viewmend.data.source import CaptureSource, CaptureWrapper
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.proxy import reconstruct
from viewmend.preprocess.masks.maker import MaskMaker, Rgb, lasting, without_spill
from viewmend.types import MultiViewFrame

CARVED_PX = 480
"""Silhouettes are compared in images of this longer side."""
MARGIN_PX = 4
"""Dilation of silhouettes and hulls, for inexact calibration and voxels."""
GAP = 1 / 24
"""Gaps of a mask up to this share of the image's longer side are filled where the other cameras support it."""
GROUP = 3
"""Cameras per group; a pixel is kept if any group supports it, so that one bad mask has no effect."""


def agreed(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds | None
) -> UInt8[Tensor, "view height width"]:
    """Clean the masks of one frame, each with the hull of the others.

    A pixel is dropped where the hull of no group of the others is seen; it is filled where those of all groups are, and
    the camera's own mask lies around it. Masks of fewer than three cameras, and those that agree on nothing, come back
    as they are.
    """
    if len(cameras) < 3:
        return mask
    small, small_cameras = _reduced(mask, cameras)
    cleaned = mask.clone()
    for view in range(len(cameras)):
        width, height = (int(side) for side in cameras.size_px[view])
        votes = _votes(small, small_cameras, view, bounds)
        if votes is not None:
            some, all_ = (_enlarged(vote, width, height) for vote in votes)
            cleaned[view, :height, :width] = torch.from_numpy(_judged(mask[view, :height, :width].numpy(), some, all_))
    return cleaned


def supported(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds | None
) -> list[Bool[np.ndarray, "height width"] | None]:
    """Silhouette of the hull of the other cameras in each camera, dilated; None without a hull."""
    small, small_cameras = _reduced(mask, cameras)
    found: list[Bool[np.ndarray, "height width"] | None] = []
    for view in range(len(cameras)):
        votes = _votes(small, small_cameras, view, bounds)
        width, height = (int(side) for side in cameras.size_px[view])
        found.append(None if votes is None else _enlarged(votes[0], width, height))
    return found


def _votes(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, view: int, bounds: Bounds | None
) -> tuple[Bool[np.ndarray, "height width"], Bool[np.ndarray, "height width"]] | None:
    """Silhouettes of the hulls of any group of the others (dilated) and of all groups; None without a hull."""
    others = [v for v in range(len(cameras)) if v != view and bool((mask[v] > FOREGROUND).any())]
    groups = max(1, len(others) // GROUP)
    width, height = (int(side) for side in cameras.size_px[view])
    seen = []
    for first in range(groups):
        group = others[first::groups]
        if len(group) < 2:
            return None
        proxy = reconstruct(mask[group], cameras[group], bounds)
        seen.append(proxy.depth(cameras[view])[0, :height, :width].numpy() > 0)
    if not any(s.any() for s in seen):
        return None
    return _widened(np.any(seen, 0), MARGIN_PX), np.all(seen, 0)


def _judged(
    own: UInt8[np.ndarray, "height width"],
    some: Bool[np.ndarray, "height width"],
    all_: Bool[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width"]:
    import cv2

    radius = max(1, round(GAP * max(own.shape) / 2))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    kept = np.where(some, own, 0).astype(np.uint8)
    around = np.asarray(cv2.morphologyEx(kept, cv2.MORPH_CLOSE, disc))
    return np.where(all_, np.maximum(kept, around), kept).astype(np.uint8)


def _reduced(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras
) -> tuple[UInt8[Tensor, "view small_height small_width"], Cameras]:
    """Masks and cameras at the size that they are compared in, silhouettes widened."""
    import cv2

    scale = min(1.0, CARVED_PX / int(cameras.size_px.max()))
    sizes = [[max(1, round(side * scale)) for side in size] for size in cameras.size_px.tolist()]
    parts = [cameras[view].resized(*size) for view, size in enumerate(sizes)]
    small = Cameras(
        cameras.names,
        torch.cat([part.K for part in parts]),
        cameras.camera_from_world,
        torch.cat([part.size_px for part in parts]),
    )
    width, height = small.max_size_px
    masks = torch.zeros(len(mask), height, width, dtype=torch.uint8)
    for view, (w, h) in enumerate(sizes):
        full_w, full_h = cameras.size_px[view].tolist()
        own = cv2.resize(mask[view, :full_h, :full_w].numpy(), (w, h), interpolation=cv2.INTER_AREA)
        masks[view, :h, :w] = torch.from_numpy(_widened(np.asarray(own) > FOREGROUND, MARGIN_PX).astype(np.uint8)) * 255
    return masks, small


def _enlarged(inside: Bool[np.ndarray, "height width"], width: int, height: int) -> Bool[np.ndarray, "h w"]:
    import cv2

    return np.asarray(cv2.resize(inside.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)) > 0.5


def _widened(inside: Bool[np.ndarray, "height width"], by_px: int) -> Bool[np.ndarray, "height width"]:
    import cv2

    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    return np.asarray(cv2.dilate(inside.astype(np.uint8), disc)) > 0


CleanUp = Literal["none", "parts", "pixels"]
MIN_SUPPORT = 0.2
"""Least share of a connected part that must lie in the hull of the other cameras."""


@dataclass
class MaskedCapture(CaptureWrapper):
    """A source whose masks are made as it is read, by one maker per camera; trackers need its frames in order."""

    source: CaptureSource
    makers: Mapping[str, MaskMaker]
    clean_up: CleanUp = "none"
    """What the other cameras and the neighbouring frames correct: nothing; whole connected parts, dropped where they
    lie outside the hull of the other cameras (bystanders); or pixels, dropped and filled, for methods that err by
    colour."""
    screens: Mapping[str, Rgb] | None = None
    """Background behind each camera's subject, whose green or blue is removed from the outline. None: leave colours."""
    _near: dict[int, MultiViewFrame] = field(default_factory=dict)
    """Frames around the last one, with the masks of the makers."""

    def read(self, time: int) -> MultiViewFrame:
        """The source's frame, with masks.

        Raises:
            CaptureError: the source cannot read it.
            IndexError: `time` is not in the source.
            ValueError: an image has another size than its maker's plate.
        """
        reach = 1 if self.clean_up == "pixels" else 0
        around = range(max(time - reach, 0), min(time + reach + 1, len(self.frame_ids)))
        self._near = {t: self._near[t] if t in self._near else self._made(t) for t in around}
        frame = self._near.get(time) or self._made(time)
        mask, cameras = _mask_of(frame), frame.cameras
        if self.clean_up == "parts":
            frame = replace(frame, mask=_supported_parts(mask, cameras, self.bounds))
        elif self.clean_up == "pixels":
            frame = replace(frame, mask=agreed(self._lasting(frame), cameras, self.bounds))
        return frame if self.screens is None else _without_spill(frame, self.screens)

    def _made(self, time: int) -> MultiViewFrame:
        frame = self.source.read(time)
        mask = torch.zeros(frame.rgb.shape[0], *frame.rgb.shape[2:], dtype=torch.uint8)
        for view, name in enumerate(frame.cameras.names):
            _put(mask, view, self.makers[name].mask(view_rgb(frame, view)))
        return replace(frame, mask=mask)

    def _lasting(self, frame: MultiViewFrame) -> UInt8[Tensor, "view height width"]:
        mask = torch.zeros_like(_mask_of(frame))
        for view, name in enumerate(frame.cameras.names):
            neighbours = [self._near.get(frame.time + step) for step in (-1, 1)]
            before, after = (
                None if other is None or name not in other.cameras.names else _own_mask(other, name)
                for other in neighbours
            )
            _put(mask, view, lasting(_own_mask(frame, name), before, after))
        return mask


def _supported_parts(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds | None
) -> UInt8[Tensor, "view height width"]:
    """The masks without connected parts that lie outside the hull of the other cameras; at least one part stays."""
    import cv2

    kept = mask.clone()
    for view, hull in enumerate(supported(mask, cameras, bounds)):
        own = _cut(mask, cameras, view)
        count, found = cv2.connectedComponents((own > 0).astype(np.uint8), connectivity=8)
        if hull is None or count <= 2:
            continue
        labels = np.asarray(found, np.int32)
        weight = np.bincount(labels.ravel(), own.ravel(), count)
        share = np.bincount(labels.ravel(), (own * hull).ravel(), count) / np.maximum(weight, 1)
        if bool((share[1:] >= MIN_SUPPORT).any()):
            _put(kept, view, np.where((share >= MIN_SUPPORT)[labels], own, 0).astype(np.uint8))
    return kept


def view_rgb(frame: MultiViewFrame, view: int) -> UInt8[np.ndarray, "height width 3"]:
    """One camera's image without its padding."""
    width, height = (int(side) for side in frame.cameras.size_px[view])
    return frame.rgb[view, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()


def _without_spill(frame: MultiViewFrame, screens: Mapping[str, Rgb]) -> MultiViewFrame:
    rgb = frame.rgb.clone()
    for view, name in enumerate(frame.cameras.names):
        image = view_rgb(frame, view)
        clean = without_spill(image, _own_mask(frame, name), screens[name])
        rgb[view, :, : image.shape[0], : image.shape[1]] = torch.from_numpy(clean).permute(2, 0, 1)
    return replace(frame, rgb=rgb)


def _mask_of(frame: MultiViewFrame) -> UInt8[Tensor, "view height width"]:
    assert frame.mask is not None, "masks were made"
    return frame.mask


def _own_mask(frame: MultiViewFrame, name: str) -> UInt8[np.ndarray, "height width"]:
    return _cut(_mask_of(frame), frame.cameras, frame.cameras.names.index(name))


def _cut(mask: UInt8[Tensor, "view height width"], cameras: Cameras, view: int) -> UInt8[np.ndarray, "rows columns"]:
    width, height = (int(side) for side in cameras.size_px[view])
    return mask[view, :height, :width].numpy()


def _put(mask: UInt8[Tensor, "view height width"], view: int, own: UInt8[np.ndarray, "rows columns"]) -> None:
    mask[view, : own.shape[0], : own.shape[1]] = torch.from_numpy(own)
