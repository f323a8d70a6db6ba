"""Renders requested views from a frame source, without threads and sockets."""

import secrets
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.completed_cameras import complete_views, place_around, with_finer_images
from viewmend.frame_cache import CachedFrame, all_masks, cache_frame
from viewmend.fused_geometry import FusedFrame, fuse_geometry
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import FOREGROUND
from viewmend.geometry.proxy import GeometryProxy
from viewmend.live.assets import Asset, CompletedImage, FrameAssets, completed_assets, make_assets, make_mesh
from viewmend.live.budget import ladder_for
from viewmend.live.frame_source import FrameSource, RigInfo
from viewmend.live.poses import HomeView, home_view, rig_json, view_camera
from viewmend.live.protocol import BLACK, WHITE, Camera
from viewmend.metrics.image_quality import psnr
from viewmend.models.base import Inpainter, RenderQuality, State
from viewmend.models.checkpoint import load_inpainter
from viewmend.models.compositing import Background, camera_image, composite
from viewmend.rendering.proxy_views import hull_points, shaded_hull, vertex_colours
from viewmend.stream import Stream, StreamConfig, StreamView
from viewmend.types import CompletedView, IncompleteView, MultiViewFrame
from viewmend.utils.cancellation import CancelledError
from viewmend.utils.timing import StageTimes, exact_times

WARM_UP_PX = 64
"""Height and width of the view that is rendered before the first request."""
MAX_VARIANTS = 3
"""Number of streams with another model or fewer cameras that are kept."""
VARIANT_MB = 200.0
"""Memory for the frames of each of these streams, in MB."""


@dataclass(frozen=True)
class RenderRequest:
    """One view to render."""

    time: int
    """Index of the frame."""
    cameras: tuple[Cameras, ...]
    """One per eye."""
    quality: RenderQuality
    error_rule: str | None = None
    """None for the renderer's default rule."""
    extra_modes: frozenset[str] = frozenset()
    """Those of `protocol.EXTRA_MODES` to render in addition to the view."""
    without: tuple[str, ...] = ()
    """Cameras that are not used, neither their images nor their masks."""
    model: str | None = None
    """The shipped model whose view is the mode "compared". If given, "error" and the score are of this view."""
    truth: str | None = None
    """A rig camera that replaces `cameras`; the view is scored against its image."""
    frame: MultiViewFrame | None = None
    """The frame, if the source may have dropped it meanwhile; None to read it."""


@dataclass(frozen=True)
class RenderResult:
    """The views of one request."""

    time: int
    completed: tuple[CompletedView, ...]
    """One view per eye."""
    viewer: State
    """The state to pass with the viewer's next request."""
    times: StageTimes
    """Times of all eyes together; geometry and context are 0 if an earlier view has computed them."""
    background: str = BLACK
    """Default background, as hexadecimal RGB: the model's own."""
    extra: tuple[Mapping[str, Float[Tensor, "4 height width"]], ...] = ()
    """Images of `RenderRequest.extra_modes` by mode, one mapping per eye: RGB in [0, 1] multiplied by
    alpha, and alpha."""
    input_views: tuple[str, ...] = ()
    """Names of the cameras that coloured or completed the first eye's view, those that coloured it first."""
    psnr_db: float | None = None
    """PSNR inside the true mask of `RenderRequest.truth`, of the model that was asked for."""

    @property
    def eyes(self) -> Iterator[tuple[CompletedView, Mapping[str, Tensor]]]:
        """The view of each eye with its images of other modes."""
        return zip(self.completed, self.extra or repeat({}), strict=False)


class RequestError(ValueError):
    """A request names cameras that the rig does not have, or leaves out too many."""


class FrameNotReadyError(Exception):
    """The frame has not been read yet."""


