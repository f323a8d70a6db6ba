"""A capture whose masks are made as it is read."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from viewmend.data.source import CaptureSource, CaptureWrapper
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.preprocess.masks.chroma import without_spill
from viewmend.preprocess.masks.maker import MaskMaker, Rgb, lasting
from viewmend.preprocess.masks.multi_view_cleanup import agreed, supported
from viewmend.types import MultiViewFrame

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
