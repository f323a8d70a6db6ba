"""One stream of mended views, judged where the truth is known, and the scores of a whole run."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from statistics import mean, median
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background, laid_upon
from viewmend.baselines.classical import Telea
from viewmend.evaluation.frame_scores import mean_similarity
from viewmend.geometry.alignment import silhouette_iou
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State, ViewInpainter, shown_upon
from viewmend.inpainting.upon_white import fill_upon
from viewmend.metrics.image_quality import mask_iou
from viewmend.metrics.view_scores import ViewScores, mean_over_frames, score_view
from viewmend.observation import Observation
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.timing import StageTimes
from viewmend.views import CompletedView, MultiViewFrame

Fill = Literal["unfilled", "telea", "unseen", "ours"]
Metric = Literal["psnr_whole", "psnr_subject", "psnr_valid", "psnr_holes", "psnr_holes_fg"]


@dataclass(frozen=True)
class Scores:
    """The same view filled in several ways, against the truth."""

    unfilled: ViewScores
    telea: ViewScores
    unseen: ViewScores
    """Only the holes are mended, by the method that mends `ours`; the same where the error rule asks for no more."""
    ours: ViewScores
    ssim_whole: float | None
    """SSIM of `ours`."""
    alpha_iou: float | None
    """Overlap of alpha above one half, or of M where the method tells no alpha, with the true mask."""


@dataclass(frozen=True)
class MendStep:
    """One mended view and what is known of it."""

    frame: MultiViewFrame
    """The input cameras."""
    completed: CompletedView
    background: Background
    """What the inpainter paints upon, and its views are shown and scored upon."""
    truth: Float[Tensor, "3 height width"] | None
    """What the view should look like, upon the background; None where nobody knows."""
    scores: Scores | None
    """None without truth."""
    hull_iou: dict[str, float]
    """The hull's silhouette against the mask, for each input camera and the truth."""
    times: StageTimes

    @property
    def mended(self) -> Float[Tensor, "3 height width"]:
        """Fhat upon the background."""
        return laid_upon(self.background, self.completed.rgb, self.completed.opacity)

    @property
    def rendered(self) -> Float[Tensor, "3 height width"]:
        """F upon the background; holes are black."""
        return laid_upon(self.background, self.completed.view.rgb, self.completed.view.mask)


class Mender:
    """Runs one viewer's stream over frames, and judges what comes out."""

    def __init__(
        self,
        inpainter: ViewInpainter,
        render: RenderConfig | None = None,
        bounds: Bounds | None = None,
        exclude: Sequence[str] = (),
        quality: RenderQuality | None = None,
    ):
        self._config = StreamConfig(render=render or RenderConfig(), memory_mb=None)
        self._stream = Stream(inpainter, self._config, bounds)
        self._background: Background = shown_upon(inpainter)
        self._exclude = exclude
        self._quality = quality
        self._viewer: State | None = None
        self._viewer_of_holes: State | None = None

    def mend(self, frame: MultiViewFrame, target: Cameras, truth: MultiViewFrame | None) -> MendStep:
        """The next view of the stream; the same frame may be looked at many times.

        Args:
            frame: the input cameras.
            target: the novel view's camera.
            truth: what a camera there saw (one view), used for scores alone.

        Raises:
            ValueError: the inpainter gives colours that are not finite.
        """
        if self._viewer is None:
            # Once unseen, so that what is compiled at first use is in no time that is shown.
            warm = Stream(self._stream.inpainter, replace(self._config, fit_rig=False), self._stream.bounds)
            warm.push(frame)
            warm.view(target, quality=self._quality, exclude=self._exclude)
        observation = self._stream.push(frame)
        mended = self._stream.view(target, self._viewer, frame.time, self._quality, self._exclude)
        self._viewer = mended.viewer
        iou = _hull_iou(observation)
        if truth is None:
            return MendStep(frame, mended.completed, self._background, None, None, iou, mended.times)
        image, scores = _judge(mended.completed, self._holes_mended(mended.completed), truth, self._background)
        if scores.ours.hull_iou is not None:
            iou[truth.cameras.names[0]] = scores.ours.hull_iou
        return MendStep(frame, mended.completed, self._background, image, scores, iou, mended.times)

    def _holes_mended(self, completed: CompletedView) -> CompletedView:
        """The same view with nothing but its holes mended, as a stream of its own."""
        if self._stream.error_rule == "unseen":
            return completed
        view = replace(completed.view, error=completed.view.holes.to(completed.rgb))
        mended = self._stream.mend(view, self._viewer_of_holes, self._quality, self._exclude)
        self._viewer_of_holes = mended.viewer
        return mended.completed


