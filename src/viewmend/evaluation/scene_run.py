"""One scene through many methods: each frame is carved and rendered once, and all complete the same views."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.backgrounds import Background, laid_upon
from viewmend.baselines.classical import Unfilled
from viewmend.baselines.rgvi import SeesTruth
from viewmend.contact_sheet import picture
from viewmend.evaluation.film import FILM_FRAMES, Box, Picture, film, subject_box
from viewmend.evaluation.frame_scores import Before, FrameScores, TrueView, score_frame, true_view
from viewmend.evaluation.own_stream import all_of, push_again
from viewmend.evaluation.scorers import Features, Scorers, VideoFeatures, load_scorers
from viewmend.inpainting.protocol import State, ViewInpainter, encode_past, own_background, state_after
from viewmend.inpainting.upon_white import UponWhite, fill_upon
from viewmend.leave_one_out.scenes import LeaveOneOutScene
from viewmend.methods import make_method
from viewmend.metrics.image_quality import SsimWindow
from viewmend.observation import Observation
from viewmend.stream import Stream, StreamConfig, StreamView
from viewmend.views import IncompleteView

SLOW_MS = 10_000.0
"""A stream's first step that takes so long is not run again: what is compiled in it is little of that."""


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """How scenes are run."""

    device: str = "cpu"
    precision: str = "float32"
    """What our networks compute with: float32, or bfloat16 by autocast."""
    stream: StreamConfig = field(default_factory=lambda: StreamConfig(memory_mb=None))
    """Hull and renderer, the same for every method."""
    ssim: SsimWindow = "gaussian"
    """Over which windows SSIM is taken."""
    background: Background = "black"
    """What views and truth are laid upon; what fills by what it is shown is shown views upon it."""
    networks: tuple[str, ...] = ()
    """The networks of `scorers.NETWORKS` to compare with."""


@dataclass(frozen=True)
class MethodRun:
    """One method on one scene."""

    method: str
    frames: tuple[FrameScores, ...]
    """Empty if it failed."""
    error: str | None
    """Why it failed."""
    picture: Picture | None = None
    """The completed view at the time of the largest hole."""
    film: Picture | None = None
    """The first frames (`film.film`)."""
    features: Features | None = None
    """Features of the mended videos, for VFID; None without I3D."""


@dataclass(frozen=True)
class SceneRun:
    """All that came out of one scene: what a worker sends back."""

    scene: str
    runs: tuple[MethodRun, ...]
    pictures: tuple[Picture, Picture, Picture] | None = None
    """Rendered view, E, truth at the time of the largest hole; None if the scene could not be read or rendered."""
    film: Picture | None = None
    """The first frames: as rendered, and beside them the truth."""
    features: Features | None = None
    """Features of the true videos."""


@dataclass(frozen=True)
class _Moment:
    """One time of a scene, as all methods are shown it."""

    scored: bool
    """Or only there for who carries something from one view to the next."""

    observation: Observation
    view: IncompleteView
    truth: TrueView
    before: "_Moment | None"
    largest: bool
    """Whether no earlier hole was as large."""


def evaluate_scene(scene: LeaveOneOutScene, methods: Sequence[str], settings: RunSettings) -> SceneRun:
    """Stream the held camera's view through the methods, one frame at a time, past frames only.

    A function of its arguments alone, which can all be pickled: processes and clusters call it. What goes wrong becomes
    the `error` of the method that it went wrong with, or of all if it is the scene's.
    """
    scorers = load_scorers(settings.ssim, settings.networks, settings.device, settings.background)
    shown = _Shown(VideoFeatures(scorers.i3d), settings.background)
    streams = [_Stream(name, settings, scorers) for name in methods]
    try:
        with torch.no_grad():
            every = any(stream.carries for stream in streams)
            for moment in _moments(scene, settings, every):
                if isinstance(moment, _Moment) and moment.scored:
                    shown.add(moment)
                for stream in streams:
                    stream.show(moment)
        if shown.pictures is None:
            raise ValueError(f"{scene.name}: expected frames of the camera that is left out, got none")
    except Exception as error:
        return SceneRun(scene.name, tuple(MethodRun(name, (), _said(error)) for name in methods))
    runs = tuple(stream.run(shown.box) for stream in streams)
    return SceneRun(scene.name, runs, shown.pictures, shown.film(), shown.videos.features())


def _moments(scene: LeaveOneOutScene, settings: RunSettings, every: bool) -> Iterator[_Moment | Observation]:
    """The times of a scene; the observation alone of those that are not scored, unless `every` is wanted."""
    most, last, stream = -1, None, Stream(Unfilled(), settings.stream)
    for frame in scene.frames(settings.device):
        stream.bounds = frame.bounds
        observation = stream.push(frame.inputs)
        scored = frame.inputs.time >= scene.scored_from
        if not scored and not every:
            yield observation
            continue
        view = stream.render(frame.truth.cameras)
        holes = int(view.holes.sum())
        truth = true_view(frame.truth, frame.backward_flow_px, settings.background)
        if frame.seen is not None:
            truth = replace(truth, by_past_alone=frame.seen.by_past_alone(view.source_views))
        last = _Moment(scored, observation, view, truth, last, scored and holes > most)
        yield last
        most, last = max(most, holes) if scored else most, replace(last, before=None)


