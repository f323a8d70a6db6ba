"""A stream of frames that many viewers look at: what does not depend on a view is computed once (section 9)."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.context import ContextCache, ContextFrame, window_times
from viewmend.inpainting.inpainter import Inpainter
from viewmend.inpainting.protocol import Source, State, ViewInpainter
from viewmend.own_pages import to_own_pages
from viewmend.pipeline import (
    DepthProvider,
    Observation,
    PipelineConfig,
    StageMs,
    StreamState,
    complete_view,
    ms_since,
    now_s,
    observe,
    view_of,
)
from viewmend.views import CompletedView, IncompleteView, MultiViewFrame


@dataclass(frozen=True, kw_only=True)
class RenderQuality:
    """How much work one view may cost; the default is all that the model was trained with."""

    mend: bool = True
    """False leaves the holes as they are rendered."""
    top_k: int | None = None
    """Context tokens that survive pruning; None takes the model's own."""
    context_times: int | None = None
    """How many of the window's times are context, the latest first (1: the view's own alone); None takes all. With 0
    no camera image is encoded: a model with a first fill shows that alone (read along rays, if it does so), and others
    have but the view's own patches."""


@dataclass(frozen=True)
class Viewer:
    """What one viewer carries from one view to the next: a value, which `Stream.view` gives anew."""

    inpainter: State


@dataclass(frozen=True)
class StreamView:
    """What one viewer gets."""

    completed: CompletedView
    viewer: Viewer
    """To ask for the next view with."""
    stage_ms: StageMs
    """`geometry` is what the proxy took for whoever came first; `inpainting` is without `encoding_ms`."""
    encoding_ms: float = 0.0
    """What was encoded of the cameras' images, for all to use, because this view was the first to need it."""


