"""A capture whose masks are made as it is read, and their clean-up across cameras."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import torch

from viewmend.data.source import CaptureSource, CaptureWrapper
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND, HullConfig
from viewmend.preprocess.masks.consensus import (
    MaskNear,
    Masks,
    Settled,
    cut,
    put,
    reduced,
    settle_masks,
    silhouettes_of,
    widened,
)
from viewmend.preprocess.masks.maker import Inside, Mask, MaskMaker, Rgb, lasting, without_spill
from viewmend.types import MultiViewFrame

GAP = 1 / 24
"""Gaps of a mask up to this share of the image's longer side are filled where the other cameras
support it."""
GROUP = 3
"""Cameras per group; a pixel is kept if any group supports it, so that one bad mask has no effect."""
CleanUp = Literal["none", "parts", "pixels"]


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
            put(cleaned, view, _judged(cut(mask, cameras, view), *votes))
    return cleaned


def _votes(mask: Masks, cameras: Cameras, bounds: Bounds | None) -> Iterator[tuple[Inside, Inside] | None]:
    """Yield silhouettes of hulls in each camera: of groups of the others (dilated), and of all.

    None without a hull.
    """
    small, small_cameras = reduced(mask, cameras)
    there = [view for view in range(len(cameras)) if bool((small[view] > FOREGROUND).any())]
    for view, size_px in enumerate(cameras.size_px.tolist()):
        others = [other for other in there if other != view]
        groups = max(1, len(others) // GROUP)
        target = small_cameras[view]
        seen = [
            silhouettes_of(small[group], small_cameras[group], bounds, target, HullConfig())[0].numpy()
            for group in (others[first::groups] for first in range(groups if len(others) > 1 else 0))
        ]
        if any(one.any() for one in seen):
            votes = (widened(np.any(seen, 0)), np.all(seen, 0))
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


@dataclass
class MaskNotes:
    """What comparing the cameras has changed so far, as times by camera."""

    without: dict[str, dict[int, str]] = field(default_factory=dict)
    """Frames in which a camera should see the subject and has no mask, and why."""
    remade: dict[str, set[int]] = field(default_factory=dict)
    """Frames in which a camera's mask was made where the other cameras expect the subject."""
    bystanders: dict[str, dict[int, tuple[int, int]]] = field(default_factory=dict)
    """Frames in which parts of a camera's mask were dropped, and where the rest lies, pixels."""
    several: set[int] = field(default_factory=set)
    """Frames with several people that all cameras see."""

    def add(self, time: int, settled: Settled) -> None:
        """Add one frame."""
        for name, cause in settled.without.items():
            self.without.setdefault(name, {})[time] = cause
        for name in settled.remade:
            self.remade.setdefault(name, set()).add(time)
        for name, center_px in settled.kept_at.items():
            self.bystanders.setdefault(name, {})[time] = center_px
        if settled.several:
            self.several.add(time)


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
    mask_near: MaskNear | None = None
    """Makes the masks of cameras that have none, or one that disagrees with all others, with the
    clean-up "parts"."""
    notes: MaskNotes = field(default_factory=MaskNotes)
    """What the clean-up has changed in the frames that were read."""
    _near: dict[int, MultiViewFrame] = field(default_factory=dict)
    """Frames around the last one, with the masks of the makers."""
    _unmasked: dict[int, MultiViewFrame] = field(default_factory=dict)
    """Cameras without a mask in the frames that were read."""

    def read(self, time: int) -> MultiViewFrame:
        """The source's frame, with masks; raises what the source and the makers do.

        A camera that should see the subject, and of which no mask could be made, is absent.
        """
        reach = 1 if self.clean_up == "pixels" else 0
        around = range(max(time - reach, 0), min(time + reach + 1, len(self.frame_ids)))
        self._near = {t: self._near[t] if t in self._near else self._made(t) for t in around}
        frame = self._near.get(time) or self._made(time)
        if self.clean_up == "pixels":
            frame = replace(frame, mask=agreed(self._lasting(frame), frame.cameras, self.bounds))
        if self.clean_up != "none":
            frame = self._settled(frame)
        return frame if self.screens is None else _without_spill(frame, self.screens)

    def take_unmasked(self, time: int) -> MultiViewFrame | None:
        """The images of cameras that the frame, as last read, lacks because no mask could be made of them.

        None without any. They are returned only once.
        """
        return self._unmasked.pop(time, None)

    def _settled(self, frame: MultiViewFrame) -> MultiViewFrame:
        """The frame with compared masks, without cameras that have none."""
        mask = _mask_of(frame)
        images = [view_rgb(frame, view) for view in range(len(frame.cameras))]
        settled = settle_masks(mask, images, frame.cameras, self.bounds, self.mask_near)
        if self.clean_up == "pixels":  # pixels were compared already, so only empty masks are left out
            empty = [name for name in settled.without if not _own_mask(frame, name).any()]
            is_alone = len(empty) >= len(frame.cameras) - 1  # what one camera alone sees may be noise
            settled = Settled(mask, {} if is_alone else {name: settled.without[name] for name in empty})
        self.notes.add(frame.time, settled)
        if settled.without:
            absent = [name for name in frame.cameras.names if name in settled.without]
            self._unmasked[frame.time] = replace(frame.select(absent), mask=None)
        return replace(frame, mask=settled.mask).without(list(settled.without))

    def _made(self, time: int) -> MultiViewFrame:
        frame = self.source.read(time)
        mask = torch.zeros(frame.rgb.shape[0], *frame.rgb.shape[2:], dtype=torch.uint8)
        for view, name in enumerate(frame.cameras.names):
            put(mask, view, self.makers[name].mask(view_rgb(frame, view)))
        return replace(frame, mask=mask)

    def _lasting(self, frame: MultiViewFrame) -> Masks:
        mask = torch.zeros_like(_mask_of(frame))
        for view, name in enumerate(frame.cameras.names):
            before, after = (
                None if other is None or name not in other.cameras.names else _own_mask(other, name)
                for other in (self._near.get(frame.time + step) for step in (-1, 1))
            )
            put(mask, view, lasting(_own_mask(frame, name), before, after))
        return mask


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
    return cut(_mask_of(frame), frame.cameras, frame.cameras.names.index(name))
