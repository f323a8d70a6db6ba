"""Published video inpainters as inpainters of live views: one frame at a time, only the past, any resolution."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.contrib.baselines.framing import (
    DILATION_PX,
    Canvas,
    Window,
    aim,
    camera_windows,
    foreground,
    resized,
    resized_canvas,
    stitch,
    window_canvas,
    windows_over,
)
from viewmend.models.base import ContextProvider, Inpainter, State
from viewmend.models.compositing import blend
from viewmend.types import CompletedView, ContextViews, IncompleteView

Frames = Float[Tensor, "_frame 3 height width"]
"""Frames of one time in [-1, 1], 0 in the holes: the view, then (variant mul) the source cameras' images."""


@dataclass(frozen=True)
class Clip:
    """One window of a stream at all times that are input together."""

    now: Frames
    neighbours: tuple[Frames, ...] = ()
    """The times just before, latest first."""
    references: tuple[Frames, ...] = ()
    """Times further back, latest first."""


@runtime_checkable
class OnlineNetwork(Protocol):
    """A published network that completes the latest frame of a stream."""

    def check_size(self, height: int, width: int) -> None:
        """ValueError for frames of a size that this network does not support."""
        ...

    def complete_clip(self, clip: Clip) -> Float[Tensor, "3 height width"]:
        """The first frame of `clip.now`, filled, in [-1, 1], by a run of the unchanged network on all frames."""
        ...


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Which past times a network uses."""

    neighbours: int = 3
    """The times just before the view's."""
    references: int = 3
    """Times further back, `step` apart."""
    step: int = 10
    """Frames between references."""
    grid: Literal["absolute", "relative"] = "absolute"
    """References are the latest multiples of `step` (as Thiry et al. do), or `step`, 2 `step`, ...
    frames back (as the paper on multi-view inpainting writes)."""

    def neighbour_times(self, time: int) -> tuple[int, ...]:
        """The times just before `time`, latest first, none before 0."""
        return tuple(range(time - 1, max(time - self.neighbours, 0) - 1, -1))

    def reference_times(self, time: int) -> tuple[int, ...]:
        """The times further back, latest first, none before 0 and none of the neighbours."""
        if self.grid == "relative":
            times = [time - self.step * j for j in range(1, self.references + 1)]
            return tuple(t for t in times if 0 <= t < time - self.neighbours)
        latest = (time - self.neighbours - 1) // self.step
        return tuple(self.step * j for j in range(latest, latest - self.references, -1) if j >= 0)

    def times(self, time: int) -> tuple[int, ...]:
        """All past times that a view at `time` uses, latest first."""
        return self.neighbour_times(time) + self.reference_times(time)

    def is_wanted_after(self, past: int, time: int) -> bool:
        """Whether a view later than `time` may use the time `past`."""
        if self.grid == "relative":
            return time - past < max(self.neighbours, self.step * self.references)
        # The multiples only advance: a time that the next view does not use, no later one does.
        return past in self.times(time + 1)


@dataclass(frozen=True, kw_only=True)
class OnlineConfig:
    """How a published network is run on a stream."""

    framing: Literal["def", "win", "mul"] = "def"
    """The whole view resized to the network's size; overlapping windows in the view's own
    resolution; or windows, and the source cameras of the view next to it in each frame."""
    sampling: Sampling = field(default_factory=Sampling)
    """Which past times are input."""
    size_px: tuple[int, int] = (240, 432)
    """Height and width that the network is run at."""

    @property
    def overlap_px(self) -> int:
        """Minimum overlap of neighbouring windows, in which they are blended: 48 at the authors' size."""
        return min(self.size_px) // 5


@dataclass(frozen=True)
class OnlineState(State):
    """Past frames of a stream that the sampling may still use."""

    frames: Mapping[int, Float[Tensor, "3 height width"]] = field(default_factory=dict)
    """Past canvases by time."""
    canvas_px: tuple[int, int] = (0, 0)
    """Height and width of the canvas that all this belongs to."""


