"""One scene through many methods: the hull of each frame is computed once, and all methods complete the same views."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch

from viewmend.evaluation.scores import (
    Features,
    PreviousView,
    Scorers,
    TrueView,
    VideoFeatures,
    ViewScores,
    load_scorers,
    score_view,
    true_view,
)
from viewmend.frame_cache import CachedFrame
from viewmend.geometry.bounds import Bounds
from viewmend.metrics.image_quality import SsimWindow
from viewmend.models.base import Inpainter, RenderQuality
from viewmend.models.classical import Unfilled
from viewmend.models.compositing import Background, composite
from viewmend.models.registry import error_model_for, make_method
from viewmend.scenes.held_out import LeaveOneOutScene, Protocol, reveal
from viewmend.stream import Stream, StreamConfig
from viewmend.types import CompletedView, IncompleteView
from viewmend.utils.contact_sheet import Picture, picture
from viewmend.utils.tensors import to_device
from viewmend.view_sequence import ViewSequence


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How scenes are run."""

    device: str = "cpu"
    precision: str = "auto"
    """Precision of our networks: float32, bfloat16, or auto for the one that suits the device."""
    stream: StreamConfig = field(default_factory=lambda: StreamConfig(memory_mb=None))
    """Hull and renderer, the same for every method."""
    ssim: SsimWindow = "gaussian"
    """Window of SSIM."""
    background: Background = "black"
    """Background of views and truth, and of the input of methods that have none of their own."""
    networks: tuple[str, ...] = ()
    """Networks of metrics (`scores.NETWORKS`) to use."""
    protocol: Protocol = "strict"
    """What is known of the mask of the held-out camera."""
    top_k: int | None = None
    """Context tokens that the paper's model keeps when pruning; None for the model's own number."""


@dataclass(frozen=True)
class MethodRun:
    """One method on one scene."""

    method: str
    frames: tuple[ViewScores, ...] = ()
    """Empty if it failed."""
    step_ms: tuple[float, ...] = ()
    """Milliseconds of the inpainter's step, for each frame."""
    error: str | None = None
    """Why it failed."""
    image: Picture | None = None
    """The completed view of the frame with the largest hole."""
    features: Features | None = None
    """Features of the completed videos, for VFID; None without I3D."""


@dataclass(frozen=True)
class SceneRun:
    """All results of one scene; picklable."""

    scene: str
    runs: tuple[MethodRun, ...]
    images: tuple[Picture, Picture, Picture] | None = None
    """Rendered view, E and truth of the frame with the largest hole; None if the scene
    could not be rendered."""
    features: Features | None = None
    """Features of the true videos."""


@dataclass(frozen=True)
class _Frame:
    """One frame of a scene, as all methods get it."""

    cached: CachedFrame
    bounds: Bounds | None
    view: IncompleteView
    truth: TrueView
    scored: bool
    """False for the frames before `scored_from`: they are history only."""
    previous: "_Frame | None"
    largest: bool
    """Whether no earlier hole was as large."""


def evaluate_scene(
    scene: LeaveOneOutScene,
    methods: Sequence[str],
    settings: RunSettings,
    loaded: dict[str, Inpainter] | None = None,
) -> SceneRun:
    """Stream the held-out camera's view through the methods, one frame at a time, using past frames only.

    The result depends on the arguments only, and everything can be pickled: processes and clusters
    call it. An exception becomes the `error` of the method that raised it, or of all methods if the
    scene cannot be read. Methods in `loaded`, which have run in this process, are neither loaded
    nor warmed up again; others are added.
    """
    loaded = {} if loaded is None else loaded
    scorers = load_scorers(settings.background, settings.ssim, settings.networks, settings.device)
    images = None
    videos = VideoFeatures(scorers.i3d)
    streams = [_MethodStream(name, settings, scorers, loaded) for name in methods]
    try:
        with torch.no_grad():
            for frame in _frames(scene, settings):
                if frame.scored:
                    videos.add(frame.truth.rgb, frame.view.holes)
                if frame.largest:
                    rendered = composite(settings.background, frame.view.cut_rgb, frame.view.silhouette)
                    images = picture(rendered), picture(frame.view.error[None]), picture(frame.truth.rgb)
                for stream in streams:
                    stream.add(frame)
        if images is None:
            wanted = "frames with a subject and an image of the held-out camera"
            raise ValueError(f"{scene.name}: expected {wanted}, got none; evaluate more frames")
    except Exception as error:
        return SceneRun(scene.name, tuple(MethodRun(name, error=_message(error)) for name in methods))
    return SceneRun(scene.name, tuple(stream.result() for stream in streams), images, videos.features())


