"""Completed virtual cameras: views that a model completes between the real cameras, as further images.

A page draws from them as from cameras that see more than the real ones (`live/page/draw/scene.js`).
"""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.data.source import scale_cameras
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.orbit import orbit_around
from viewmend.geometry.proxy import GeometryProxy
from viewmend.stream import Stream
from viewmend.types import MultiViewFrame

MAX_COMPLETED = 24
"""The largest number of completed virtual cameras of a frame."""
FINER = 1.4
"""Completed images have this many times as many pixels along a side as the cameras' images, because
the page blurs them once more when it draws from them."""
MAX_FINER_PX = 1024
"""Images are not enlarged beyond this length of their longer side, in pixels."""


def place_around(
    rig: Cameras, center: Float[Tensor, "3"], up: Float[Tensor, "3"] | None, count: int
) -> Cameras:
    """Evenly spaced poses on a circle around the subject, as far and as high as the rig's cameras on average.

    For a rig on one side, they cover the arc that the rig covers.

    Args:
        rig: the real cameras.
        center: the subject's middle, metres.
        up: the world's up; None to estimate it from the rig.
        count: the number of poses.
    """
    around = orbit_around(center, rig, up, count, count)
    # The path around a rig on one side swings there and back: then only its way there is used.
    swings = count > 2 and around.centers[1].allclose(around.centers[-1], atol=1e-4)
    return orbit_around(center, rig, up, count, 2 * count - 2) if swings else around


def with_finer_images(cameras: Cameras) -> Cameras:
    """The cameras with larger images of the same field of view (`FINER`)."""
    scales = (max(1.0, min(FINER, MAX_FINER_PX / max(size))) for size in cameras.size_px.tolist())
    return scale_cameras(cameras, *scales)


def complete_views(stream: Stream, cached: CachedFrame, cameras: Cameras) -> MultiViewFrame:
    """Complete a frame's views at these cameras.

    Args:
        stream: completes the views; the frame has been added to it.
        cached: the frame.
        cameras: the virtual cameras.

    Returns:
        Straight colours as images, and alpha as masks, on the CPU.
    """
    assert isinstance(cached.proxy, GeometryProxy), "no other geometry can be rendered"
    images = []
    masks = []
    for number in range(len(cameras)):
        camera = cameras[number].to(cached.frame.rgb.device)
        completed = stream.view(camera, time=cached.frame.time).completed
        images.append((255 * completed.straight_rgb).round().byte().cpu())
        masks.append((255 * completed.opacity.clamp(0, 1)).round().byte().cpu())
    return MultiViewFrame(cameras.to("cpu"), torch.stack(images), torch.stack(masks), cached.frame.time)
