"""Frames whose images are made smaller."""

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.views import MultiViewFrame


def reduced(frame: MultiViewFrame, longest_px: int | None) -> MultiViewFrame:
    """The frame with every image reduced, never enlarged, to at most this length of its longer side.

    Images and masks are filtered (bilinear, antialiased). A frame that is small enough comes back itself; another one
    loses its depth, which has no mean.
    """
    return resized_frame(frame, reduced_cameras(frame.cameras, longest_px))


def resized_frame(frame: MultiViewFrame, cameras: Cameras) -> MultiViewFrame:
    """The frame with images of the sizes of `cameras`, which are its own cameras resized; without depth.

    Where `cameras` are the very ones of the frame, it comes back itself.
    """
    if cameras is frame.cameras:
        return frame
    layers = frame.rgb if frame.mask is None else torch.cat([frame.rgb, frame.mask[:, None]], 1)
    width, height = cameras.max_size_px
    small = layers.new_zeros(*layers.shape[:2], height, width)
    sizes = zip(cameras.size_px.tolist(), frame.cameras.size_px.tolist(), strict=True)
    for view, ((w, h), (full_w, full_h)) in enumerate(sizes):
        small[view, :, :h, :w] = _resized(layers[view, :, :full_h, :full_w], h, w)
    mask = None if frame.mask is None else small[:, 3]
    return MultiViewFrame(cameras, small[:, :3], mask, frame.time)


def _resized(
    image: UInt8[Tensor, "channel full_height full_width"], height: int, width: int
) -> UInt8[Tensor, "channel height width"]:
    small = F.interpolate(image[None].float(), (height, width), mode="bilinear", antialias=True, align_corners=False)
    return small[0].round().clamp(0, 255).to(torch.uint8)


def reduced_cameras(cameras: Cameras, longest_px: int | None) -> Cameras:
    """The cameras of reduced images; themselves where all images are small enough."""
    if longest_px is None or int(cameras.size_px.max()) <= longest_px:
        return cameras
    scales = [min(1.0, longest_px / max(size)) for size in cameras.size_px.tolist()]
    sizes = [
        [max(1, round(side * scale)) for side in size]
        for size, scale in zip(cameras.size_px.tolist(), scales, strict=True)
    ]
    return concatenate_cameras([cameras[view].resized(*size) for view, size in enumerate(sizes)])