class _Shown:
    """What is kept of a scene to be shown beside every method's."""

    def __init__(self, videos: VideoFeatures, background: Background) -> None:
        self.videos = videos
        self._background: Background = background
        self.pictures: tuple[Picture, Picture, Picture] | None = None
        self.box: Box | None = None
        self._rendered: list[Picture] = []
        self._truth: list[Picture] = []

    def add(self, moment: _Moment) -> None:
        """One more time."""
        view, truth = moment.view, moment.truth
        rendered = laid_upon(self._background, view.rgb, view.mask)
        self.videos.add(truth.rgb, view.holes)
        if moment.largest:
            self.pictures = picture(rendered), picture(view.error[None]), picture(truth.rgb)
        if len(self._truth) < FILM_FRAMES:
            box = subject_box((view.mask > 0) | truth.mask)
            self.box = box if self.box is None else self.box if box is None else self.box.around(box)
            self._rendered.append(picture(rendered))
            self._truth.append(picture(truth.rgb))

    def film(self) -> Picture | None:
        """The film as rendered, and beside it the truth."""
        strips = [film(frames, self.box) for frames in (self._rendered, self._truth)]
        return None if strips[0] is None or strips[1] is None else np.concatenate([strips[0], strips[1]], 1)


class _Stream:
    """One method's stream through the scene. Only its own work is in its milliseconds, and no first-use compilation."""

    def __init__(self, method: str, settings: RunSettings, scorers: Scorers) -> None:
        self.method = method
        self.settings = settings
        self._scorers = scorers
        self._error: str | None = None
        self._inpainter: ViewInpainter | None = None
        self._stream: Stream | None = None
        self._viewer: State | None = None
        self._past: list[Observation] = []
        self._last: Float[Tensor, "3 height width"] | None = None
        self._scores: list[FrameScores] = []
        self._picture: Picture | None = None
        self._videos = VideoFeatures(scorers.i3d)
        self._frames: list[Picture] = []

    @property
    def carries(self) -> bool:
        """Whether the method carries anything of its own from view to view, and must see every time."""
        try:
            return type(self._made().initial_state()) is not State
        except Exception as error:
            self._error = _said(error)
            return False

    def show(self, moment: _Moment | Observation) -> None:
        """Complete and score the next view, or look at a time; nothing once something went wrong."""
        if self._error is not None:
            return
        try:
            if isinstance(moment, Observation):
                self._past.append(moment)
            elif moment.scored:
                self._step(moment)
            else:
                self._carry(moment)
        except Exception as error:
            self._error = _said(error)

    def _carry(self, moment: _Moment) -> None:
        """What a view that is not scored leaves to the next."""
        self._past.append(moment.observation)
        if not self.carries:
            return
        stream = self._stream = self._stream or Stream(self._made(), self.settings.stream)
        push_again(stream, moment.observation)
        view = self._asked(stream, moment.view)
        state = state_after(stream.inpainter, view, self._viewer or stream.viewer())
        if state is None:
            self._go_on(stream.mend(view, self._viewer), moment)
        else:
            self._viewer = state

    def _go_on(self, mended: StreamView, moment: _Moment) -> None:
        own = self._inpainter.inner if isinstance(self._inpainter, UponWhite) else self._inpainter
        self._viewer = own.shown(mended.viewer, moment.truth.rgb) if isinstance(own, SeesTruth) else mended.viewer

    def _step(self, moment: _Moment) -> None:
        mended = self._mend(moment)
        if not self._scores and mended.times.inpainting < SLOW_MS:
            mended = self._mend(moment)
        view, before = mended.completed.view, None
        _check(mended.completed.rgb, view)
        rgb = laid_upon(self.settings.background, mended.completed.rgb, mended.completed.opacity)
        if moment.before is not None and self._last is not None:
            before = Before(self._last, moment.before.truth.rgb, moment.before.view.holes)
        ms = mended.times.context + mended.times.inpainting
        self._scores.append(score_frame(mended.completed, moment.truth, before, ms, self._scorers))
        self._videos.add(rgb, view.holes)
        if len(self._frames) < FILM_FRAMES:
            self._frames.append(picture(rgb))
        self._last = rgb
        self._go_on(mended, moment)
        if moment.largest:
            self._picture = picture(rgb)

    def _mend(self, moment: _Moment) -> StreamView:
        """The view, by a stream of the method's own, so that it pays for what it asks for beyond the rendering.

        What it encodes of the past it would have encoded then: that is done before, and not in its milliseconds.
        """
        if self._stream is None or not self._scores:
            self._stream = Stream(self._made(), self.settings.stream)
            for observation in self._past:
                push_again(self._stream, observation)
        stream = self._stream
        push_again(stream, moment.observation)
        view = self._asked(stream, moment.view)
        encode_past(stream.inpainter, view, all_of(stream))
        return stream.mend(view, self._viewer)

    def _made(self) -> ViewInpainter:
        if self._inpainter is None:
            self._inpainter = make_method(self.method, self.settings.device, self.settings.precision)
            if own_background(self._inpainter) is None:
                self._inpainter = fill_upon(self._inpainter, self.settings.background)
        return self._inpainter

    def _asked(self, stream: Stream, view: IncompleteView) -> IncompleteView:
        """The view by the stream's error rule."""
        if stream.error_rule == (self.settings.stream.render.error_rule or "unseen"):
            return view
        return stream.render(view.camera, view.time)

    def run(self, box: Box | None) -> MethodRun:
        """What came out; `box` is what its film shows."""
        if self._error is not None:
            return MethodRun(self.method, (), self._error)
        strip, features = film(self._frames, box), self._videos.features()
        return MethodRun(self.method, tuple(self._scores), None, self._picture, strip, features)


def _check(rgb: Tensor, view: IncompleteView) -> None:
    """What every method owes: an image of the view's size, untouched outside E."""
    if rgb.shape != view.rgb.shape:
        raise ValueError(f"expected an image of {tuple(view.rgb.shape)}, got {tuple(rgb.shape)}; complete it in full")
    touched = int(((rgb != view.rgb).any(0) & (view.error == 0)).sum())
    if touched:
        raise ValueError(f"expected pixels with E = 0 as they were rendered, got {touched} changed; blend by E")


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
