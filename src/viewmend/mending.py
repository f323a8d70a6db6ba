"""The pipeline of `mend` and `demo`: each view is completed and scored against the truth; the summary of a run."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from statistics import mean, median
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from viewmend.evaluation.scores import (
    Scorers,
    ViewScores,
    load_scorers,
    mean_over_frames,
    score_view,
    true_view,
)
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.alignment import silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.models.base import ContextProvider, Inpainter, RenderQuality, State
from viewmend.models.classical import Telea
from viewmend.models.compositing import Background, composite
from viewmend.scenes.held_out import Protocol, reveal
from viewmend.stream import StreamConfig
from viewmend.types import CompletedView, MultiViewFrame
from viewmend.utils.timing import StageTimes
from viewmend.view_sequence import ViewSequence

Fill = Literal["unfilled", "telea", "ours"]


@dataclass(frozen=True)
class FillScores:
    """Scores of the same view, filled in several ways."""

    unfilled: ViewScores
    telea: ViewScores
    ours: ViewScores


@dataclass(frozen=True)
class MendStep:
    """One completed view, with its input and scores."""

    frame: MultiViewFrame
    """The input cameras."""
    completed: CompletedView
    background: Background
    truth: Float[Tensor, "3 height width"] | None
    """The target image on the background; None if there is none."""
    scores: FillScores | None
    """None without truth, or without a subject."""
    hull_iou: dict[str, float]
    """IoU of the hull's silhouette and the mask, for each input camera and the truth."""
    times: StageTimes

    @property
    def completed_rgb(self) -> Float[Tensor, "3 height width"]:
        """The completed view on the background."""
        return composite(self.background, self.completed.rgb, self.completed.opacity)

    @property
    def rendered(self) -> Float[Tensor, "3 height width"]:
        """The rendered view on the background; holes are black."""
        return composite(self.background, self.completed.view.cut_rgb, self.completed.view.silhouette)


def default_protocol(inpainter: Inpainter) -> Protocol:
    """The protocol of models that need the view's mask is 'predicted-mask', that of all others 'strict'."""
    return "predicted-mask" if inpainter.needs_mask else "strict"


class Mender(ViewSequence):
    """Completes the views of one viewer, frame by frame, and scores them."""

    def __init__(
        self,
        inpainter: Inpainter,
        config: StreamConfig | None = None,
        bounds: Bounds | None = None,
        exclude: Sequence[str] = (),
        quality: RenderQuality | None = None,
        error_model: Inpainter | None = None,
        protocol: Protocol = "strict",
    ) -> None:
        """Create a viewer of an empty stream, as `ViewSequence` does.

        `protocol` says what `mend` may know of the mask of the held-out camera; with
        'predicted-mask', `error_model` predicts it.
        """
        config = replace(config or StreamConfig(memory_mb=None), predict_mask=protocol == "predicted-mask")
        super().__init__(inpainter, config, bounds, exclude, quality, error_model)
        self._protocol: Protocol = protocol
        self._scorers: Scorers | None = None

    def mend(self, frame: MultiViewFrame, target: Cameras, truth: MultiViewFrame | None) -> MendStep:
        """Complete and score the next view; several views of the same frame may follow each other.

        `truth`, one view at the target's pose, is what the result is scored against; unless the
        protocol is `strict`, its mask is used, too. There are no scores where neither the frame nor
        the truth has a subject.

        Raises:
            ValueError: the inpainter does not return a completed view (`Inpainter.step_on`).
        """
        target_mask, carving = reveal(self._protocol, truth)
        cached = self.add_frame(frame, carving)
        made = self.view(target, frame.time, target_mask=target_mask)
        iou = _input_iou(cached)
        if truth is None:
            return MendStep(frame, made.completed, self.background, None, None, iou, made.times)
        true = true_view(truth, self.background)
        if not (frame.has_subject or truth.has_subject):
            return MendStep(frame, made.completed, self.background, true.rgb, None, iou, made.times)
        psnr_only = Scorers(self.background, ssim=None)
        if self._scorers is None:
            self._scorers = load_scorers(self.background, "gaussian", ("lpips-alex",), str(true.rgb.device))
        view = made.completed.view
        holes = replace(view, error=view.holes.to(view.rgb))
        telea, _ = Telea().step_on(self.background, holes, ContextProvider(lambda *_: None), State())
        scores = FillScores(
            score_view(CompletedView(view, view.cut_rgb), true, replace(self._scorers, ssim=None)),
            score_view(telea, true, psnr_only),
            score_view(made.completed, true, self._scorers),
        )
        if scores.ours.hull_iou is not None:
            iou[truth.cameras.names[0]] = scores.ours.hull_iou
        return MendStep(frame, made.completed, self.background, true.rgb, scores, iou, made.times)


