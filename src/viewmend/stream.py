"""The pipeline from camera frames to completed novel views.

    MultiViewFrame ──add_frame──▶ CachedFrame ──render──▶ IncompleteView ──mend──▶ CompletedView

All commands that render, the live server and the evaluation use `Stream` (section 9). What depends
on the rig or on a frame is computed once and shared by all viewers; what depends on a viewer is a
`State`, passed in and returned.
"""

import logging
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.frame_cache import CachedFrame, DepthProvider, all_masks, cache_frame, check_provider, evict
from viewmend.fused_geometry import FusedFrame, fuse_geometry
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras, check_names
from viewmend.geometry.fusion import FusionConfig
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.threads import all_threads, one_thread
from viewmend.models.base import ContextProvider, Inpainter, Memory, RenderQuality, State
from viewmend.models.compositing import Background, to_background
from viewmend.rendering.crop import BORDER_PX, Crop, grid_px, mesh_crop, subject_crop
from viewmend.rendering.error_mask import Evidence, decide_error_mask, with_rim
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.types import (
    CompletedView,
    ContextViews,
    IncompleteView,
    MultiViewFrame,
    Silhouettes,
    check_target_mask,
)
from viewmend.utils.cancellation import stop_if_cancelled
from viewmend.utils.timing import StageTimes, ms_since, now_s

log = logging.getLogger("viewmend")


Geometry = Literal["hull", "fused"]
"""The kinds of geometry proxy that a stream computes."""


@dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """Everything about a stream except its inpainter.

    Examples:
        >>> from viewmend import Stream, StreamConfig, make_method
        >>> Stream(make_method("telea"), StreamConfig(memory_mb=200.0)).times
        ()
    """

    geometry: Geometry = "hull"
    """The geometry proxy: the visual hull alone, or the hull fused with the depth that a model predicts."""
    hull: HullConfig = field(default_factory=HullConfig)
    """Parameters of the visual hull."""
    fusion: FusionConfig = field(default_factory=FusionConfig)
    """Parameters of the fused geometry."""
    render: RenderConfig = field(default_factory=RenderConfig)
    """How views are rendered, and which of their pixels are inpainted."""
    predict_mask: bool | None = None
    """Whether M_t is predicted where it is not known, as the alpha of the error model. None: if the
    inpainter needs it, and there is an error model. Views of reduced quality get no predicted mask."""
    background: Background = "black"
    """Background of the input of inpainters that have none of their own, such as classical fills."""
    memory_mb: float | None = 2000.0
    """Frames are dropped above this much memory, MB: first those that the inpainter's temporal
    window does not need, the least recently used first. The default holds the window of
    `paper-small` for 8 cameras of 512 x 512 pixels, all of them encoded. None: frames are dropped
    that are further from the one in use than a temporal window reaches."""

    def __post_init__(self) -> None:
        if self.geometry not in get_args(Geometry):
            raise ValueError(f"expected a geometry 'hull' or 'fused', got '{self.geometry}'")
        if self.background not in get_args(Background):
            raise ValueError(f"expected a background 'black' or 'white', got '{self.background}'")
        if self.memory_mb is not None and not self.memory_mb >= 0:
            raise ValueError(f"expected memory_mb of 0 or more, or None for no limit, got {self.memory_mb}")


@dataclass(frozen=True)
class StreamView:
    """One viewer's view.

    Examples:
        >>> from viewmend import Stream, make_method
        >>> from viewmend.studio.rigs import orbit
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> target = orbit([0.4], (64, 64), elevation_rad=0.2)
        >>> stream = Stream(make_method("telea"))
        >>> first = stream.view(target, time=stream.add_frame(frame).frame.time)
        >>> again = stream.view(target, first.viewer)
        >>> first.times.geometry > 0, again.times.geometry
        (True, 0.0)
    """

    completed: CompletedView
    viewer: State
    """State to pass with this viewer's next view."""
    times: StageTimes


