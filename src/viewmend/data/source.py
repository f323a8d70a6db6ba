"""Sources of frames: the protocol, wrappers around a source, resizing, and reading ahead."""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import islice
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.types import MultiViewFrame

FRAMES_AHEAD = 2
"""Frames that `prefetch` reads ahead."""


@runtime_checkable
class CaptureSource(Protocol):
    """A calibrated multi-camera capture: a folder, a synthetic scene, a live rig."""

    @property
    def name(self) -> str:
        """Name for messages and titles."""
        ...

    @property
    def cameras(self) -> Cameras:
        """All cameras, after undistortion, in metres."""
        ...

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Frame ids in temporal order. A static capture has one."""
        ...

    @property
    def fps(self) -> float | None:
        """Frames per second; None if unknown or static."""
        ...

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """World up, used only as a default by viewers and orbits; None if unknown."""
        ...

    @property
    def bounds(self) -> Bounds | None:
        """The volume that contains the subject; None if unknown."""
        ...

    def read(self, time: int) -> MultiViewFrame:
        """Read the frame at index `time` of `frame_ids`. Cameras without an image in this frame are absent.

        CaptureError if all files are missing, or one is unreadable or has the wrong size;
        IndexError without that time.
        """
        ...


@dataclass(frozen=True)
class MemoryCapture:
    """A capture whose frames are in memory, numbered from 0.

    Examples:
        >>> from viewmend.data.source import MemoryCapture
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> MemoryCapture("ours", frame.cameras, (frame,)).frame_ids
        ('0',)
    """

    name: str
    cameras: Cameras
    """All cameras; a frame may lack some of them."""
    frames: tuple[MultiViewFrame, ...]
    fps: float | None = None
    up: Float[Tensor, "3"] | None = None
    bounds: Bounds | None = None

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """The frames' numbers."""
        return tuple(str(number) for number in range(len(self.frames)))

    def read(self, time: int) -> MultiViewFrame:
        """The frame at index `time`."""
        return self.frames[time]


class CaptureWrapper:
    """Base class of sources that change another source; every property is that of the wrapped source."""

    source: CaptureSource

    @property
    def name(self) -> str:
        """Name for messages and titles."""
        return self.source.name

    @property
    def cameras(self) -> Cameras:
        """All cameras, after undistortion, in metres."""
        return self.source.cameras

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Frame ids in temporal order."""
        return self.source.frame_ids

    @property
    def fps(self) -> float | None:
        """Frames per second."""
        return self.source.fps

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """World up."""
        return self.source.up

    @property
    def bounds(self) -> Bounds | None:
        """The volume that contains the subject."""
        return self.source.bounds


@dataclass(frozen=True)
class CaptureSubset(CaptureWrapper):
    """Some frames of a source, optionally with smaller images."""

    source: CaptureSource  # pyrefly: ignore[bad-override]
    times: range
    """Indices into the source's frames."""
    scale: float = 1.0
    """Scale of the image sides, at most 1. Below 1, depth is dropped."""

    @property
    def cameras(self) -> Cameras:
        """The cameras of the scaled images."""
        return scale_cameras(self.source.cameras, self.scale)

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """Ids of the selected frames."""
        return tuple(self.source.frame_ids[time] for time in self.times)

    def read(self, time: int) -> MultiViewFrame:
        """Read the frame at index `time` of the subset; raises as `CaptureSource.read` does."""
        frame = self.source.read(self.times[time])
        small = resize_frame(frame, scale_cameras(frame.cameras, self.scale))
        return MultiViewFrame(small.cameras, small.rgb, small.mask, time, small.depth)


def prefetch(source: CaptureSource, times: Iterable[int] | None = None) -> Iterator[MultiViewFrame]:
    """Yield the frames at `times` (default: all) in order, while a thread reads the next ones.

    Frames are read one at a time: folders already decode their cameras in parallel, and videos need
    frames in order. An error is raised in the place of the frame that could not be read. Closing
    the iterator cancels pending reads.
    """
    coming = iter(range(len(source.frame_ids)) if times is None else times)
    pending: deque[Future[MultiViewFrame]] = deque()
    pool = ThreadPoolExecutor(1, thread_name_prefix="prefetch")
    try:
        while True:
            pending.extend(
                pool.submit(source.read, time) for time in islice(coming, FRAMES_AHEAD + 1 - len(pending))
            )
            if not pending:
                return
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def limit_size(frame: MultiViewFrame, max_image_size: int | None) -> MultiViewFrame:
    """Reduce each image of a frame to at most this length of its longer side; see `resize_frame`."""
    return resize_frame(frame, limit_camera_size(frame.cameras, max_image_size))


def limit_camera_size(cameras: Cameras, max_image_size: int | None) -> Cameras:
    """Reduce each camera to at most this length of its longer side; returns `cameras` if none is larger."""
    if max_image_size is None:
        return cameras
    return scale_cameras(
        cameras, *(min(1.0, max_image_size / max(size)) for size in cameras.size_px.tolist())
    )


def scale_cameras(cameras: Cameras, *scales: float) -> Cameras:
    """The cameras of images with scaled sides: one scale for all, or one for each; `cameras` if all scales are 1."""
    if all(scale == 1 for scale in scales):
        return cameras
    sizes = zip(cameras.size_px.tolist(), scales * (len(cameras) // len(scales)), strict=True)
    resized = [[max(1, round(side * scale)) for side in size] for size, scale in sizes]
    return concatenate_cameras([cameras[view].resized(*size) for view, size in enumerate(resized)])


def resize_frame(frame: MultiViewFrame, cameras: Cameras) -> MultiViewFrame:
    """Resize images and masks (bilinear, antialiased) to `cameras`, which are the frame's own cameras resized.

    Depth is dropped, because averaged depths are wrong at edges. If `cameras` is `frame.cameras`,
    returns the frame.
    """
    if cameras is frame.cameras:
        return frame
    layers = frame.rgb if frame.mask is None else torch.cat([frame.rgb, frame.mask[:, None]], 1)
    width, height = cameras.max_size_px
    small = layers.new_zeros(*layers.shape[:2], height, width)
    sizes = zip(cameras.size_px.tolist(), frame.cameras.size_px.tolist(), strict=True)
    for view, ((w, h), (full_w, full_h)) in enumerate(sizes):
        full = layers[None, view, :, :full_h, :full_w].float()
        resized = F.interpolate(full, (h, w), mode="bilinear", antialias=True, align_corners=False)
        small[view, :, :h, :w] = resized[0].round().clamp(0, 255).to(torch.uint8)
    return MultiViewFrame(cameras, small[:, :3], None if frame.mask is None else small[:, 3], frame.time)
