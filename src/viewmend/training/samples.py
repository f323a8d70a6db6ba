"""Training samples: a view rendered without one camera of a rig, and what that camera saw (section 8)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.frame_cache import CachedFrame
from viewmend.geometry.hull import HullConfig
from viewmend.models.classical import Unfilled
from viewmend.models.compositing import Background, composite
from viewmend.rendering.view import RenderConfig
from viewmend.scenes.held_out import LeaveOneOut, Protocol, reveal
from viewmend.stream import Stream, StreamConfig
from viewmend.training.config import SamplingConfig, SceneConfig
from viewmend.types import ContextViews, IncompleteView, MultiViewFrame


@dataclass(frozen=True)
class Sample:
    """A rendered view, the camera images around it, and the image of the held-out camera in its place (F*)."""

    view: IncompleteView
    context: tuple[ContextViews, ...]
    """The source views, one element per frame, the view's own frame first."""
    ray_views: ContextViews | None
    """Cameras near the view at its own frame, the source views first, for models that sample along rays."""
    truth: UInt8[Tensor, "3 height width"]
    """F*, on black."""
    previous: "Sample | None" = None
    """The same camera one frame before, in clips."""
    alpha: UInt8[Tensor, "height width"] | None = None
    """True coverage of each pixel by the subject, in 255ths; None if unavailable."""
    depth: Float[Tensor, "height width"] | None = None
    """True z-depth in metres, 0 where there is no surface; None if unavailable."""

    @property
    def clip(self) -> tuple["Sample", ...]:
        """The samples of the clip that ends here, oldest first."""
        return (self,) if self.previous is None else (*self.previous.clip, self)


def true_image(sample: Sample, background: Background) -> Float[Tensor, "3 height width"]:
    """F* in [0, 1] on the background that the model paints; ValueError if it is white and the sample has no alpha."""
    rgb = sample.truth.float() / 255
    if background == "black":
        return rgb
    if sample.alpha is None:
        raise ValueError(
            "expected samples with alpha for a model that paints a white background, got some without; write them "
            "again with `viewmend make-dataset`"
        )
    return composite(background, rgb, sample.alpha.float() / 255)


def black_image(truth: MultiViewFrame) -> UInt8[Tensor, "3 height width"]:
    """F* on black: the image of a frame of one view, times its mask."""
    assert truth.mask is not None, "scenes for training have masks"
    return (truth.rgb[0].float() * (truth.mask[0].float() / 255)).round().to(torch.uint8)


class HeldOutCamera:
    """A rig without one of its cameras; the hull of each frame is computed once."""

    def __init__(self, rig: LeaveOneOut, held: str, hull: HullConfig, protocol: Protocol = "strict") -> None:
        self.rig = rig
        self.held = held
        self.protocol: Protocol = protocol
        self.stream = Stream(Unfilled(), StreamConfig(hull=hull, memory_mb=None), rig.bounds)

    def frame(self, time: int) -> CachedFrame:
        """The other cameras at a frame, with their hull."""
        carving = None
        if self.protocol == "hull-with-target-mask":
            _, carving = reveal(self.protocol, self.rig.truth(self.held, time))
        return self.stream.add_frame(self.rig.inputs(self.held, time), carving=carving)

    def sample(
        self,
        time: int,
        times: Sequence[int],
        render: RenderConfig,
        sampling: SamplingConfig,
        min_hole_px: int = 0,
    ) -> Sample | None:
        """The sample at frame `time` with context of `times`, its own first; None if its holes are too small."""
        now = self.frame(time)
        target = self.rig.calibration(self.held, time).select([self.held])
        # The truth is rendered only if it is needed
        known = None if self.protocol == "strict" else self.rig.truth(self.held, time)
        target_mask, _ = reveal(self.protocol, known)
        view = self.stream.with_render_config(render).render(target, time, target_mask=target_mask)
        if float(view.missing.sum()) < min_hole_px:
            return None
        names = view.closest_views(max(len(view.source_views), sampling.min_context_views))
        context = [self.frame(past).context(names) for past in times]
        ray_views = now.context(view.closest_views(sampling.num_ray_views))
        truth = known or self.rig.truth(self.held, time)
        assert truth.mask is not None, "scenes for training have masks"
        seen = tuple(views for views in context if views is not None)
        return Sample(view, seen, ray_views, black_image(truth), alpha=truth.mask[0])


def rig_samples(
    rig: LeaveOneOut,
    scenes: SceneConfig,
    sampling: SamplingConfig,
    random: Random,
    held_out: str | None = None,
) -> list[Sample]:
    """Hold out some cameras of a rig in turn (or only `held_out`), each at some frames; ValueError if too few."""
    times = sorted(rig.frames)
    ends = [t for t in times if all(t - back in rig.frames for back in range(sampling.clip_length))]
    ends = [t for t in ends if times.index(t) >= sampling.min_history]
    if not ends:
        raise ValueError(
            f"expected clips of {sampling.clip_length} consecutive frames with {sampling.min_history} frames before, "
            f"got the frames {times}; use captures of {max(sampling.frames) + 1} frames or more"
        )
    names = [n for n in rig.frames[times[-1]].cameras.names if held_out in (None, n)]
    samples = []
    for held in random.sample(names, min(scenes.num_holdout_views, len(names))):
        protocol = scenes.protocols[0] if len(scenes.protocols) == 1 else random.choice(scenes.protocols)
        others = HeldOutCamera(rig, held, HullConfig(resolution=scenes.hull_resolution), protocol)
        for end in random.sample(ends, min(sampling.num_target_frames, len(ends))):
            render = RenderConfig(cameras=draw_source_views(sampling, random))
            sample = None
            for time in range(end - sampling.clip_length + 1, end + 1):
                context = tuple(t for t in reversed(times) if t <= time) if sampling.with_context else ()
                new = others.sample(
                    time, context, render, sampling, sampling.min_hole_px if time == end else 0
                )
                sample = new and replace(new, previous=sample)
            if sample is not None:
                samples.append(sample)
    return samples


def draw_source_views(sampling: SamplingConfig, random: Random) -> int:
    """The number of cameras that colour a view."""
    return random.choices(sampling.num_source_views, weights=sampling.source_view_weights)[0]
