"""Resizing of frames."""

import torch
from jaxtyping import UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.types import MultiViewFrame


def limit_size(frame: MultiViewFrame, longest_px: int | None) -> MultiViewFrame:
    """Reduce each image of a frame to at most this length of its longer side; see `resize_frame`."""
    return resize_frame(frame, limit_camera_size(frame.cameras, longest_px))


def limit_camera_size(cameras: Cameras, longest_px: int | None) -> Cameras:
    """Reduce each camera to at most this length of its longer side; returns `cameras` if none is larger."""
    if longest_px is None or int(cameras.size_px.max()) <= longest_px:
        return cameras
    resized = []
    for view, size in enumerate(cameras.size_px.tolist()):
        scale = min(1.0, longest_px / max(size))
        resized.append(cameras[view].resized(*(max(1, round(side * scale)) for side in size)))
    return concatenate_cameras(resized)


def resize_frame(frame: MultiViewFrame, cameras: Cameras) -> MultiViewFrame:
    """Resize images and masks (bilinear, antialiased) to `cameras`, which are the frame's own cameras resized.

    Depth is dropped, because averaged depths are wrong at edges. If `cameras` is `frame.cameras`, returns the frame.
    """
    if cameras is frame.cameras:
        return frame
    layers = frame.rgb if frame.mask is None else torch.cat([frame.rgb, frame.mask[:, None]], 1)
    width, height = cameras.max_size_px
    small = layers.new_zeros(*layers.shape[:2], height, width)
    sizes = zip(cameras.size_px.tolist(), frame.cameras.size_px.tolist(), strict=True)
    for view, ((w, h), (full_w, full_h)) in enumerate(sizes):
        small[view, :, :h, :w] = _resize(layers[view, :, :full_h, :full_w], h, w)
    mask = None if frame.mask is None else small[:, 3]
    return MultiViewFrame(cameras, small[:, :3], mask, frame.time)


def _resize(
    image: UInt8[Tensor, "channel full_height full_width"], height: int, width: int
) -> UInt8[Tensor, "channel height width"]:
    small = F.interpolate(image[None].float(), (height, width), mode="bilinear", antialias=True, align_corners=False)
    return small[0].round().clamp(0, 255).to(torch.uint8)