class OnlineInpainter(Inpainter):
    """A published network behind the protocol of all inpainters.

    Only windows with holes are run. Only pixels with E > 0 change.

    Raises:
        ValueError: the network cannot take frames of `config.size_px`.
    """

    def __init__(self, network: OnlineNetwork, config: OnlineConfig | None = None) -> None:
        self.network = network
        self.config = config or OnlineConfig()
        network.check_size(*self.config.size_px)

    def initial_state(self) -> OnlineState:
        """A stream without a past."""
        return OnlineState()

    @torch.inference_mode()
    def step(
        self, view: IncompleteView, context: ContextProvider, state: State
    ) -> tuple[CompletedView, OnlineState]:
        """The completed view; only the variant mul uses `context`."""
        canvas = self._canvas(view)
        state = self._past(state, view.time, canvas)
        completed = view.rgb
        windows = self._windows_with_holes(view, canvas)
        if windows:
            frames = {view.time: canvas.image, **state.frames}
            cameras = cache(partial(self._cameras, view, context))  # fetched once for all windows
            pieces = [
                self.network.complete_clip(self._clip(window, view, frames, cameras)) for window in windows
            ]
            filled = (stitch(pieces, windows, state.canvas_px, self.config.overlap_px).float() + 1) / 2
            height, width = view.error.shape
            is_whole = self.config.framing == "def"
            filled = resized(filled.clamp(0, 1), (height, width)) if is_whole else filled[:, :height, :width]
            completed = blend(view.rgb, view.error, filled, torch.ones_like(view.error))
        return CompletedView(view, completed), self._kept(state, view.time, canvas)

    def advance_state(self, view: IncompleteView, state: State) -> OnlineState:
        """The state after a frame that is not scored."""
        canvas = self._canvas(view)
        return self._kept(self._past(state, view.time, canvas), view.time, canvas)

    def _kept(self, state: OnlineState, time: int, canvas: Canvas) -> OnlineState:
        """The parts of the past and of this time that later views may use."""
        frames = {time: canvas.image, **state.frames}
        wanted = self.config.sampling.is_wanted_after
        return replace(state, frames={past: frame for past, frame in frames.items() if wanted(past, time)})

    def _canvas(self, view: IncompleteView) -> Canvas:
        make = resized_canvas if self.config.framing == "def" else window_canvas
        return make(view.rgb, view.error > 0, self.config.size_px, DILATION_PX)

    def _past(self, state: State, time: int, canvas: Canvas) -> OnlineState:
        """The part of the state that is past and of the canvas's size."""
        height, width = canvas.image.shape[1:]
        if not isinstance(state, OnlineState) or state.canvas_px != (height, width):
            return OnlineState(canvas_px=(height, width))
        return replace(state, frames={t: frame for t, frame in state.frames.items() if t < time})

    def _windows_with_holes(self, view: IncompleteView, canvas: Canvas) -> list[Window]:
        # A hole may be too thin for the small canvas, but the view still has it
        if self.config.framing == "def":
            return [Window(0, 0)] if bool((view.error > 0).any()) else []
        return list(windows_over(canvas.holes, self.config.size_px, self.config.overlap_px))

    def _cameras(
        self, view: IncompleteView, context: ContextProvider, time: int
    ) -> tuple[ContextViews, Tensor] | None:
        """The view's source cameras at a time, and their images; None if there are none, and except in mul."""
        is_mul = self.config.framing == "mul" and view.source_views
        views = context(time, view.source_views) if is_mul else None
        return None if views is None else (views, foreground(views))

    def _clip(
        self,
        window: Window,
        view: IncompleteView,
        frames: Mapping[int, Tensor],
        cameras: Callable[[int], tuple[ContextViews, Tensor] | None],
    ) -> Clip:
        """A window at the view's time and at the past times that the sampling wants."""
        size = self.config.size_px
        sampling = self.config.sampling

        def look(time: int) -> Frames:
            own = window.of(frames[time], size)[None]
            found = cameras(time)
            if found is None:
                return own
            views, images = found
            return torch.cat([own, camera_windows(images, views, aim(view, window, size), size).to(own)])

        past = (sampling.neighbour_times(view.time), sampling.reference_times(view.time))
        return Clip(look(view.time), *(tuple(look(t) for t in times if t in frames) for times in past))
