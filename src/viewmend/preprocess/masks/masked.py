"""A capture whose masks are made as it is read, and their clean-up across cameras."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from viewmend.data.source import CaptureSource, CaptureWrapper, scale_cameras
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.proxy import reconstruct
from viewmend.preprocess.masks.maker import Inside, Mask, MaskMaker, Rgb, lasting, without_spill
from viewmend.types import MultiViewFrame

Masks = UInt8[Tensor, "view height width"]

CARVED_PX = 480
"""Silhouettes are compared in images of this longer side."""
MARGIN_PX = 4
"""Dilation of silhouettes and hulls, for inexact calibration and voxels."""
GAP = 1 / 24
"""Gaps of a mask up to this share of the image's longer side are filled where the other cameras
support it."""
GROUP = 3
"""Cameras per group; a pixel is kept if any group supports it, so that one bad mask has no effect."""


def agreed(mask: Masks, cameras: Cameras, bounds: Bounds | None) -> Masks:
    """Clean the masks of one frame, each with the hull of the others.

    A pixel is dropped where the hull of no group of the others is seen; it is filled where those of
    all groups are, and the camera's own mask lies around it. Masks of fewer than three cameras, and
    those that agree on nothing, come back as they are.
    """
    if len(cameras) < 3:
        return mask
    cleaned = mask.clone()
    for view, votes in enumerate(_votes(mask, cameras, bounds)):
        if votes is not None:
            _put(cleaned, view, _judged(_cut(mask, cameras, view), *votes))
    return cleaned


def _votes(mask: Masks, cameras: Cameras, bounds: Bounds | None) -> Iterator[tuple[Inside, Inside] | None]:
    """Yield silhouettes of hulls in each camera: of groups of the others (dilated), and of all.

    None without a hull.
    """
    small, small_cameras = _reduced(mask, cameras)
    there = [view for view in range(len(cameras)) if bool((small[view] > FOREGROUND).any())]
    for view, size_px in enumerate(cameras.size_px.tolist()):
        others = [other for other in there if other != view]
        groups = max(1, len(others) // GROUP)
        seen = []
        for group in (others[first::groups] for first in range(groups if len(others) > 1 else 0)):
            hull = reconstruct(small[group], small_cameras[group], bounds)
            seen.append(hull.depth(small_cameras[view])[0].numpy() > 0)
        if any(one.any() for one in seen):
            votes = (_widened(np.any(seen, 0)), np.all(seen, 0))
            some, all_ = (np.asarray(cv2.resize(vote.astype(np.float32), size_px)) > 0.5 for vote in votes)
            yield some, all_
        else:
            yield None


def _judged(own: Mask, some: Inside, all_: Inside) -> Mask:
    radius = max(1, round(GAP * max(own.shape) / 2))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    kept = np.where(some, own, 0).astype(np.uint8)
    around = np.asarray(cv2.morphologyEx(kept, cv2.MORPH_CLOSE, disc))
    return np.where(all_, np.maximum(kept, around), kept).astype(np.uint8)


def _reduced(mask: Masks, cameras: Cameras) -> tuple[UInt8[Tensor, "view small_height small_width"], Cameras]:
    """Masks and cameras at the size that they are compared in, silhouettes widened."""
    small = scale_cameras(cameras, min(1.0, CARVED_PX / int(cameras.size_px.max())))
    width, height = small.max_size_px
    masks = torch.zeros(len(mask), height, width, dtype=torch.uint8)
    for view, size_px in enumerate(small.size_px.tolist()):
        own = np.asarray(cv2.resize(_cut(mask, cameras, view), size_px, interpolation=cv2.INTER_AREA))
        _put(masks, view, 255 * _widened(own > FOREGROUND).astype(np.uint8))
    return masks, small


def _widened(inside: Inside) -> Inside:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1))
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
    """What the other cameras and the neighbouring frames correct: nothing; whole connected parts,
    dropped where they lie outside the hull of the other cameras (bystanders); or pixels, dropped
    and filled, for methods that err by colour."""
    screens: Mapping[str, Rgb] | None = None
    """Background behind each camera's subject, whose green or blue is removed from the outline.
    None: leave colours."""
    _near: dict[int, MultiViewFrame] = field(default_factory=dict)
    """Frames around the last one, with the masks of the makers."""

    def read(self, time: int) -> MultiViewFrame:
        """The source's frame, with masks; raises what the source and the makers do."""
        reach = 1 if self.clean_up == "pixels" else 0
        around = range(max(time - reach, 0), min(time + reach + 1, len(self.frame_ids)))
        self._near = {t: self._near[t] if t in self._near else self._made(t) for t in around}
        frame = self._near.get(time) or self._made(time)
        mask = _mask_of(frame)
        cameras = frame.cameras
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

    def _lasting(self, frame: MultiViewFrame) -> Masks:
        mask = torch.zeros_like(_mask_of(frame))
        for view, name in enumerate(frame.cameras.names):
            before, after = (
                None if other is None or name not in other.cameras.names else _own_mask(other, name)
                for other in (self._near.get(frame.time + step) for step in (-1, 1))
            )
            _put(mask, view, lasting(_own_mask(frame, name), before, after))
        return mask


def _supported_parts(mask: Masks, cameras: Cameras, bounds: Bounds | None) -> Masks:
    """The masks without connected parts that lie outside the hull of the other cameras; at least one part stays."""
    kept = mask.clone()
    for view, votes in enumerate(_votes(mask, cameras, bounds)):
        own = _cut(mask, cameras, view)
        count, found = cv2.connectedComponents((own > 0).astype(np.uint8), connectivity=8)
        if votes is None or count <= 2:
            continue
        labels = np.asarray(found, np.int32)
        weight = np.bincount(labels.ravel(), own.ravel(), count)
        share = np.bincount(labels.ravel(), (own * votes[0]).ravel(), count) / np.maximum(weight, 1)
        if bool((share[1:] >= MIN_SUPPORT).any()):
            _put(kept, view, np.where((share >= MIN_SUPPORT)[labels], own, 0).astype(np.uint8))
    return kept


def view_rgb(frame: MultiViewFrame, view: int) -> Rgb:
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


def _mask_of(frame: MultiViewFrame) -> Masks:
    assert frame.mask is not None, "masks were made"
    return frame.mask


def _own_mask(frame: MultiViewFrame, name: str) -> Mask:
    return _cut(_mask_of(frame), frame.cameras, frame.cameras.names.index(name))


def _cut(mask: Masks, cameras: Cameras, view: int) -> UInt8[np.ndarray, "rows columns"]:
    width, height = (int(side) for side in cameras.size_px[view])
    return mask[view, :height, :width].numpy()


def _put(mask: Masks, view: int, own: UInt8[np.ndarray, "rows columns"]) -> None:
    mask[view, : own.shape[0], : own.shape[1]] = torch.from_numpy(own)
