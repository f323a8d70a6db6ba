"""From what the cameras saw to what a viewer sees: push a frame, render a view, mend what is missing in it.

    frame --push--> observation --render--> incomplete view --mend--> completed view

Every command, the live server, the evaluation and the examples go this way (section 9). What does not depend on a view
is computed once, and shared by all viewers.
"""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.threads import heavy_operations, light_operations
from viewmend.inpainting.protocol import (
    ContextProvider,
    Memory,
    RenderQuality,
    State,
    ViewInpainter,
    crop_margin_px,
    own_error_rule,
)
from viewmend.inpainting.wrong import narrowed
from viewmend.observation import DepthProvider, Observation, forget, observe
from viewmend.rendering.crop import BORDER_PX, Crop, grid_px, mesh_crop, subject_crop
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.rig_fit import RigFit
from viewmend.timing import StageTimes, ms_since, now_s
from viewmend.views import CompletedView, ContextViews, IncompleteView, MultiViewFrame


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """The system without its inpainter.

    Examples:
        >>> from viewmend import Stream, StreamConfig, make_method
        >>> Stream(make_method("telea"), StreamConfig(memory_mb=200.0)).times
        ()
    """

    hull: HullConfig = field(default_factory=HullConfig)
    """How the geometry proxy is carved."""
    render: RenderConfig = field(default_factory=RenderConfig)
    """How views are rendered from the cameras."""
    memory_mb: float | None = 1000.0
    """The times looked at longest ago are forgotten above this. None: those older than any window reaches are."""
    fit_rig: bool = True
    """Whether an inpainter that can is fitted to the rig when the first frame comes (`rig_fit`)."""


@dataclass(frozen=True)
class StreamView:
    """What one viewer gets.

    Examples:
        >>> import torch
        >>> from viewmend import Stream, look_at, make_method, pinhole
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> up, subject = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.95, 0.0])
        >>> target = pinhole(0.8, 64, 64, look_at(torch.tensor([0.5, 1.0, 3.0]), subject, up))
        >>> stream = Stream(make_method("telea"))
        >>> first = stream.view(target, time=stream.push(frame).frame.time)
        >>> again = stream.view(target, first.viewer)
        >>> first.times.geometry > 0, again.times.geometry
        (True, 0.0)
    """

    completed: CompletedView
    viewer: State
    """What to ask for the next view with: a value, so that no viewer can disturb another."""
    times: StageTimes


