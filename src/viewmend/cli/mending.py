"""One stream of mended views, with what a command shows and scores of it."""

from collections.abc import Sequence
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from viewmend.baselines.classical import Telea
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.inpainting.protocol import ContextProvider, RenderQuality, State, ViewInpainter
from viewmend.metrics.image_quality import mask_iou
from viewmend.metrics.view_scores import ViewScores, score_view
from viewmend.observation import Observation
from viewmend.rendering.view import RenderConfig
from viewmend.stream import Stream, StreamConfig
from viewmend.timing import StageTimes
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
    times: StageTimes


class Mender:
    """Runs one viewer's stream over frames, and judges what comes out."""

    def __init__(
        self,
        inpainter: ViewInpainter,
        context: int = 3,
        bounds: Bounds | None = None,
        exclude: Sequence[str] = (),
        quality: RenderQuality | None = None,
    ):
        self._config = StreamConfig(render=RenderConfig(cameras=context), memory_mb=None)
        self._stream = Stream(inpainter, self._config, bounds)
        self._exclude = exclude
        self._quality = quality
        self._viewer: State | None = None

    def mend(self, frame: MultiViewFrame, target: Cameras, truth: MultiViewFrame | None) -> MendStep:
        """The next view of the stream; the same frame may be looked at many times.

        Args:
            frame: the input cameras.
            target: the novel view's camera.
            truth: what a camera there saw (one view), used for scores alone.
        """
        if self._viewer is None:
            # Once unseen, so that what is compiled at first use is in no time that is shown.
            warm = Stream(self._stream.inpainter, self._config, self._stream.bounds)
            warm.push(frame)
            warm.view(target, quality=self._quality, exclude=self._exclude)
        observation = self._stream.push(frame)
        mended = self._stream.view(target, self._viewer, frame.time, self._quality, self._exclude)
        self._viewer = mended.viewer
        iou = _hull_iou(observation)
        if truth is None:
            return MendStep(frame, mended.completed, None, None, iou, mended.times)
        image, scores = _judge(mended.completed, truth)
        if scores.ours.hull_iou is not None:
            iou[truth.cameras.names[0]] = scores.ours.hull_iou
        return MendStep(frame, mended.completed, image, scores, iou, mended.times)


def _judge(completed: CompletedView, truth: MultiViewFrame) -> tuple[Float[Tensor, "3 height width"], Scores]:
    """The true image on black, and the scores against it."""
    view = completed.view
    height, width = view.mask.shape
    assert truth.mask is not None, "frames without masks are refused"
    mask = truth.mask[0, :height, :width]
    image = truth.rgb[0, :, :height, :width] / 255 * (mask / 255)
    baseline = Telea()
    filled, _ = baseline.step(view, ContextProvider(lambda *_: None), baseline.initial_state())
    unfilled, telea, ours = (score_view(view, rgb, image, mask > 127) for rgb in (view.rgb, filled.rgb, completed.rgb))
    return image, Scores(unfilled, telea, ours)


def _hull_iou(observation: Observation) -> dict[str, float]:
    frame = observation.frame
    assert frame.mask is not None, "frames without masks are refused"
    depth = observation.depth(frame.cameras.names)
    scores = [mask_iou(depth[view] > 0, frame.mask[view] > 127) for view in range(len(frame.cameras))]
    return {name: score for name, score in zip(frame.cameras.names, scores, strict=True) if score is not None}


def load_named(name: str | None, device: str) -> ViewInpainter:
    """The method of this name (`methods.make_method`); without a name the model that is shipped, else Telea.

    Raises:
        ValueError: there is none, it is damaged, or the device is not there.
    """
    from viewmend.cli.checks import check_device
    from viewmend.cli.console import say
    from viewmend.methods import default_method, make_method

    check_device(device)
    if name is None and (name := default_method()) == "telea":
        say("no model is shipped with this version: the holes are filled by OpenCV's Telea")
    return make_method(name, device)