@dataclass
class _Moment:
    """One time and what was computed for it."""

    observation: Observation
    encoded: dict[str, ContextFrame] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Bytes, without what is too small to count."""
        frame, proxy = self.observation.frame, self.observation.proxy
        tensors: list[Tensor | None] = [frame.rgb, frame.mask, *self.observation.known_depths()]
        if isinstance(proxy, GeometryProxy):
            tensors += [proxy.mesh.vertices, proxy.mesh.faces, proxy.normals]
        for encoded in self.encoded.values():
            tensors += [encoded.tokens, encoded.keys_values]
        return sum(t.numel() * t.element_size() for t in tensors if t is not None)


class Stream:
    """Frames in, mended views out, for any number of viewers.

    The geometry proxy, its depth in the cameras, and the encoded context with its keys and values are kept by time
    and shared; each viewer pays for its own view alone. What a viewer carries along is a value that the caller
    holds, so that no viewer can disturb another. Call it from one thread at a time.
    """

    def __init__(
        self,
        inpainter: ViewInpainter,
        config: PipelineConfig | None = None,
        bounds: Bounds | None = None,
        memory_mb: float = 1000.0,
    ) -> None:
        """Begin a stream.

        Args:
            inpainter: what fills the holes, e.g. `load_inpainter("small")`.
            config: how frames become proxies and views.
            bounds: the volume that may hold the subject; None to find it from the masks.
            memory_mb: the times looked at longest ago are forgotten above this; the newest never is.
        """
        self.inpainter = inpainter
        self.config = config or PipelineConfig()
        self.bounds = bounds
        self.memory_mb = memory_mb
        self._moments: OrderedDict[int, _Moment] = OrderedDict()

    @property
    def times(self) -> tuple[int, ...]:
        """The times at hand, in order."""
        return tuple(sorted(self._moments))

    def push(self, frame: MultiViewFrame, geometry: DepthProvider | None = None) -> Observation:
        """Take in what the cameras saw at one time; a time that is at hand already stays as it is.

        Times may come in any order and with gaps. `geometry` replaces the visual hull: anything that knows its depth
        in the cameras (`view` needs the hull, `mend` does not); the frame may lack masks then.

        Raises:
            ValueError: the frame has no masks, no foreground, or a single camera, and no `geometry` is given.
        """
        if frame.time not in self._moments:
            frame = replace(frame, depth=None)  # the truth of synthetic captures: nobody looks at it here
            bounds = None if self.bounds is None else self.bounds.to(frame.rgb.device)
            given = None if geometry is None else Observation(frame, geometry, 0.0)
            self._moments[frame.time] = _Moment(given or observe(frame, bounds, self.config))
        self._moments.move_to_end(frame.time)
        self._forget()
        return self._moments[frame.time].observation

    def observation(self, time: int) -> Observation:
        """What `push` gave for a time that is at hand.

        Raises:
            ValueError: it is not.
        """
        return self._moment(time).observation

    def viewer(self) -> Viewer:
        """Someone who has seen nothing yet."""
        return Viewer(self.inpainter.initial_state())

    def view(
        self,
        target: Cameras,
        viewer: Viewer | None = None,
        time: int | None = None,
        effort: RenderQuality | None = None,
        exclude: Sequence[str] = (),
    ) -> StreamView:
        """Render one novel view and fill what is missing in it.

        Args:
            target: the novel view's camera (one view), on the frames' device.
            viewer: what the last view gave; None for a first look.
            time: which of `times`; the latest by default.
            effort: what it may cost.
            exclude: names of cameras whose images must not be used.

        Raises:
            ValueError: that time is not at hand, or no camera is left.
        """
        moment = self._moment(time)
        viewer = viewer or self.viewer()
        view, rendering_ms = view_of(moment.observation, target, self.config, exclude)
        return self._complete(view, moment, viewer, effort or RenderQuality(), exclude, rendering_ms)

    def mend(
        self,
        view: IncompleteView,
        viewer: Viewer | None = None,
        effort: RenderQuality | None = None,
        exclude: Sequence[str] = (),
    ) -> StreamView:
        """Fill what is missing in a view that any renderer made of a time that was pushed.

        Name in `view.source_views` the cameras that coloured it, and in `view.candidate_views` all that may be looked
        at, the closest first: holes are read from them.

        Raises:
            ValueError: the view's time is not at hand, or it names cameras that are not in the frame.
        """
        moment = self._moment(view.time)
        unknown = sorted({*view.source_views, *view.candidate_views} - set(moment.observation.frame.cameras.names))
        if unknown:
            known = list(moment.observation.frame.cameras.names)
            raise ValueError(f"expected a view of cameras among {known}, got {unknown}; correct chosen and nearest")
        return self._complete(view, moment, viewer or self.viewer(), effort or RenderQuality(), exclude, 0.0)

    def _moment(self, time: int | None) -> _Moment:
        if not self._moments or (time is not None and time not in self._moments):
            raise ValueError(f"expected a time among those at hand, {self.times}, got {time}; push its frame first")
        return self._moments[max(self._moments) if time is None else time]

    def _complete(
        self,
        view: IncompleteView,
        moment: _Moment,
        viewer: Viewer,
        effort: RenderQuality,
        exclude: Sequence[str],
        rendering_ms: float,
    ) -> StreamView:
        if not effort.mend:
            stages = StageMs(moment.observation.geometry_ms, rendering_ms, 0.0)
            return StreamView(CompletedView(view, view.rgb), viewer, stages)
        moments = [*self._past(view.time, effort), moment]
        encoding_ms = self._encode(view, moments if effort.context_times != 0 else [])
        frames = {(f.name, f.time): f for m in moments for f in m.encoded.values()}
        before = replace(viewer.inpainter, cache=ContextCache(frames if effort.context_times != 0 else {}))
        state = StreamState(before, tuple(m.observation for m in moments[:-1]))
        inpainter = _WithEffort(self.inpainter, effort)
        mended = complete_view(view, moment.observation, state, inpainter, self.config, exclude, rendering_ms)
        for m in moments:
            self._moments.move_to_end(m.observation.frame.time)
        self._forget()
        after = Viewer(replace(mended.state.inpainter, cache=ContextCache()))
        return StreamView(mended.completed, after, mended.stage_ms, encoding_ms)

    @torch.no_grad()
    def _encode(self, view: IncompleteView, moments: Sequence[_Moment]) -> float:
        """Encode what the view's cameras saw at these times and nobody needed before; the milliseconds."""
        if not isinstance(self.inpainter, Inpainter) or not bool((view.error > 0).any()):
            return 0.0
        start = now_s(view.rgb.device)
        wanted = self.inpainter.context_names(view)
        missing = [(m, m.observation.context([n for n in wanted if n not in m.encoded])) for m in moments]
        fresh = [(m, views) for m, views in missing if views is not None]
        encoded = self.inpainter.encode_contexts([views for _, views in fresh])
        for (moment, _), frames in zip(fresh, encoded, strict=True):
            moment.encoded.update({frame.name: to_own_pages(frame) for frame in frames})
        return ms_since(start, view.rgb.device)

    def _past(self, time: int, effort: RenderQuality) -> list[_Moment]:
        """The moments before `time` that may be context, in order of time."""
        if isinstance(self.inpainter, Inpainter):
            window = window_times(time, self.inpainter.config)[: effort.context_times]
        else:
            window = range(time, time - self.config.history - 1, -1)[: effort.context_times]
        return [self._moments[t] for t in sorted(window) if t < time and t in self._moments]

    def _forget(self) -> None:
        """Drops the times looked at longest ago until the others fit."""
        size = {time: moment.size for time, moment in self._moments.items()}
        while sum(size.values()) > 1e6 * self.memory_mb and len(self._moments) > 1:
            time, _ = self._moments.popitem(last=False)
            del size[time]


class _WithEffort:
    """An inpainter that does as much as it is asked to; inpainters other than ours stay as they are."""

    def __init__(self, inpainter: ViewInpainter, effort: RenderQuality) -> None:
        self._inpainter = inpainter
        self._effort = effort

    def initial_state(self) -> State:
        return self._inpainter.initial_state()

    def step(self, view: IncompleteView, source: Source, state: State) -> tuple[CompletedView, State]:
        if not isinstance(self._inpainter, Inpainter):
            return self._inpainter.step(view, source, state)
        if self._effort.context_times == 0:
            return self._inpainter.keep_steady(self._without_context(self._inpainter, view, source), state)
        return self._inpainter.step(view, source, state, self._effort.top_k)

    @torch.no_grad()
    def _without_context(self, inpainter: Inpainter, view: IncompleteView, source: Source) -> CompletedView:
        if not bool((view.error > 0).any()):
            return CompletedView(view, view.rgb)
        around = view.closest_views(inpainter.config.rays)
        nearby = source(view.time, around) if around else None
        if inpainter.config.prefill:
            return inpainter.first_fill(view, nearby)
        prediction = inpainter.predict([view], [()], self._effort.top_k, [nearby])[0]
        return CompletedView(view, prediction.completed)