class Stream:
    """Frames in, mended views out, for any number of viewers. Call it from one thread at a time.

    Examples:
        >>> import torch
        >>> from viewmend import Stream, look_at, make_method, pinhole
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> up, subject = torch.tensor([0.0, 1.0, 0.0]), torch.tensor([0.0, 0.95, 0.0])
        >>> target = pinhole(0.8, 64, 64, look_at(torch.tensor([0.5, 1.0, 3.0]), subject, up))
        >>> stream = Stream(make_method("telea"))
        >>> observation = stream.push(frame)
        >>> seen = stream.view(target)
        >>> seen.completed.rgb.shape, stream.times
        (torch.Size([3, 64, 64]), (0,))
    """

    def __init__(
        self, inpainter: ViewInpainter, config: StreamConfig | None = None, bounds: Bounds | None = None
    ) -> None:
        """Begin a stream.

        Args:
            inpainter: what fills the holes, e.g. `load_inpainter("small")`.
            config: how frames become proxies and views.
            bounds: the volume that may hold the subject; None to find it from the masks.
        """
        self.config = config or StreamConfig()
        self._fit = RigFit(inpainter, self.config.fit_rig)
        self.bounds = bounds
        self._observations: OrderedDict[int, Observation] = OrderedDict()

    @property
    def inpainter(self) -> ViewInpainter:
        """What fills the holes; it may be fitted to the rig."""
        return self._fit.inpainter

    @property
    def error_rule(self) -> str:
        """What E is by: as configured, else what the inpainter is made for."""
        return self.config.render.error_rule or own_error_rule(self.inpainter)

    def rendered_by(self, render: RenderConfig) -> "Stream":
        """The same times and memory, with views rendered in another way."""
        other = Stream(self.inpainter, replace(self.config, render=render), self.bounds)
        other._observations, other._fit = self._observations, self._fit
        return other

    @property
    def times(self) -> tuple[int, ...]:
        """The times at hand, in order."""
        return tuple(sorted(self._observations))

    def viewer(self) -> State:
        """Someone who has seen nothing yet."""
        return self.inpainter.initial_state()

    def push(self, frame: MultiViewFrame, geometry: DepthProvider | None = None) -> Observation:
        """Take in what the cameras saw at one time; a time that is at hand already stays as it is.

        Times may come in any order and with gaps. `geometry` replaces the visual hull: anything that knows its depth
        in the cameras (`render` needs the hull, `mend` does not); the frame may lack masks then.

        Raises:
            ValueError: the frame has no masks, no foreground, or a single camera, and no `geometry` is given.
        """
        if frame.time not in self._observations:
            frame = replace(frame, depth=None)  # the truth of synthetic captures: nobody looks at it here
            given = None if geometry is None else Observation(frame, geometry)
            self._observations[frame.time] = given or observe(frame, self.bounds, self.config.hull)
            if given is None:
                self._fit.see(frame, self.bounds, self.config.hull, self.config.render)
        self._observations.move_to_end(frame.time)
        forget(self._observations, frame.time, self.config.memory_mb)
        return self._observations[frame.time]

    def observation(self, time: int | None = None) -> Observation:
        """What `push` gave for a time that is at hand, the latest by default.

        Raises:
            ValueError: it is not.
        """
        if not self._observations or (time is not None and time not in self._observations):
            raise ValueError(f"expected a time among those at hand, {self.times}, got {time}; push its frame first")
        return self._observations[max(self._observations) if time is None else time]

    def render(self, target: Cameras, time: int | None = None, exclude: Sequence[str] = ()) -> IncompleteView:
        """The view as the source cameras show it, and what is missing in it: F, M and E of section 1.

        Args:
            target: the novel view's camera (one view), on the frames' device.
            time: which of `times`; the latest by default.
            exclude: names of cameras whose images must not be used.

        Raises:
            ValueError: that time is not at hand, its geometry is not a `GeometryProxy`, or no camera is left.
        """
        part, crop = self._render(target, time, exclude)
        part = self._narrowed(part, self._read_fraction(RenderQuality()), exclude)
        return part if crop is None else crop.uncropped(part, target)

    def mend(
        self,
        view: IncompleteView,
        viewer: State | None = None,
        quality: RenderQuality | None = None,
        exclude: Sequence[str] = (),
    ) -> StreamView:
        """Fill what is missing in a view that `render`, or any other renderer, made of a time that was pushed.

        Name in `view.source_views` the cameras that coloured it, and in `view.candidate_views` all that may be looked
        at, the closest first: holes are read from them.

        Args:
            view: what to fill.
            viewer: what the last view gave; None for a first look.
            quality: what it may cost.
            exclude: names of cameras whose images must not be used.

        Raises:
            ValueError: the view's time is not at hand, it names cameras that are not in the frame, or the inpainter
                gives numbers that are not finite.
        """
        quality = quality or RenderQuality()
        view.demand_cameras(self.observation(view.time).frame.cameras.names)
        view = self._narrowed(view, quality.read_fraction if quality.mend else None, exclude)
        margin_px = crop_margin_px(self.inpainter, quality) if quality.mend else None
        crop = None if margin_px is None else subject_crop(view, margin_px)
        if crop is None:
            return self._fill(view, viewer, quality, exclude)
        mended = self._fill(crop.of_view(view), viewer, quality, exclude)
        return replace(mended, completed=crop.pasted(mended.completed, view))

    @light_operations()
    def view(
        self,
        target: Cameras,
        viewer: State | None = None,
        time: int | None = None,
        quality: RenderQuality | None = None,
        exclude: Sequence[str] = (),
    ) -> StreamView:
        """`render` one novel view, and `mend` it.

        Args:
            target: the novel view's camera (one view), on the frames' device.
            viewer: what the last view gave; None for a first look.
            time: which of `times`; the latest by default.
            quality: what it may cost.
            exclude: names of cameras whose images must not be used.

        Raises:
            ValueError: as `render`'s and `mend`'s.
        """
        quality = quality or RenderQuality()
        margin_px = crop_margin_px(self.inpainter, quality)
        start = now_s(target.K.device)
        part, crop = self._render(target, time, exclude, margin_px)
        if crop is not None and margin_px is None and quality.mend:
            part, crop = crop.uncropped(part, target), None
        rendering_ms = ms_since(start, target.K.device)
        mended = self._fill(part, viewer, quality, exclude, self._read_fraction(quality))
        completed = mended.completed if crop is None else crop.uncropped_completed(mended.completed, target)
        return replace(mended, completed=completed, times=replace(mended.times, rendering=rendering_ms))

    def _read_fraction(self, quality: RenderQuality) -> float | None:
        """The part of the proxy that may be mended; None for all that the rule asks."""
        allowed = self.config.render.wrong_fraction if self.error_rule == "wrong" else None
        return min((part for part in (quality.read_fraction, allowed) if part is not None), default=None)

    def _narrowed(self, view: IncompleteView, fraction: float | None, exclude: Sequence[str]) -> IncompleteView:
        """The view with E where most is to be gained."""
        context = ContextProvider(self._context, RenderQuality(read_fraction=fraction), exclude, self._memory)
        return view if fraction is None else narrowed(view, self.inpainter, context, fraction)

    def _render(
        self, target: Cameras, time: int | None, exclude: Sequence[str], margin_px: int | None = None
    ) -> tuple[IncompleteView, Crop | None]:
        """The part of the view that shows the subject, or that can be filled on its own with a margin; and which."""
        observation = self.observation(time)
        frame, proxy = observation.frame, observation.proxy
        if not isinstance(proxy, GeometryProxy):
            raise ValueError(f"expected a GeometryProxy to render, got {type(proxy).__name__}; render it yourself")
        room = (BORDER_PX, 1) if margin_px is None else (margin_px, grid_px(margin_px))
        crop = mesh_crop(proxy.mesh.vertices, target, *room)
        camera = target if crop is None else crop.of_camera(target)
        config, depth = replace(self.config.render, error_rule=self.error_rule), observation.depth
        return render_view(frame, proxy, camera, config, exclude=exclude, source_depth=depth), crop

    def _fill(
        self,
        view: IncompleteView,
        viewer: State | None,
        quality: RenderQuality,
        exclude: Sequence[str],
        fraction: float | None = None,
    ) -> StreamView:
        """A view, or the part of one that matters, completed; at most this fraction of it is read."""
        now, viewer = self.observation(view.time), viewer or self.viewer()
        completed = CompletedView(view, view.rgb)
        context = ContextProvider(self._context, quality, exclude, self._memory)
        start = now_s(view.rgb.device)
        if quality.mend:
            view = self._narrowed(view, fraction, exclude)
            with heavy_operations():
                completed, viewer = self.inpainter.step(view, context, viewer)
            completed.demand_finite(type(self.inpainter).__name__)
        inpainting_ms = ms_since(start, view.rgb.device) - context.encoding_ms if quality.mend else 0.0
        self._observations.move_to_end(view.time)
        forget(self._observations, view.time, self.config.memory_mb)
        times = StageTimes(geometry=now.pay_geometry(), context=context.encoding_ms, inpainting=inpainting_ms)
        return StreamView(completed, viewer, times)

    def _context(self, time: int, names: tuple[str, ...]) -> ContextViews | None:
        return self._observations[time].context(names) if time in self._observations else None

    def _memory(self, time: int) -> Memory:
        if time not in self._observations:
            return {}
        self._observations.move_to_end(time)
        return self._observations[time].encoded
