"""One stream of mended views, with what a command shows and scores of it."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.classical import NearestColour, Telea
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.metrics.image_quality import mask_iou
from viewmend.metrics.view_scores import ViewScores, score_view
from viewmend.pipeline import Observation, PipelineConfig, StageMs, StreamState, mend_view, observe
from viewmend.rendering.view import RenderConfig
from viewmend.views import CompletedView, MultiViewFrame


@dataclass(frozen=True)
class MendStep:
    """One mended view and what is known of it."""

    frame: MultiViewFrame
    """The input cameras."""
    completed: CompletedView
    truth: Float[Tensor, "3 height width"] | None
    """What the camera that was left out saw, background black; None without one, or in a gap of it."""
    ours: ViewScores | None
    telea: ViewScores | None
    hull_iou: dict[str, float]
    """The hull's silhouette against the mask, for each camera, the one left out included."""
    stage_ms: StageMs


class Mender:
    """Runs the pipeline over a stream; `held` is used for nothing but scores."""

    def __init__(self, inpainter: ViewInpainter, context: int, bounds: Bounds | None, held: str | None):
        self.inpainter = inpainter
        self.config = PipelineConfig(render=RenderConfig(cameras=context))
        self.bounds = bounds
        self.held = held
        self._state: StreamState | None = None
        self._observation: Observation | None = None

    def mend(self, frame: MultiViewFrame, target: Cameras) -> MendStep:
        """The next view of the stream; the same frame may be looked at many times."""
        inputs = frame if self.held is None else frame.without([self.held])
        bounds = None if self.bounds is None else self.bounds.to(frame.rgb.device)
        state = self._state or StreamState(self.inpainter.initial_state())
        if self._state is None:
            # Once unseen, so that what is compiled at first use is in no time that is shown.
            warm = observe(inputs, bounds, self.config)
            mend_view(warm, target, state, self.inpainter, self.config)
        if self._observation is None or self._observation.frame.time != frame.time:
            self._observation = observe(inputs, bounds, self.config)
        held = () if self.held is None else (self.held,)
        mended = mend_view(self._observation, target, state, self.inpainter, self.config, held)
        self._state = mended.state
        return self._judge(frame, self._observation, mended.completed, mended.stage_ms)

    def _judge(
        self, frame: MultiViewFrame, observation: Observation, completed: CompletedView, stage_ms: StageMs
    ) -> MendStep:
        view, iou = completed.view, _hull_iou(observation)
        if self.held is None or self.held not in frame.cameras.names:
            return MendStep(observation.frame, completed, None, None, None, iou, stage_ms)
        height, width = view.mask.shape
        own = frame.select([self.held])
        assert own.mask is not None, "frames without masks are refused"
        mask = own.mask[0, :height, :width]
        truth = own.rgb[0, :, :height, :width] / 255 * (mask / 255)
        ours = score_view(view, completed.rgb, truth, mask > 127)
        baseline = Telea()
        filled, _ = baseline.step(view, lambda time, names: None, baseline.initial_state())
        telea = score_view(view, filled.rgb, truth, mask > 127)
        if ours.hull_iou is not None:
            iou[self.held] = ours.hull_iou
        return MendStep(observation.frame, completed, truth, ours, telea, iou, stage_ms)


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
    from viewmend.cli.console import say
    from viewmend.inpainting.checkpoint import load_inpainter, shipped_models

    if device != "cpu" and not (device.startswith("cuda") and torch.cuda.is_available()):
        raise ValueError(f"expected a device that is there, got '{device}'; use --device cpu")
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
