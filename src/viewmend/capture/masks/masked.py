"""A capture whose masks are made while it is read."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.capture.masks.maker import MaskMaker
from viewmend.capture.source import CaptureSource
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.views import MultiViewFrame


class MaskedCapture:
    """A source with masks, by a maker a camera. Makers that remember want it read in order of time."""

    def __init__(self, source: CaptureSource, makers: Mapping[str, MaskMaker]):
        self._source = source
        self._makers = makers

    @property
    def name(self) -> str:
        """The source's name."""
        return self._source.name

    @property
    def cameras(self) -> Cameras:
        """The source's cameras."""
        return self._source.cameras

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """The source's ids."""
        return self._source.frame_ids

    @property
    def fps(self) -> float | None:
        """The source's."""
        return self._source.fps

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """The source's."""
        return self._source.up

    @property
    def bounds(self) -> Bounds | None:
        """The source's."""
        return self._source.bounds

    def read(self, time: int) -> MultiViewFrame:
        """The source's frame, with masks.

        Raises:
            CaptureError: the source cannot read it.
            IndexError: `time` is not in the source.
            ValueError: a maker was made for images of another size.
        """
        frame = self._source.read(time)
        return replace(frame, mask=made_masks(frame, self._makers))


def made_masks(frame: MultiViewFrame, makers: Mapping[str, MaskMaker]) -> UInt8[Tensor, "view height width"]:
    """The mask of each camera by its maker."""
    mask = torch.zeros(frame.rgb.shape[0], *frame.rgb.shape[2:], dtype=torch.uint8)
    for view, name in enumerate(frame.cameras.names):
        own = makers[name].mask(view_rgb(frame, view))
        mask[view, : own.shape[0], : own.shape[1]] = torch.from_numpy(own)
    return mask


def view_rgb(frame: MultiViewFrame, view: int) -> UInt8[np.ndarray, "height width 3"]:
    """One camera's image without its padding."""
    width, height = (int(side) for side in frame.cameras.size_px[view])
    return frame.rgb[view, :, :height, :width].permute(1, 2, 0).contiguous().cpu().numpy()