class Renderer:
    """Renders requests one after the other, on one thread."""

    def __init__(
        self,
        source: FrameSource,
        inpainter: Inpainter,
        config: StreamConfig | None = None,
        device: str = "cpu",
        error_model: Inpainter | None = None,
        draws_in_page: bool = True,
        precision: str = "auto",
        completed_cameras: int = 0,
    ) -> None:
        """Set up the renderer.

        Args:
            source: where frames come from.
            inpainter: the model that completes views, unless a viewer compares another.
            config: parameters of geometry, rendering and memory.
            device: cpu or cuda.
            error_model: as in `Stream`.
            draws_in_page: whether pages draw moving views by themselves.
            precision: number format of models that viewers compare, as in `load_inpainter`.
            completed_cameras: number of virtual cameras around the subject whose views are completed
                ahead, for the frames that pages draw (`completed_ahead.py`).
        """
        self._source = source
        self._inpainter = inpainter
        self._error_model = error_model
        depth_models = [model for model in (inpainter, error_model) if model and model.predicts_depth]
        self._depth_model = depth_models[0] if depth_models else None
        self._config = config or StreamConfig()
        self.ladder = ladder_for(inpainter)
        self._device = device
        self._precision = precision
        self._draws_in_page = draws_in_page
        self._completed_cameras = completed_cameras if draws_in_page else 0
        self._rig: RigInfo | None = None
        self._stream: Stream | None = None
        self._variants: OrderedDict[tuple[str | None, tuple[str, ...]], Stream] = OrderedDict()
        """Streams of other models, and of fewer cameras; the ones used last at the end."""
        self._models: dict[str, Inpainter] = {}
        """Other models, loaded on demand."""
        self.home: HomeView | None = None
        """The initial view; None before the first frame."""
        self.virtual_cameras: Cameras | None = None
        """The cameras around the subject whose views are completed ahead; None if none are."""
        self._fused: tuple[tuple[int, tuple[str, ...]], Stream] | None = None
        """Frame and left-out cameras of the last fused mesh, and a stream that holds this frame alone."""
        self._last_fused: FusedFrame | None = None
        """The frame of the last fused mesh, whose surface the next frame's starts from."""
        self.rig_json: dict[str, Any] | None = None
        """The message `rig`."""
        self.assets_version: str | None = None
        """Changes with the rig; None before the first frame."""
        self._coloured: tuple[GeometryProxy, Tensor] | None = None
        """The last proxy that was shown as points, and its vertex colours."""
        self.model_error: str | None = None
        """Why the last view was left with its holes; None if it was inpainted."""

    @property
    def error_rule(self) -> str:
        """The default error rule."""
        return self._config.render.error_rule or self._inpainter.error_rule

    @property
    def background(self) -> str:
        """The model's background, as hexadecimal RGB."""
        return WHITE if self._inpainter.background == "white" else BLACK

    def is_prepared_for(self, rig: RigInfo | None) -> bool:
        """Whether this rig's views can be rendered."""
        return rig is not None and rig is self._rig

    def prepare(self, index: int) -> bool:
        """Prepare for the source's rig with one of its frames: find the subject, and compile kernels by a first view.

        Returns False if the rig is unknown or already prepared; raises errors as `render`.
        """
        rig = self._source.rig
        if rig is None or self.is_prepared_for(rig):
            return False
        bounds = rig.bounds
        stream = Stream(self._inpainter, self._config, bounds, self._error_model)
        cached = self._add_frame(stream, index)
        proxy = cached.proxy
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        center = proxy.mesh.vertices.mean(0) if len(proxy.mesh.vertices) else proxy.bounds.center
        cameras = cached.frame.cameras if rig.cameras is None else rig.cameras
        home = home_view(cameras, center, rig.up)
        warm_up = view_camera(Camera(azimuth=home.azimuth), home, (WARM_UP_PX, WARM_UP_PX)).to(self._device)
        self._view(stream, warm_up, stream.viewer(), index, RenderQuality())
        self.assets_version = secrets.token_hex(4)
        version = self.assets_version if self._draws_in_page else None
        fps = self._source.span.fps or None
        self.rig_json = rig_json(rig.name, cameras, bounds or proxy.bounds, home, fps, version)
        self._variants.clear()
        self._fused = None
        self._last_fused = None
        if self._completed_cameras:
            around = place_around(cameras.to("cpu"), home.center, rig.up, self._completed_cameras)
            self.virtual_cameras = with_finer_images(around)
        self._rig = rig
        self._stream = stream
        self.home = home
        return True

    @exact_times()
    def render(self, request: RenderRequest, viewer: State | None) -> RenderResult:
        """Render the views of all eyes, from one viewer's state.

        Raises:
            FrameNotReadyError: the frame has not been read yet.
            ValueError: the frame has no geometry, fewer than two cameras are left, or the true
                camera is unknown.
        """
        # The stream, the frame and the viewer's state
        if self._stream is None:
            raise FrameNotReadyError
        without = self.left_out(request.without)
        stream = self._stream_of(None, without)
        cached = self._add_frame(stream, request.time, without, request.frame)
        before = stream.viewer() if viewer is None else viewer
        truth = None if request.truth is None else self._true_frame(request.time, request.truth)
        if request.error_rule is not None:
            stream = stream.with_render_config(replace(stream.config.render, error_rule=request.error_rule))

        # The views, and images of the proxy
        asked = request.cameras if truth is None else (truth.cameras,)
        cameras = [camera.to(self._device) for camera in asked]
        views = [self._view(stream, camera, before, request.time, request.quality) for camera in cameras]
        start = time.perf_counter()
        extra = tuple(self._render_proxy(cached, camera, request.extra_modes) for camera in cameras)
        times = sum((v.times for v in views), StageTimes(rendering=1000 * (time.perf_counter() - start)))
        completed = [view.completed for view in views]

        # The views by another model
        inpainter = self._inpainter
        scored = completed[0]
        if request.model is not None:
            others = [
                self._complete_by(request.model, cached, camera, without, request.quality)
                for camera in cameras
            ]
            for images, other in zip(extra, others, strict=True):
                images["compared"] = torch.cat([other.rgb, other.opacity[None]])
            times += StageTimes(inpainting=1000 * (time.perf_counter() - start) - times.rendering)
            inpainter = self._models[request.model]
            scored = others[0]

        # The score and the map of errors
        psnr_db = None
        if truth is not None:
            background = inpainter.background or self._config.background
            psnr_db, extra[0]["error"] = self._score(scored, truth, background)

        return RenderResult(
            time=request.time,
            completed=tuple(completed),
            viewer=views[0].viewer,
            times=times,
            background=self.background,
            extra=extra,
            input_views=self._input_views(completed[0].view, request.quality),
            psnr_db=psnr_db,
        )

    def _input_views(self, rendered: IncompleteView, quality: RenderQuality) -> tuple[str, ...]:
        """Names of the cameras that a view is made from: the model's, or those that colour the rendered view."""
        is_predicted = quality.mend and quality.refine_fraction != 0
        return self._inpainter.source_names(rendered) if is_predicted else rendered.source_views

    def left_out(self, names: Sequence[str]) -> tuple[str, ...]:
        """The rig's cameras with these names, in its order; RequestError if fewer than two others are left.

        A camera's name that has commas may be divided at them.
        """
        own = [camera["name"] for camera in (self.rig_json or {"cameras": []})["cameras"]]
        listed = f",{','.join(names)},"
        found = tuple(name for name in own if name in names or ("," in name and f",{name}," in listed))
        if names and len(own) - len(found) < 2:
            raise RequestError(
                f"expected two input cameras or more, got {len(own) - len(found)}; leave out fewer"
            )
        return found

    def make_assets(self, frame: MultiViewFrame, without: tuple[str, ...] = ()) -> FrameAssets:
        """What a page needs to draw views of a frame without some of its cameras; callable from any thread.

        ValueError if the frame has no geometry.
        """
        return make_assets(frame.without(without), self.geometry(frame, without), self._config.render)

    def geometry(self, frame: MultiViewFrame, without: tuple[str, ...] = ()) -> GeometryProxy:
        """The proxy of a frame without some of its cameras, on the CPU; callable from any thread.

        ValueError if the frame has no geometry, or no rig has been prepared yet.
        """
        shared = None if without else self._source.read_cached(frame.time)
        if shared is not None and isinstance(shared.proxy, GeometryProxy):
            return shared.proxy.to("cpu")
        stream = self._variants.get((None, without)) if without else None
        stream = stream or self._stream
        if stream is None:
            raise ValueError("expected a rig, got none yet; see /health")
        cached = None
        if not without or stream is not self._stream:
            with suppress(ValueError):  # not in the stream: the hull is computed below, and not kept
                cached = stream.cached_frame(frame.time)
        if cached is None:
            cached = cache_frame(frame.without(without).to(self._device), stream.bounds, stream.config.hull)
        proxy = cached.proxy
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        return proxy.to("cpu")

    @property
    def makes_meshes_ahead(self) -> bool:
        """Whether meshes fused from predicted depth are made ahead, in addition to completed views."""
        return self._completed_cameras > 0 and self._depth_model is not None

    def fuse_mesh(self, index: int, without: tuple[str, ...]) -> Asset:
        """A frame's mesh, fused from its hull and predicted depth; errors as `render`.

        If the model that completes views predicts depth itself, the frame's virtual cameras are then
        completed behind this mesh.
        """
        assert self._depth_model is not None, "see `makes_meshes_ahead`"
        left_out = self.left_out(without)
        stream = self._stream_of(None, left_out)
        cached = self._add_frame(stream, index, left_out)
        masks = all_masks(cached.frame)
        config = self._config
        render = config.render
        last = self._last_fused
        made = fuse_geometry(cached, masks, self._depth_model, render, config.fusion, config.hull, last)
        self._last_fused = made
        if self._depth_model is self._inpainter:
            fused = Stream(self._inpainter, self._config, stream.bounds, self._error_model)
            fused.adopt(made.cached)
            self._fused = ((index, left_out), fused)
        proxy = made.cached.proxy
        assert isinstance(proxy, GeometryProxy), "hulls are fused"
        return make_mesh(cached.frame.to("cpu"), proxy.to("cpu"), render)

    def complete_virtual_camera(self, index: int, without: tuple[str, ...], number: int) -> CompletedImage:
        """The view of a virtual camera, as a further source image of a frame; errors as `render`."""
        assert self.virtual_cameras is not None, "a rig was prepared, whose views are completed ahead"
        left_out = self.left_out(without)
        if self._fused is not None and self._fused[0] == (index, left_out):
            stream = self._fused[1]
            cached = stream.cached_frame(stream.times[0])
        else:
            stream = self._stream_of(None, left_out)
            cached = self._add_frame(stream, index, left_out)
        cameras, images = completed_assets(complete_views(stream, cached, self.virtual_cameras[[number]]))
        return CompletedImage(cameras[0] | {"number": len(cached.frame.cameras) + number}, images[0])

    def _stream_of(self, model: str | None, without: tuple[str, ...]) -> Stream:
        """The stream of a model, None for the renderer's own, that uses all but some cameras."""
        assert self._stream is not None, "there is a rig"
        if model is None and not without:
            return self._stream
        key = (model, without)
        config = replace(self._config, memory_mb=VARIANT_MB)
        if key not in self._variants:
            inpainter = self._inpainter
            errors = self._error_model
            if model is not None:
                if model not in self._models:
                    self._models[model] = load_inpainter(model, self._device, self._precision)
                inpainter = self._models[model]
                errors = errors if errors is not None else self._inpainter
                # None: the error rule that the model is made for
                config = replace(config, render=replace(config.render, error_rule=None))
            self._variants[key] = Stream(inpainter, config, self._stream.bounds, errors)
        self._variants.move_to_end(key)
        while len(self._variants) > MAX_VARIANTS:
            self._variants.popitem(last=False)
        return self._variants[key]

    def _complete_by(
        self,
        model: str,
        cached: CachedFrame,
        camera: Cameras,
        without: tuple[str, ...],
        quality: RenderQuality,
    ) -> CompletedView:
        """The view that another model completes, with the same geometry."""
        stream = self._stream_of(model, without)
        stream.adopt(cached)
        return stream.view(camera, None, cached.frame.time, replace(quality, mend=True)).completed

    def _true_frame(self, index: int, name: str) -> MultiViewFrame:
        """A camera's own image; RequestError if the frame has no such camera."""
        frame = self._read(index)
        if name not in frame.cameras.names:
            raise RequestError(
                f"expected a camera of this frame, one of {', '.join(frame.cameras.names)[:200]}, got '{name[:40]}'"
            )
        return frame.select([name])

    def _score(
        self, completed: CompletedView, truth: MultiViewFrame, background: Background
    ) -> tuple[float | None, Tensor]:
        """PSNR inside the true mask on a background, and each pixel's largest error."""
        assert truth.mask is not None, "frames with geometry have masks"
        true = camera_image(truth, background)
        seen = composite(background, completed.rgb, completed.opacity)
        errors = (seen - true).abs().amax(0)
        psnr_db = psnr(seen, true, truth.mask[0] > FOREGROUND)
        return psnr_db, torch.stack([errors, errors, errors, torch.ones_like(errors)])

    def _render_proxy(self, cached: CachedFrame, camera: Cameras, modes: frozenset[str]) -> dict[str, Tensor]:
        """Images of the proxy; the vertex colours are computed once per frame."""
        proxy = cached.proxy
        images = {}
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        if "hull" in modes:
            images["hull"] = shaded_hull(proxy, camera)
        if "points" in modes:
            if self._coloured is None or self._coloured[0] is not proxy:
                views = cached.context(cached.frame.cameras.names)
                assert views is not None, "a frame with a hull has cameras"
                self._coloured = proxy, vertex_colours(proxy, views)
            images["points"] = hull_points(proxy, self._coloured[1], camera)
        return images

    def _read(self, index: int) -> MultiViewFrame:
        frame = self._source.read(index)
        if frame is None:
            raise FrameNotReadyError
        return frame.to(self._device)

    def _add_frame(
        self, stream: Stream, index: int, without: tuple[str, ...] = (), frame: MultiViewFrame | None = None
    ) -> CachedFrame:
        """Add a frame to the stream, with everything that another process has computed for it."""
        shared = None if without else self._source.read_cached(index)
        if shared is None:
            read = self._read(index) if frame is None else frame.to(self._device)
            return stream.add_frame(read.without(without) if without else read)
        assert isinstance(shared.proxy, GeometryProxy), "shared frames have hulls"
        if self._device == "cpu":
            return stream.adopt(shared)
        # on a GPU, camera images are encoded when they are used
        return stream.add_frame(shared.frame.to(self._device), shared.proxy.to(self._device))

    def _view(
        self, stream: Stream, camera: Cameras, viewer: State, index: int, quality: RenderQuality
    ) -> StreamView:
        """Render and complete one view; if the model fails, the view keeps its holes."""
        if not quality.mend:
            return stream.view(camera, viewer, index, quality)
        try:
            view = stream.view(camera, viewer, index, quality)
            self.model_error = None
        except CancelledError:
            raise
        except Exception as error:
            view = stream.view(camera, viewer, index, replace(quality, mend=False))
            self.model_error = f"{type(error).__name__}: {error}"[:400]
        return view
