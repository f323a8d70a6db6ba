"""A capture whose masks are made while it is read."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor

from viewmend.capture.masks.across import agreed, supported
from viewmend.capture.masks.chroma import without_spill
from viewmend.capture.masks.colours import by_colours
from viewmend.capture.masks.maker import MaskMaker, Rgb
from viewmend.capture.masks.over_time import lasting
from viewmend.capture.source import CaptureSource, OfSource
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame


@dataclass
class MaskedCapture(OfSource):
    """A source with masks, by a maker a camera. Makers that remember want it read in order of time."""

    source: CaptureSource
    makers: Mapping[str, MaskMaker]
    clean: bool = True
    """Parts that are there at one time only go, and cameras are asked about each other's masks."""
    unsure: Mapping[str, Bool[np.ndarray, "height width"]] = field(default_factory=dict)
    """Where a camera's background is not known; colours decide there, as far as the other cameras allow it."""
    screens: Mapping[str, Rgb] | None = None
    """What lies behind each camera's subject: its green or blue is taken off the edges. None: it stays."""
    _near: dict[int, MultiViewFrame] = field(default_factory=dict)
    """Frames with masks as the makers gave them, of the times around the last."""

    def read(self, time: int) -> MultiViewFrame:
        """The source's frame, with masks.

        Raises:
            CaptureError: the source cannot read it.
            IndexError: `time` is not in the source.
            ValueError: a maker was made for images of another size.
        """
        around = range(max(time - 1, 0), min(time + 2, len(self.frame_ids))) if self.clean else (time,)
        self._near = {t: self._near[t] if t in self._near else self._made(t) for t in around}
        frame = self._near.get(time) or self._made(time)
        assert frame.mask is not None
        if self.clean:
            frame = self._cleaned(frame, self._lasting(frame))
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
            own = _own_mask(frame, name)
            beside = [self._near.get(frame.time + step) for step in (-1, 1)]
            before, after = (
                None if other is None or name not in other.cameras.names else _own_mask(other, name) for other in beside
            )
            _put(mask, view, lasting(own, before, after))
        return mask

    def _cleaned(self, frame: MultiViewFrame, mask: UInt8[Tensor, "view height width"]) -> MultiViewFrame:
        cameras = frame.cameras
        if any(own.any() for own in self.unsure.values()):
            possible = mask.clone()
            for view, name in enumerate(cameras.names):
                _put(possible, view, np.where(self.unsure[name], 255, _cut(mask, cameras, view)).astype(np.uint8))
            for view, seen in enumerate(supported(possible, cameras, self.bounds)):
                if seen is not None:
                    name, own = cameras.names[view], _cut(mask, cameras, view)
                    _put(mask, view, by_colours(view_rgb(frame, view), own, self.unsure[name], seen))
        return replace(frame, mask=agreed(mask, cameras, self.bounds))


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