def _frames(scene: LeaveOneOutScene, settings: RunSettings) -> Iterator[_Frame]:
    most = -1
    last = None
    predict_mask = settings.protocol == "predicted-mask"
    render = replace(settings.stream.render, error_rule="holes")
    # One frame at a time; methods keep those that they need
    config = replace(settings.stream, render=render, predict_mask=predict_mask, memory_mb=0.0)
    model = None
    if predict_mask or config.geometry == "fused":
        model = error_model_for(Unfilled(), settings.device, settings.precision)
    stream = Stream(Unfilled(), config, error_model=model)
    for frame in (to_device(own, settings.device) for own in scene.frames()):
        stream.bounds = frame.bounds
        target_mask, own = reveal(settings.protocol, frame.truth)
        carving = own if frame.carving is None else frame.carving.joined(own)
        cached = stream.add_frame(frame.inputs, carving=carving)
        view = stream.render(frame.truth.cameras, target_mask=target_mask)
        if predict_mask:
            view = replace(view, target_mask=stream.predict_mask(view))
        holes = int(view.holes.sum())
        scored = frame.inputs.time >= scene.scored_from
        origins = None if frame.seen is None else frame.seen.origins(view.source_views)
        truth = true_view(frame.truth, settings.background, frame.backward_flow_px, origins)
        last = _Frame(cached, frame.bounds, view, truth, scored, last, scored and holes > most)
        yield last
        most = max(most, holes) if scored else most
        last = replace(last, previous=None)


class _MethodStream:
    """One method's stream through the scene."""

    def __init__(
        self, method: str, settings: RunSettings, scorers: Scorers, loaded: dict[str, Inpainter]
    ) -> None:
        self.method = method
        self._loaded = loaded
        self._settings = settings
        self._scorers = scorers
        self._sequence: ViewSequence | None = None
        self._error: str | None = None
        self._previous: torch.Tensor | None = None
        self._scores: list[ViewScores] = []
        self._step_ms: list[float] = []
        self._videos = VideoFeatures(scorers.i3d)
        self._image: Picture | None = None

    def add(self, frame: _Frame) -> None:
        """Complete and score the view of the next frame; do nothing after an error."""
        if self._error is not None:
            return
        try:
            sequence = self._sequence = self._sequence or self._make(frame.bounds)
            sequence.add_frame(frame.cached)
            if frame.scored:
                self._score(sequence, frame)
            else:
                sequence.skip(frame.view.camera, frame.view.time, frame.view.target_mask)
            if sequence.state is not None:
                sequence.state = sequence.stream.inpainter.reveal_truth(sequence.state, frame.truth.rgb)
        except Exception as error:
            self._error = _message(error)

    def _make(self, bounds: Bounds | None) -> ViewSequence:
        settings = self._settings
        new = self.method not in self._loaded
        if new:
            self._loaded[self.method] = make_method(self.method, settings.device, settings.precision)
        inpainter = self._loaded[self.method]
        predicted = (settings.stream.render.error_rule or inpainter.error_rule) == "predicted"
        error_model = None
        if predicted:
            error_model = error_model_for(inpainter, settings.device, settings.precision)
        # Geometry and mask come with the frames, which all methods share.
        config = replace(settings.stream, geometry="hull", background=settings.background, predict_mask=False)
        quality = RenderQuality(top_k=settings.top_k)
        sequence = ViewSequence(inpainter, config, bounds, quality=quality, error_model=error_model)
        sequence.first_twice = new
        return sequence

    def _score(self, sequence: ViewSequence, frame: _Frame) -> None:
        made = sequence.view(frame.view.camera, frame.view.time, frame.view, frame.view.target_mask)
        completed = made.completed
        previous = None
        _check(completed)
        rgb = composite(self._settings.background, completed.rgb, completed.opacity).clamp(0, 1)
        if frame.previous is not None and self._previous is not None:
            previous = PreviousView(self._previous, frame.previous.truth.rgb)
        self._scores.append(score_view(completed, frame.truth, self._scorers, previous))
        self._step_ms.append(made.times.context + made.times.inpainting)
        self._videos.add(rgb, frame.view.holes)
        self._previous = rgb
        if frame.largest:
            self._image = picture(rgb)

    def result(self) -> MethodRun:
        if self._error is not None:
            return MethodRun(self.method, error=self._error)
        scores = tuple(self._scores)
        step_ms = tuple(self._step_ms)
        return MethodRun(self.method, scores, step_ms, image=self._image, features=self._videos.features())


def _check(completed: CompletedView) -> None:
    """Check that a view is complete, and unchanged outside of E."""
    rgb = completed.rgb
    view = completed.view
    if rgb.shape != view.rgb.shape:
        raise ValueError(
            f"expected an image of {tuple(view.rgb.shape)}, got {tuple(rgb.shape)}; return the whole view"
        )
    changed = int(((rgb != view.cut_rgb).any(0) & (view.error == 0)).sum())
    if changed:
        raise ValueError(
            f"expected pixels with E = 0 as they were rendered, got {changed} changed; blend by E"
        )


def _message(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
