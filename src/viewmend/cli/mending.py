"""One stream of mended views, with what a command shows and scores of it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from jaxtyping import Float
from torch import Tensor

from viewmend.baselines.classical import NearestColour, Telea
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.metrics.image_quality import mask_iou
from viewmend.metrics.view_scores import ViewScores, score_view
from viewmend.pipeline import Observation, PipelineConfig, StageMs, StreamState, mend_view, observe
from viewmend.rendering.view import RenderConfig
from viewmend.views import CompletedView, MultiViewFrame


@dataclass(frozen=True)
class Scores:
    """The same view filled in three ways, against the truth."""

    unfilled: ViewScores
    telea: ViewScores
    ours: ViewScores


@dataclass(frozen=True)
class MendStep:
    """One mended view and what is known of it."""

    frame: MultiViewFrame
    """The input cameras."""
    completed: CompletedView
    truth: Float[Tensor, "3 height width"] | None
    """What the view should look like, background black; None where nobody knows."""
    scores: Scores | None
    """None without truth."""
    hull_iou: dict[str, float]
    """The hull's silhouette against the mask, for each input camera and the truth."""
    stage_ms: StageMs


class Mender:
    """Runs the pipeline over a stream of frames, and judges what comes out."""

    def __init__(self, inpainter: ViewInpainter, context: int, bounds: Bounds | None, exclude: Sequence[str] = ()):
        self.inpainter = inpainter
        self.config = PipelineConfig(render=RenderConfig(cameras=context))
        self.bounds = bounds
        self.exclude = exclude
        self._state: StreamState | None = None
        self._observation: Observation | None = None

    def mend(self, frame: MultiViewFrame, target: Cameras, truth: MultiViewFrame | None) -> MendStep:
        """The next view of the stream; the same frame may be looked at many times.

        Args:
            frame: the input cameras.
            target: the novel view's camera.
            truth: what a camera there saw (one view), used for scores alone.
        """
        bounds = None if self.bounds is None else self.bounds.to(frame.rgb.device)
        state = self._state or StreamState(self.inpainter.initial_state())
        if self._state is None:
            # Once unseen, so that what is compiled at first use is in no time that is shown.
            warm = observe(frame, bounds, self.config)
            mend_view(warm, target, state, self.inpainter, self.config, self.exclude)
        if self._observation is None or self._observation.frame.time != frame.time:
            self._observation = observe(frame, bounds, self.config)
        mended = mend_view(self._observation, target, state, self.inpainter, self.config, self.exclude)
        self._state = mended.state
        iou = _hull_iou(self._observation)
        if truth is None:
            return MendStep(frame, mended.completed, None, None, iou, mended.stage_ms)
        image, scores = _judge(mended.completed, truth)
        if scores.ours.hull_iou is not None:
            iou[truth.cameras.names[0]] = scores.ours.hull_iou
        return MendStep(frame, mended.completed, image, scores, iou, mended.stage_ms)


def _judge(completed: CompletedView, truth: MultiViewFrame) -> tuple[Float[Tensor, "3 height width"], Scores]:
    """The true image on black, and the scores against it."""
    view = completed.view
    height, width = view.mask.shape
    assert truth.mask is not None, "frames without masks are refused"
    mask = truth.mask[0, :height, :width]
    image = truth.rgb[0, :, :height, :width] / 255 * (mask / 255)
    baseline = Telea()
    filled, _ = baseline.step(view, lambda time, names: None, baseline.initial_state())
    unfilled, telea, ours = (score_view(view, rgb, image, mask > 127) for rgb in (view.rgb, filled.rgb, completed.rgb))
    return image, Scores(unfilled, telea, ours)


def _hull_iou(observation: Observation) -> dict[str, float]:
    frame = observation.frame
    assert frame.mask is not None, "frames without masks are refused"
    depth = observation.depth(frame.cameras.names)
    scores = [mask_iou(depth[view] > 0, frame.mask[view] > 127) for view in range(len(frame.cameras))]
    return {name: score for name, score in zip(frame.cameras.names, scores, strict=True) if score is not None}


def load_named(name: str | None, top_k: int | None, device: str) -> ViewInpainter:
    """The inpainter of this name or folder; without a name the model that is shipped, else Telea.

    Raises:
        ValueError: there is none, it is damaged, or the device is not there.
    """
    from viewmend.cli.checks import check_device
    from viewmend.cli.console import say
    from viewmend.inpainting.checkpoint import load_inpainter, shipped_models

    check_device(device)
    if name is None:
        shipped = shipped_models()
        if not shipped:
            say("no model is shipped with this version: the holes are filled by OpenCV's Telea")
            return Telea()
        name = "small" if "small" in shipped else shipped[0]
    if name in ("telea", "nearest"):
        return Telea() if name == "telea" else NearestColour()
    inpainter = load_inpainter(name, device)
    if top_k is not None:
        if top_k < 1:
            raise ValueError(f"expected --top-k of at least 1 token, got {top_k}; leave it away to keep all")
        inpainter.config = replace(inpainter.config, top_k=top_k)
    return inpainter