class Stream:
    """Frames in, completed views out, for any number of viewers. Call it from one thread at a time.

    Examples:
        >>> from viewmend import Stream, make_method
        >>> from viewmend.studio.rigs import orbit
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> target = orbit([0.4], (64, 64), elevation_rad=0.2)
        >>> stream = Stream(make_method("telea"))
        >>> cached = stream.add_frame(frame)
        >>> view = stream.view(target)
        >>> view.completed.rgb.shape, stream.times
        (torch.Size([3, 64, 64]), (0,))
    """

    def __init__(
        self,
        inpainter: Inpainter,
        config: StreamConfig | None = None,
        bounds: Bounds | None = None,
        error_model: Inpainter | None = None,
    ) -> None:
        """Create an empty stream.

        Args:
            inpainter: completes the views, e.g. `load_inpainter("views")`.
            config: parameters of geometry, rendering and memory.
            bounds: the volume that may contain the subject; None to find it from the masks.
            error_model: a second model, which predicts errors, depth and masks if `inpainter` does not;
                needed for the error rule 'predicted', for `RenderQuality.refine_fraction`, for the
                geometry 'fused' and for `StreamConfig.predict_mask` (`registry.error_model_for`).

        Raises:
            ValueError: `inpainter` is a name, a class or anything else than an inpainter; or the
                geometry is 'fused', or masks are to be predicted, and no model can do so.
        """
        if not isinstance(inpainter, Inpainter):
            raise ValueError(
                f"expected an inpainter, got {inpainter!r}; make one: make_method('telea') for a name, Class() for a "
                "class, which must be a subclass of viewmend.Inpainter"
            )
        self.inpainter = inpainter
        self.config = config or StreamConfig()
        self.bounds = bounds
        self.error_model = error_model
        self._depth_model = inpainter if inpainter.predicts_depth else error_model
        if self.config.geometry == "fused" and (
            self._depth_model is None or not self._depth_model.predicts_depth
        ):
            raise ValueError(
                f"expected a model that predicts depth for the geometry 'fused', got {type(inpainter).__name__} alone; "
                "give one: Stream(..., error_model=load_inpainter('views')), or use the geometry 'hull'"
            )
        self._mask_model = self._find_mask_model()
        self._frames: OrderedDict[int, CachedFrame] = OrderedDict()
        self._fused: FusedFrame | None = None
        """The frame whose geometry was fused last."""
        self._warned = False
        """Whether a warning has said that the memory does not hold the window."""

    def _find_mask_model(self) -> Inpainter | None:
        """The model that predicts M_t where it is not known; None if M_t is not predicted."""
        wanted = self.config.predict_mask
        if wanted is None:
            wanted = self.inpainter.needs_mask and self.error_model is not None
        if not wanted:
            return None
        if self.error_model is None and not self.inpainter.predicts_errors:
            raise ValueError(
                f"expected a model that predicts masks, which predict_mask needs, got "
                f"{type(self.inpainter).__name__} alone; give one: Stream(..., error_model=load_inpainter('views'))"
            )
        return self.error_model or self.inpainter

    @property
    def error_rule(self) -> str:
        """The error rule in use: the configured one, else the one that the inpainter is made for."""
        return self.config.render.error_rule or self.inpainter.error_rule

    def with_render_config(self, render: RenderConfig) -> "Stream":
        """A stream with the same frames and memory, but another render configuration."""
        config = replace(self.config, render=render)
        other = Stream(self.inpainter, config, self.bounds, self.error_model)
        other._frames = self._frames
        other._fused = self._fused
        return other

    @property
    def times(self) -> tuple[int, ...]:
        """Indices of the cached frames, in order."""
        return tuple(sorted(self._frames))

    def viewer(self) -> State:
        """The state of a new viewer."""
        return self.inpainter.initial_state()

    def add_frame(
        self, frame: MultiViewFrame, geometry: DepthProvider | None = None, carving: Silhouettes | None = None
    ) -> CachedFrame:
        """Add a frame and compute its geometry proxy. A frame whose time is cached already is not replaced.

        Frames may come in any order and with gaps. Views of a frame whose masks are empty show the
        background alone.

        Args:
            frame: the cameras' images; masks are needed unless `geometry` is given.
            geometry: replaces the visual hull. `view` and `render` need a `GeometryProxy`, `mend`
                any depth provider.
            carving: masks of more cameras that carve the hull, although their images are not used.

        Raises:
            ValueError: images, masks or cameras have another type, shape or range than their fields
                say; `geometry` has no method `depth`; or none is given, and the frame has no masks,
                a single camera, or cameras that look away from each other.
        """
        if frame.time not in self._frames:
            frame.check()
            if carving is not None:
                carving.check()
            if geometry is not None:
                check_provider(geometry)
            images = replace(frame, depth=None)  # the ground truth of synthetic captures must not be used
            if geometry is None:
                self._frames[frame.time] = self._with_geometry(images, carving)
            else:
                self._frames[frame.time] = CachedFrame(images, geometry)
        self._use(frame.time)
        return self._frames[frame.time]

    def _with_geometry(self, images: MultiViewFrame, carving: Silhouettes | None) -> CachedFrame:
        """The frame with the geometry proxy that the configuration asks for."""
        hull = cache_frame(images, self.bounds, self.config.hull, carving)
        if self.config.geometry == "hull":
            return hull
        assert self._depth_model is not None
        start = now_s(images.rgb.device)
        masks = all_masks(images, carving)
        config = self.config
        self._fused = fuse_geometry(
            hull, masks, self._depth_model, config.render, config.fusion, config.hull, self._fused
        )
        fused = self._fused.cached
        fused.geometry_ms = hull.geometry_ms + ms_since(start, images.rgb.device)
        return fused

    def adopt(self, cached: CachedFrame) -> CachedFrame:
        """Add a frame that another stream has prepared, with its geometry and everything computed from it so far.

        Its data are shared, not copied; what either stream computes later is its own. A frame
        whose time is cached already is not replaced, but it takes over the depths and encodings
        that it does not have yet.

        Args:
            cached: the frame, on the device on which this stream's views are rendered.

        Raises:
            ValueError: as `add_frame`.
        """
        own = self.add_frame(cached.frame, cached.proxy)
        own.depths = cached.depths | own.depths
        own.encoded = cached.encoded | own.encoded
        self._use(cached.frame.time)  # again, because depths and encodings need memory, too
        return own

    def _use(self, time: int) -> None:
        """Mark a frame as the one used last, and drop frames beyond the memory.

        The first time that this cuts the inpainter's window, a warning says so.
        """
        self._frames.move_to_end(time)
        dropped = evict(self._frames, time, self.config.memory_mb, self.inpainter.window_frames)
        if dropped and not self._warned:
            self._warned = True
            needed_mb = (1 + self.inpainter.window_frames) * max(cached.size for cached in dropped) / 1e6
            log.warning(
                "expected memory for the %d frames that the window of %s reaches back, about %.0f MB, got %g MB; the "
                "oldest of them are dropped; raise StreamConfig.memory_mb (viewmend serve: --memory-mb, twice as much)",
                self.inpainter.window_frames,
                type(self.inpainter).__name__,
                needed_mb,
                self.config.memory_mb,
            )

    def cached_frame(self, time: int | None = None) -> CachedFrame:
        """The frame of this index, by default the latest.

        Raises:
            ValueError: it is not cached.
        """
        if not self._frames or (time is not None and time not in self._frames):
            raise ValueError(
                f"expected the time of a cached frame, {self.times}, got {time}; add its frame first"
            )
        return self._frames[max(self._frames) if time is None else time]

    def render(
        self,
        target: Cameras,
        time: int | None = None,
        exclude: Sequence[str] = (),
        target_mask: Float[Tensor, "height width"] | None = None,
    ) -> IncompleteView:
        """Render a novel view from the source cameras, and decide its error mask: F, M and E of section 1.

        Args:
            target: the novel view's camera (one view), on the frames' device.
            time: index of the frame, by default the latest.
            exclude: names of cameras whose images must not be used; those without an image are ignored.
            target_mask: the subject's mask in the novel view, if it is known (`IncompleteView.target_mask`).

        Raises:
            ValueError: `target` is not one camera, the frame is not cached, its geometry is not a
                `GeometryProxy`, no camera is left, `exclude` is a string, `target_mask` is not a
                mask of the view, or the error rule needs a model that predicts errors.
        """
        part, evidence, crop = self._render(target, time, exclude, RenderQuality(), target_mask)
        part, _ = self._with_error_mask(part, evidence, RenderQuality(), exclude)
        return crop.uncropped(part, target)

    def mend(
        self,
        view: IncompleteView,
        viewer: State | None = None,
        quality: RenderQuality | None = None,
        exclude: Sequence[str] = (),
    ) -> StreamView:
        """Complete a view of a cached frame that `render`, or any other renderer, made.

        `view.source_views` must name the cameras that coloured it, and `view.candidate_views` all
        cameras that may be used, the closest first: the inpainter samples their images.

        Args:
            view: the view to complete.
            viewer: the state that this viewer's last view returned; None for its first.
            quality: how much work the view may cost.
            exclude: names of cameras whose images must not be used; those without an image are ignored.

        Raises:
            ValueError: the view's frame is not cached; the view names no camera or one that is not
                in the frame; an image of it, or the depth of the frame's geometry, has another
                type, shape or range than its field says; `exclude` is a string; the inpainter does
                not return a completed view of it; or `quality` needs a model that predicts errors.
        """
        quality = quality or RenderQuality()
        view.check(self.cached_frame(view.time).frame.cameras.names)
        check_names("exclude", exclude)
        if view.target_mask is not None:  # resampling may overshoot
            view = replace(view, target_mask=view.target_mask.clamp(0, 1).contiguous())

        # A crop saves inpainting; without that, or if the inpainter needs the whole view, there is none
        margin_px = self.inpainter.crop_margin_px(quality) if quality.mend else None
        crop = Crop.all_of(view.camera) if margin_px is None else subject_crop(view, margin_px)
        return self._complete(crop.of_view(view), None, crop, viewer, quality, exclude, whole=view)

    def predict_mask(
        self, view: IncompleteView, exclude: Sequence[str] = ()
    ) -> Float[Tensor, "height width"]:
        """M_t of a rendered view whose mask is not known: the alpha that a model predicts, in [0, 1].

        Raises:
            ValueError: masks are not predicted in this stream (`StreamConfig.predict_mask`).
        """
        model = self._mask_model
        if model is None:
            raise ValueError(
                "expected a stream that predicts masks, got one with predict_mask off; turn it on"
            )
        margin_px = model.crop_margin_px(RenderQuality())
        view = replace(view, error=with_rim(view.mask), fade=None)
        crop = Crop.all_of(view.camera) if margin_px is None else subject_crop(view, margin_px)
        part = crop.of_view(view)
        context = self.context_provider(exclude=exclude)
        with all_threads():
            completed, _ = model.step_on(self.config.background, part, context, model.initial_state())
        return crop.uncropped_image(completed.opacity.clamp(0, 1), view.camera)

    def advance(self, view: IncompleteView, viewer: State | None = None) -> State | None:
        """The state after a view whose completion is not needed; None if only `mend` can compute it."""
        inpainter = self.inpainter
        # An inpainter with a background of its own puts views on it itself
        background = self.config.background if inpainter.background is None else "black"
        viewer = self.viewer() if viewer is None else viewer
        return inpainter.advance_state(to_background(background, view), viewer)

    @one_thread()
    def view(
        self,
        target: Cameras,
        viewer: State | None = None,
        time: int | None = None,
        quality: RenderQuality | None = None,
        exclude: Sequence[str] = (),
        target_mask: Float[Tensor, "height width"] | None = None,
    ) -> StreamView:
        """Render and complete one novel view: `render`, then `mend`.

        Args:
            target: the novel view's camera (one view), on the frames' device.
            viewer: the state that this viewer's last view returned; None for its first.
            time: index of the frame, by default the latest.
            quality: how much work the view may cost.
            exclude: names of cameras whose images must not be used; those without an image are ignored.
            target_mask: the subject's mask in the novel view, if it is known (`IncompleteView.target_mask`).

        Raises:
            ValueError: as `render` and `mend`.
        """
        quality = quality or RenderQuality()
        start = now_s(target.K.device)
        part, evidence, crop = self._render(target, time, exclude, quality, target_mask)
        rendering_ms = ms_since(start, target.K.device)
        made = self._complete(part, evidence, crop, viewer, quality, exclude, target=target)
        return replace(made, times=replace(made.times, rendering=rendering_ms))

    def _render(
        self,
        target: Cameras,
        time: int | None,
        exclude: Sequence[str],
        quality: RenderQuality,
        target_mask: Float[Tensor, "height width"] | None,
    ) -> tuple[IncompleteView, Evidence, Crop]:
        """Render the part of a view that shows the subject, with the inpainter's margin."""
        check_names("exclude", exclude)
        target.check_single()
        check_target_mask(target_mask, target.max_size_px[::-1])
        stop_if_cancelled()
        cached = self.cached_frame(time)
        if not isinstance(cached.proxy, GeometryProxy):
            got = type(cached.proxy).__name__
            raise ValueError(
                f"expected a GeometryProxy to render, got {got}; render the view yourself, and use mend"
            )

        # Only the part that shows the subject is rendered. If the inpainter needs the whole view
        # (a margin of None), `_complete` puts the part into one.
        margin_px = self.inpainter.crop_margin_px(quality)
        if margin_px is None:
            crop = mesh_crop(cached.proxy.mesh.vertices, target, BORDER_PX, 1)
        else:
            crop = mesh_crop(cached.proxy.mesh.vertices, target, margin_px, grid_px(margin_px))
        camera = crop.of_camera(target)
        part, evidence = render_view(
            cached.frame, cached.proxy, camera, self.config.render, exclude, cached.depth
        )
        if target_mask is not None:
            part = replace(part, target_mask=crop.of_image(target_mask).clamp(0, 1))
        return part, evidence, crop

    def _with_error_mask(
        self, view: IncompleteView, evidence: Evidence | None, quality: RenderQuality, exclude: Sequence[str]
    ) -> tuple[IncompleteView, float]:
        """The view, or a part of one, with its final E, and the milliseconds spent on encoding cameras for it.

        A view without evidence comes from another renderer, with an E that only the quality may restrict.
        """
        fraction = self._refine_fraction(quality, has_evidence=evidence is not None)
        context = self.context_provider(RenderQuality(refine_fraction=fraction), exclude)
        masked = decide_error_mask(
            view, evidence, self.error_rule, fraction, self.inpainter, context, self.error_model
        )
        return masked, context.encoding_ms

    def _refine_fraction(self, quality: RenderQuality, has_evidence: bool) -> float | None:
        """The largest fraction of the subject's pixels to inpaint; None for no limit.

        The quality may limit it and, if the rule 'predicted' decides E from evidence, the configuration. The
        smaller limit counts.
        """
        if not quality.mend:
            return None
        limits = []
        if quality.refine_fraction is not None:
            limits.append(quality.refine_fraction)
        if has_evidence and self.error_rule == "predicted":
            limits.append(self.config.render.refine_fraction)
        return min(limits, default=None)

    def _complete(
        self,
        part: IncompleteView,
        evidence: Evidence | None,
        crop: Crop,
        viewer: State | None,
        quality: RenderQuality,
        exclude: Sequence[str],
        *,
        whole: IncompleteView | None = None,
        target: Cameras | None = None,
    ) -> StreamView:
        """Complete a part of a view, and paste it into `whole`, or into an empty view of `target`."""
        cached = self.cached_frame(part.time)
        context = self.context_provider(quality, exclude)
        start = now_s(part.rgb.device)

        # predict the subject's mask, if it is needed and not known
        stop_if_cancelled()
        if self._mask_model is not None and part.target_mask is None and _allows_mask(quality):
            mask = self.predict_mask(part, exclude)
            part = replace(part, target_mask=mask)
            if whole is not None:
                whole = replace(whole, target_mask=crop.uncropped_image(mask, whole.camera))

        # decide which pixels are to be inpainted
        stop_if_cancelled()
        masked, encoding_ms = self._with_error_mask(part, evidence, quality, exclude)
        stop_if_cancelled()

        # put the part into an empty view, if the inpainter needs the whole view; a given one was not cropped
        needs_whole_view = self.inpainter.crop_margin_px(quality) is None
        if target is not None and needs_whole_view:
            masked = crop.uncropped(masked, target)
            crop = Crop.all_of(target)

        # inpaint them
        completed = CompletedView(masked, masked.cut_rgb)
        state = self.viewer() if viewer is None else viewer
        if quality.mend:
            with all_threads(), torch.no_grad():  # a network of the user's may have parameters with gradients
                completed, state = self.inpainter.step_on(self.config.background, masked, context, state)
        encoding_ms += context.encoding_ms
        inpainting_ms = ms_since(start, masked.rgb.device) - encoding_ms if quality.mend else 0.0

        # put the part into the whole view
        if whole is None:
            assert target is not None, "without a whole view, its camera is given"
            whole = crop.uncropped(masked, target)
        completed = crop.pasted(completed, whole)
        self._use(part.time)
        times = StageTimes(geometry=cached.pop_geometry_ms(), context=encoding_ms, inpainting=inpainting_ms)
        return StreamView(completed, state, times)

    def context_provider(
        self, quality: RenderQuality | None = None, exclude: Sequence[str] = ()
    ) -> ContextProvider:
        """The cameras of all frames in memory, except `exclude`, and what was computed from them."""
        return ContextProvider(self._context, quality, exclude, self._memory)

    def _context(self, time: int, names: tuple[str, ...]) -> ContextViews | None:
        return self._frames[time].context(names) if time in self._frames else None

    def _memory(self, time: int) -> Memory:
        if time not in self._frames:
            return {}
        self._frames.move_to_end(time)
        return self._frames[time].encoded


def _allows_mask(quality: RenderQuality) -> bool:
    """Whether the quality is not reduced, so that a mask is predicted: this takes as long as a view by `views`."""
    return quality.mend and quality.context_times is None and quality.refine_fraction is None