def _judge(
    completed: CompletedView, holes_mended: CompletedView, truth: MultiViewFrame, background: Background
) -> tuple[Float[Tensor, "3 height width"], Scores]:
    """The true image upon this background, and the scores against it."""
    view = completed.view
    height, width = view.mask.shape
    assert truth.mask is not None, "frames without masks are refused"
    mask = truth.mask[0, :height, :width]
    image, subject = truth.rgb[0, :, :height, :width] / 255 * (mask / 255), mask > FOREGROUND
    image = laid_upon(background, image, mask / 255)
    baseline = fill_upon(Telea(), background)
    filled, _ = baseline.step(
        replace(view, error=view.holes.to(view.rgb)), ContextProvider(lambda *_: None), baseline.initial_state()
    )
    fills = [laid_upon(background, view.rgb, view.mask)]
    fills += [laid_upon(background, made.rgb, made.opacity) for made in (filled, holes_mended, completed)]
    unfilled, telea, unseen, ours = (score_view(view, rgb, image, subject) for rgb in fills)
    ssim = mean_similarity(fills[-1], image)
    return image, Scores(unfilled, telea, unseen, ours, ssim, mask_iou(completed.opacity > 0.5, subject))


def _hull_iou(observation: Observation) -> dict[str, float]:
    frame = observation.frame
    assert frame.mask is not None, "frames without masks are refused"
    iou = silhouette_iou(observation.depth(frame.cameras.names) > 0, frame.mask).tolist()
    return {name: score for name, score in zip(frame.cameras.names, iou, strict=True) if not math.isnan(score)}


class MendSummary:
    """Gathers the steps of a run, without their images."""

    def __init__(self) -> None:
        self.frames = 0
        self.background: Background = "black"
        """What was scored upon."""
        self.hull_iou: dict[str, list[float]] = {}
        """The IoU of each camera, frame by frame."""
        self._hull_px = self._holes_px = self._mended_px = 0
        self._scores: list[Scores] = []
        self._times: list[StageTimes] = []

    def add(self, step: MendStep) -> None:
        """Count one more view."""
        view = step.completed.view
        self.frames, self.background = self.frames + 1, step.background
        self._hull_px += int((view.mask > 0.5).sum())
        self._holes_px += int(view.holes.sum())
        self._mended_px += int(((view.mask > 0.5) & view.read).sum())
        if step.scores is not None:
            self._scores.append(step.scores)
        for name, iou in step.hull_iou.items():
            self.hull_iou.setdefault(name, []).append(iou)
        self._times.append(step.times)

    @property
    def hole_fraction(self) -> float | None:
        """The holes' share of the hull's pixels; None without a hull."""
        return self._holes_px / self._hull_px if self._hull_px else None

    @property
    def mended_fraction(self) -> float | None:
        """The share of the hull's pixels with E > 0; None without a hull."""
        return self._mended_px / self._hull_px if self._hull_px else None

    def as_json(self) -> dict[str, object]:
        """The scores; null where there are no such pixels, or no truth. Times are medians, milliseconds."""
        return {
            "frames": self.frames,
            "background": self.background,
            "hole_fraction": self.hole_fraction,
            "mended_fraction": self.mended_fraction,
            "psnr_whole": self.mean("ours", "psnr_whole"),
            "psnr_whole_rendered": self.mean("unfilled", "psnr_whole"),
            "psnr_whole_unseen": self.mean("unseen", "psnr_whole"),
            "ssim_whole": mean_over_frames([s.ssim_whole for s in self._scores]),
            "psnr_subject": self.mean("ours", "psnr_subject"),
            "alpha_iou": mean_over_frames([s.alpha_iou for s in self._scores]),
            "psnr_valid": self.mean("ours", "psnr_valid"),
            "psnr_holes": self.mean("ours", "psnr_holes"),
            "psnr_holes_telea": self.mean("telea", "psnr_holes"),
            "psnr_holes_fg": self.mean("ours", "psnr_holes_fg"),
            "psnr_holes_fg_telea": self.mean("telea", "psnr_holes_fg"),
            "hull_iou": {name: mean(values) for name, values in self.hull_iou.items()},
            "stage_ms": self.stage_ms(),
        }

    def mean(self, fill: Fill, metric: Metric) -> float | None:
        """Mean over frames of one metric of one way to fill the holes; None where there are no such pixels."""
        scores: list[ViewScores] = [getattr(s, fill) for s in self._scores]
        pixels = {"psnr_holes": [s.holes_px for s in scores], "psnr_holes_fg": [s.holes_fg_px for s in scores]}
        return mean_over_frames([getattr(s, metric) for s in scores], pixels.get(metric))

    def stage_ms(self) -> dict[str, float]:
        """Median milliseconds of each stage."""
        times = [asdict(stages) for stages in self._times]
        return {stage: median(t[stage] for t in times) for stage in times[0]} if times else {}
