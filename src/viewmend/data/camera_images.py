"""The images of one camera in one frame, and stacks of those of several cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32, UInt8

from viewmend.geometry.cameras import Cameras
from viewmend.types import MultiViewFrame


@dataclass(frozen=True)
class CameraImages:
    """The images of one camera in one frame."""

    rgb: UInt8[np.ndarray, "height width 3"]
    mask: UInt8[np.ndarray, "height width"] | None
    depth: Float32[np.ndarray, "height width"] | None
    """z-depth in metres; 0 where unknown."""


def stack_images(images: Sequence[CameraImages], cameras: Cameras, time: int) -> MultiViewFrame:
    """Stack the images of several cameras, padded at the right and bottom.

    Masks and depth are stacked only if all cameras have them.
    """
    width, height = cameras.max_size_px
    have_masks = all(image.mask is not None for image in images)
    have_depth = all(image.depth is not None for image in images)
    rgb = torch.zeros(len(images), 3, height, width, dtype=torch.uint8)
    mask = torch.zeros(len(images), height, width, dtype=torch.uint8) if have_masks else None
    depth = torch.zeros(len(images), height, width) if have_depth else None
    for view, image in enumerate(images):
        h, w = image.rgb.shape[:2]
        rgb[view, :, :h, :w] = torch.from_numpy(image.rgb).permute(2, 0, 1)
        if mask is not None:
            mask[view, :h, :w] = torch.from_numpy(image.mask)
        if depth is not None:
            depth[view, :h, :w] = torch.from_numpy(image.depth)
    return MultiViewFrame(cameras, rgb, mask, time, depth)