class MendSummary:
    """Collects scores and times of a run, without images."""

    def __init__(self, protocol: Protocol = "strict") -> None:
        self.protocol = protocol
        self.frames = 0
        self.background: Background = "black"
        self.hull_iou: dict[str, list[float]] = {}
        """IoU of each camera, frame by frame."""
        self.empty: set[int] = set()
        """Indices of the frames without a subject in the input cameras."""
        self._hull_px = self._hole_px = self._completed_px = 0
        self._scores: list[FillScores] = []
        self._times: list[StageTimes] = []

    def add(self, step: MendStep) -> None:
        """Add one view."""
        view = step.completed.view
        self.frames = self.frames + 1
        self.background = step.background
        self._hull_px += int((view.mask > 0.5).sum())
        self._hole_px += int(view.holes.sum())
        self._completed_px += int(((view.mask > 0.5) & view.refine_mask).sum())
        if not step.frame.has_subject:
            self.empty.add(step.frame.time)
        if step.scores is not None:
            self._scores.append(step.scores)
        for name, iou in step.hull_iou.items():
            self.hull_iou.setdefault(name, []).append(iou)
        self._times.append(step.times)

    @property
    def scored_frames(self) -> int:
        """Number of views that the scores are means of: those with a truth and a subject."""
        return len(self._scores)

    @property
    def hole_fraction(self) -> float | None:
        """Fraction of the hull's pixels that are holes; None without a hull."""
        return self._hole_px / self._hull_px if self._hull_px else None

    @property
    def completed_fraction(self) -> float | None:
        """Fraction of the hull's pixels that are inpainted; None without a hull."""
        return self._completed_px / self._hull_px if self._hull_px else None

    def as_json(self) -> dict[str, object]:
        """The scores of `mend --json`; None where there are no such pixels, or no truth. Times are medians in ms."""
        whole = ("frames", "scored_frames", "protocol", "background", "hole_fraction", "completed_fraction")
        return {
            **{name: getattr(self, name) for name in whole},
            "psnr_whole": self.mean("ours", "psnr_whole"),
            "psnr_whole_rendered": self.mean("unfilled", "psnr_whole"),
            "ssim_whole": self.mean("ours", "ssim_whole"),
            "lpips_whole": self.mean("ours", "lpips_alex_whole"),
            "lpips_whole_rendered": self.mean("unfilled", "lpips_alex_whole"),
            "lpips_subject": self.mean("ours", "lpips_alex_subject"),
            **{name: self.mean("ours", name) for name in ("psnr_subject", "alpha_iou", "psnr_valid")},
            "psnr_holes": self.mean("ours", "psnr_holes"),
            "psnr_holes_telea": self.mean("telea", "psnr_holes"),
            "psnr_holes_fg": self.mean("ours", "psnr_holes_fg"),
            "psnr_holes_fg_telea": self.mean("telea", "psnr_holes_fg"),
            "hull_iou": {name: mean(values) for name, values in self.hull_iou.items()},
            "stage_ms": self.stage_ms(),
        }

    def mean(self, fill: Fill, metric: str) -> float | None:
        """Mean over frames of a field of `ViewScores`, for one way to fill the holes; None without any value."""
        scores: list[ViewScores] = [getattr(s, fill) for s in self._scores]
        pixels = {"psnr_holes": [s.hole_px for s in scores], "psnr_holes_fg": [s.hole_fg_px for s in scores]}
        return mean_over_frames([getattr(s, metric) for s in scores], pixels.get(metric))

    def stage_ms(self) -> dict[str, float]:
        """Median milliseconds of each stage where it ran: views of one frame share its geometry."""
        times = [asdict(stages) for stages in self._times]
        stages = times[0] if times else ()
        return {stage: median([t[stage] for t in times if t[stage]] or [0.0]) for stage in stages}


def _input_iou(cached: CachedFrame) -> dict[str, float]:
    frame = cached.frame
    assert frame.mask is not None, "frames without masks are refused"
    iou = silhouette_iou(cached.depth(frame.cameras.names) > 0, frame.mask).tolist()
    return {
        name: score for name, score in zip(frame.cameras.names, iou, strict=True) if not math.isnan(score)
    }
