"""Real captures as scenes: a camera is left out, and its own image is the truth."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from random import Random

import torch
from torch.nn import functional as F

from viewmend.capture.errors import CaptureError
from viewmend.capture.plain import open_capture
from viewmend.capture.source import CaptureSource
from viewmend.geometry.alignment import shared_offset
from viewmend.geometry.cameras import concatenate_cameras
from viewmend.training.plan import DataPlan
from viewmend.training.samples import Sample
from viewmend.training.scenes import SceneSource, rig_samples
from viewmend.views import MultiViewFrame


class CaptureScenes:
    """Moments of captures, reduced to the plan's sizes; principal points are aligned once, as `mend` does."""

    def __init__(self, captures: Sequence[CaptureSource], plan: DataPlan, seed: str) -> None:
        """Look at the first frame of each.

        Raises:
            CaptureError: a capture has no masks, or fewer than three cameras.
        """
        self.captures = captures
        self.plan = plan
        self.seed = seed
        self._offsets_px = [_offset_px(capture) for capture in captures]

    def scene(self, number: int) -> list[Sample]:
        """One moment of one capture with its past."""
        random = Random(f"{self.seed}/{number}")
        which = random.randrange(len(self.captures))
        capture = self.captures[which]
        last = len(capture.frame_ids) - 1
        first = random.randint(0, max(0, last - max(self.plan.times)))
        size_px = random.choice(self.plan.sizes_px)
        frames = {}
        for time in sorted({min(first + offset, last) for offset in self.plan.times}):
            frame = capture.read(time)
            frame = replace(frame, cameras=frame.cameras.moved(*self._offsets_px[which]))
            frames[time] = reduced(frame, size_px).to(self.plan.device)
        # A camera that has no image at some of these times cannot be judged then.
        always = [n for n in frames[max(frames)].cameras.names if all(n in f.cameras.names for f in frames.values())]
        frames = {time: frame.select(always) for time, frame in frames.items()}
        return rig_samples(frames, lambda held, time: frames[time].select([held]), capture.bounds, self.plan, random)


class MixedScenes:
    """Two sources, of which `share` of the scenes come from the first."""

    def __init__(self, first: SceneSource[Sample], second: SceneSource[Sample], share: float, seed: str) -> None:
        self.first = first
        self.second = second
        self.share = share
        self.seed = seed

    def scene(self, number: int) -> Sequence[Sample]:
        """A scene of either."""
        source = self.first if Random(f"{self.seed}/which/{number}").random() < self.share else self.second
        return source.scene(number)


def open_captures(folders: Sequence[Path]) -> list[CaptureSource]:
    """The captures in these folders."""
    return [open_capture(folder) for folder in folders]


def reduced(frame: MultiViewFrame, longest_px: int) -> MultiViewFrame:
    """The frame with every image reduced, not enlarged, to at most this length of its longer side."""
    rgb, masks, cameras = [], [], []
    assert frame.mask is not None, "what trains has masks"
    for i, (width, height) in enumerate(frame.cameras.size_px.tolist()):
        scale = min(1.0, longest_px / max(width, height))
        size = max(1, round(height * scale)), max(1, round(width * scale))
        image = torch.cat([frame.rgb[i, :, :height, :width], frame.mask[i : i + 1, :height, :width]]).float()
        small = F.interpolate(image[None], size, mode="bilinear", antialias=True, align_corners=False)[0]
        small = small.round().clamp(0, 255).to(torch.uint8)
        rgb.append(small[:3])
        masks.append(small[3])
        cameras.append(frame.cameras[i].resized(size[1], size[0]))
    together = concatenate_cameras(cameras)
    width, height = together.max_size_px
    pads = [(0, width - m.shape[1], 0, height - m.shape[0]) for m in masks]
    return MultiViewFrame(
        together,
        torch.stack([F.pad(image, pad) for image, pad in zip(rgb, pads, strict=True)]),
        torch.stack([F.pad(mask, pad) for mask, pad in zip(masks, pads, strict=True)]),
        frame.time,
    )


def _offset_px(capture: CaptureSource) -> tuple[float, float]:
    frame = capture.read(0)
    if frame.mask is None or len(frame.cameras) < 3:
        without = "without masks" if frame.mask is None else f"of {len(frame.cameras)} cameras"
        raise CaptureError(
            f"{capture.name}: expected a capture with masks and at least 3 cameras, one of which is left out in turn, "
            f"got one {without}; segment the foreground, or film with more cameras"
        )
    return shared_offset(frame.mask, frame.cameras, capture.bounds).offset_px
