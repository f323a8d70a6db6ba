"""A capture as everybody looks at it: opened, aligned on its input cameras alone, images no larger than wanted.

`mend`, `serve`, evaluation and training all take their frames from here, so that they see the same pixels. Colours
stay as the files store them: 8 bit RGB.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from viewmend.capture.errors import CaptureError
from viewmend.capture.plain import PlainCapture, open_capture
from viewmend.capture.source import CaptureSource
from viewmend.geometry.alignment import Alignment, shared_offset
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, concatenate_cameras
from viewmend.views import MultiViewFrame


@dataclass(frozen=True)
class PreparedCapture:
    """A `CaptureSource` whose cameras are aligned, and whose images are reduced, as `prepare` was asked."""

    source: CaptureSource
    alignment: Alignment | None = None
    """The shift of all images that was found in the input cameras' masks; None where none was looked for."""
    longest_px: int | None = None
    """Images are reduced to at most this length of their longer side; None leaves them as they are."""

    @property
    def cameras(self) -> Cameras:
        """All cameras, those that are no inputs too, moved by the shift and resized with their images."""
        x_px, y_px = self.alignment.offset_px if self.alignment else (0.0, 0.0)
        return _reduced_cameras(self.source.cameras.moved(x_px, y_px), self.longest_px)

    @property
    def name(self) -> str:
        """The source's."""
        return self.source.name

    @property
    def frame_ids(self) -> tuple[str, ...]:
        """The source's."""
        return self.source.frame_ids

    @property
    def fps(self) -> float | None:
        """The source's."""
        return self.source.fps

    @property
    def up(self) -> Float[Tensor, "3"] | None:
        """The source's."""
        return self.source.up

    @property
    def bounds(self) -> Bounds | None:
        """The source's."""
        return self.source.bounds

    def read(self, time: int) -> MultiViewFrame:
        """All cameras that are there at index `time`, with `cameras`' calibration; errors are the source's."""
        frame = reduced(self.source.read(time), self.longest_px)
        return replace(frame, cameras=self.cameras.select(frame.cameras.names))


def prepare(
    source: CaptureSource,
    inputs: Sequence[str] | None = None,
    *,
    longest_px: int | None = None,
    align: bool = True,
    first: int = 0,
) -> PreparedCapture:
    """Align a capture and say how large its images may be.

    Args:
        source: the capture.
        inputs: names of the cameras that may be looked at; None for all. A camera that is left out is not among them,
            and no pixel of it changes anything.
        longest_px: images are reduced to at most this length of their longer side.
        align: look for a shift that all images share, in the masks of the first frame from `first` on that two inputs
            with any foreground are in. The shift is found at full size.
        first: index of the first frame that will be used.

    Raises:
        CaptureError: a frame cannot be read.
        ValueError: the masks agree on no subject.

    Examples:
        >>> from viewmend import prepare
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> capture = prepare(Studio(StudioConfig(cameras=4, frames=1, size_px=64)), longest_px=32, align=False)
        >>> capture.read(0).rgb.shape
        torch.Size([4, 3, 32, 32])
    """
    return PreparedCapture(source, _alignment(source, inputs, first) if align else None, longest_px)


def open_masked(path: Path | str, cameras: Sequence[str] | None = None, held: int = 0) -> PlainCapture:
    """Open a capture that has masks, and at least two input cameras besides `held` cameras that are left out.

    Raises:
        CaptureError: it cannot be opened (see `open_capture`), has no masks, or too few cameras.
    """
    capture = open_capture(path, cameras)
    if not capture.has_masks:
        raise CaptureError(
            f"{path}: expected a 'mask' for every camera, got none: the visual hull is carved from them, and the truth "
            "cut out; segment the foreground and name the files in cameras.json"
        )
    count = len(capture.cameras) - held
    if count < 2:
        raise CaptureError(f"{path}: expected at least 2 input cameras, got {count}; use more cameras")
    return capture


def reduced(frame: MultiViewFrame, longest_px: int | None) -> MultiViewFrame:
    """The frame with every image reduced, never enlarged, to at most this length of its longer side.

    Images and masks are filtered (bilinear, antialiased). A frame that is small enough comes back itself; another one
    loses its depth, which has no mean.
    """
    cameras = _reduced_cameras(frame.cameras, longest_px)
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


def _reduced_cameras(cameras: Cameras, longest_px: int | None) -> Cameras:
    """The cameras of reduced images; themselves where all images are small enough."""
    if longest_px is None or int(cameras.size_px.max()) <= longest_px:
        return cameras
    scales = [min(1.0, longest_px / max(size)) for size in cameras.size_px.tolist()]
    sizes = [
        [max(1, round(side * scale)) for side in size]
        for size, scale in zip(cameras.size_px.tolist(), scales, strict=True)
    ]
    return concatenate_cameras([cameras[view].resized(*size) for view, size in enumerate(sizes)])


def _alignment(source: CaptureSource, inputs: Sequence[str] | None, first: int) -> Alignment | None:
    for time in range(first, len(source.frame_ids)):
        frame = source.read(time)
        if inputs is not None:
            frame = frame.select([name for name in inputs if name in frame.cameras.names])
        if len(frame.cameras) >= 2 and frame.mask is not None and bool((frame.mask > 0).any()):
            return shared_offset(frame.mask, frame.cameras, source.bounds)
    return None
