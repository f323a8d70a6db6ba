"""Samples as the published networks are shown them in training: framed as `OnlineInpainter` frames a stream."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from viewmend.backgrounds import Background
from viewmend.baselines.camera_windows import aim, camera_windows, foreground
from viewmend.baselines.framing import Window, dilated, resized_canvas, window_canvas, windows_over
from viewmend.baselines.online import OnlineConfig
from viewmend.inpainting.upon_white import view_upon
from viewmend.training.samples import Sample
from viewmend.training.true_images import true_image

FRAMINGS: tuple[Literal["def", "win", "mul"], ...] = ("def", "win", "mul")
REFERENCES = 3
"""Frames of cameras in a clip, at most."""


@dataclass(frozen=True)
class TrainingClip:
    """Consecutive views of one camera, the oldest first, and what other cameras saw."""

    frames: Float[Tensor, "time 3 height width"]
    """Colours in [-1, 1], 0 in the holes."""
    holes: Bool[Tensor, "time height width"]
    """Where frames are 0: dilated, as the network sees them."""
    truth: Float[Tensor, "time 3 height width"]
    """F*, in [-1, 1]."""
    references: Float[Tensor, "reference 3 height width"]
    """Whole images of other cameras; none but in mul."""


def training_clip(
    sample: Sample, size_px: tuple[int, int], framing: Literal["def", "win", "mul"], background: Background = "black"
) -> TrainingClip:
    """The clip that ends in `sample`, in one of the framings; which window and references is random.

    Args:
        sample: with those before it.
        size_px: height and width that the network is trained at.
        framing: the whole view resized, or a window that the last view's holes need, without or with the cameras.
        background: what views and truth are upon; cameras' images are black behind the subject, as on a stream.
    """
    make = resized_canvas if framing == "def" else window_canvas
    dilation_px = OnlineConfig().dilation_px
    views = [view_upon(background, s.view) for s in sample.clip]
    canvases = [make(view.rgb, view.error > 0, size_px, dilation_px) for view in views]
    whole = torch.zeros_like(sample.view.error, dtype=torch.bool)
    truths = [make(true_image(s, background), whole, size_px, 0).image for s in sample.clip]
    window = Window(0, 0)
    if framing != "def":
        windows = windows_over(canvases[-1].holes, size_px, OnlineConfig(size_px=size_px).overlap_px)
        window = windows[int(torch.randint(len(windows), ()))] if windows else window
    references = torch.zeros(0, 3, *size_px, device=sample.view.rgb.device)
    if framing == "mul":
        seen = [
            camera_windows(foreground(s.context[0]), s.context[0], aim(s.view, window, size_px), size_px)
            for s in sample.clip
        ]
        all_seen = torch.cat(seen).to(references)
        references = all_seen[torch.randperm(len(all_seen))[:REFERENCES]]
    return TrainingClip(
        frames=torch.stack([window.of(c.image, size_px) for c in canvases]),
        holes=torch.stack([window.of(dilated(c.holes, dilation_px), size_px) for c in canvases]),
        truth=torch.stack([window.of(image, size_px) for image in truths]),
        references=references,
    )
