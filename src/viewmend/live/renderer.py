"""Renders requested views from a frame source, without threads and sockets."""

import secrets
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

from jaxtyping import Float
from torch import Tensor

from viewmend.frame_cache import CachedFrame, cache_frame
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.live.assets import FrameAssets, make_assets
from viewmend.live.budget import ladder_for
from viewmend.live.frame_source import FrameSource, RigInfo
from viewmend.live.poses import HomeView, bounds_json, cameras_json, home_view, view_camera
from viewmend.live.protocol import BLACK, WHITE, Camera
from viewmend.models.base import Inpainter, RenderQuality, State
from viewmend.rendering.proxy_views import hull_points, shaded_hull, vertex_colours
from viewmend.stream import Stream, StreamConfig, StreamView
from viewmend.types import CompletedView, MultiViewFrame
from viewmend.utils.cancellation import CancelledError
from viewmend.utils.timing import StageTimes

WARM_UP_PX = 64


@dataclass(frozen=True)
class RenderRequest:
    """One view to render."""

    time: int
    """Index of the frame."""
    cameras: tuple[Cameras, ...]
    """One per eye."""
    quality: RenderQuality
    error_rule: str | None = None
    """None for the renderer's own."""
    hull_modes: frozenset[str] = frozenset()
    """Images of the geometry proxy to render as well."""


@dataclass(frozen=True)
class RenderResult:
    """The views of one request."""

    time: int
    completed: tuple[CompletedView, ...]
    """One view per eye."""
    viewer: State
    """For the viewer's next request."""
    times: StageTimes
    """Times of all eyes together; geometry and context are 0 if an earlier view has computed them."""
    background: str = BLACK
    """Default background, as hexadecimal RGB: the model's own."""
    hulls: tuple[Mapping[str, Float[Tensor, "4 height width"]], ...] = ()
    """Images of the proxy by mode, one mapping per eye: RGB in [0, 1] and coverage."""

    @property
    def eyes(self) -> Iterator[tuple[CompletedView, Mapping[str, Tensor]]]:
        """The view of each eye with its images of the proxy."""
        return zip(self.completed, self.hulls or repeat({}), strict=False)


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
    ) -> None:
        """Set up; `error_model` as in `Stream`, and whether pages draw moving views by themselves."""
        self._source = source
        self._inpainter, self._error_model = inpainter, error_model
        self._config = config or StreamConfig()
        self.ladder = ladder_for(inpainter)
        self._device = device
        self._draws_in_page = draws_in_page
        self._rig: RigInfo | None = None
        self._stream: Stream | None = None
        self.home: HomeView | None = None
        """The initial view; None before the first frame."""
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
        cameras = cached.frame.cameras
        home = home_view(cameras, center, rig.up)
        warm_up = view_camera(Camera(azimuth=home.azimuth), home, (WARM_UP_PX, WARM_UP_PX)).to(self._device)
        self._view(stream, warm_up, stream.viewer(), index, RenderQuality())
        rig_json = {"name": rig.name, "cameras": cameras_json(cameras), "bounds": bounds_json(bounds or proxy.bounds)}
        self.assets_version = secrets.token_hex(4)
        rig_json["assets"] = self.assets_version if self._draws_in_page else None
        self.rig_json = rig_json | home.as_json() | {"fps": self._source.span.fps or None}
        self._rig, self._stream, self.home = rig, stream, home
        return True

    def render(self, request: RenderRequest, viewer: State | None) -> RenderResult:
        """Render the views of all eyes, from one viewer's state.

        Raises:
            FrameNotReadyError: the frame has not been read yet.
            ValueError: the frame has no geometry.
        """
        if self._stream is None:
            raise FrameNotReadyError
        cached = self._add_frame(self._stream, request.time)
        before = viewer or self._stream.viewer()
        stream = self._stream
        if request.error_rule is not None:
            stream = stream.with_render_config(replace(stream.config.render, error_rule=request.error_rule))
        cameras = [camera.to(self._device) for camera in request.cameras]
        views = [self._view(stream, camera, before, request.time, request.quality) for camera in cameras]
        start = time.perf_counter()
        hulls = tuple(self._render_proxy(cached, camera, request.hull_modes) for camera in cameras)
        times = sum((v.times for v in views), StageTimes(rendering=1000 * (time.perf_counter() - start)))
        completed = tuple(view.completed for view in views)
        return RenderResult(request.time, completed, views[0].viewer, times, self.background, hulls)

    def make_assets(self, frame: MultiViewFrame) -> FrameAssets:
        """What a page needs to draw views of a frame; callable from any thread.

        Raises:
            ValueError: the frame has no geometry.
        """
        return make_assets(frame, self.geometry(frame), self._config.render)

    def geometry(self, frame: MultiViewFrame) -> GeometryProxy:
        """The proxy of a frame, on the CPU; callable from any thread.

        Raises:
            ValueError: the frame has no geometry, or no rig has been prepared yet.
        """
        shared = self._source.read_cached(frame.time)
        if shared is not None and isinstance(shared.proxy, GeometryProxy):
            return shared.proxy.to("cpu")
        stream = self._stream
        if stream is None:
            raise ValueError("expected a rig, got none yet; see /health")
        try:
            cached = stream.cached_frame(frame.time)
        except ValueError:  # not shown by the server so far: carved without keeping it
            cached = cache_frame(frame.to(self._device), stream.bounds, stream.config.hull)
        proxy = cached.proxy
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        return proxy.to("cpu")

    def _render_proxy(self, cached: CachedFrame, camera: Cameras, modes: frozenset[str]) -> dict[str, Tensor]:
        """Images of the proxy; the vertex colours are computed once per frame."""
        proxy, images = cached.proxy, {}
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

    def _add_frame(self, stream: Stream, index: int) -> CachedFrame:
        """Add a frame to the stream, with everything that another process has computed for it."""
        shared = self._source.read_cached(index)
        if shared is None:
            return stream.add_frame(self._read(index))
        assert isinstance(shared.proxy, GeometryProxy), "shared frames have hulls"
        cached = stream.add_frame(shared.frame.to(self._device), shared.proxy.to(self._device))
        if self._device == "cpu":  # on a GPU, camera images are encoded when they are used
            cached.depths, cached.encoded = shared.depths | cached.depths, shared.encoded | cached.encoded
        return cached

    def _view(self, stream: Stream, camera: Cameras, viewer: State, index: int, quality: RenderQuality) -> StreamView:
        """One view; with its holes if the model fails."""
        try:
            view = stream.view(camera, viewer, index, quality)
        except CancelledError:
            raise
        except Exception as error:
            if not quality.mend:
                raise
            view = stream.view(camera, viewer, index, replace(quality, mend=False))
            self.model_error = f"{type(error).__name__}: {error}"[:400]
        else:
            if quality.mend:
                self.model_error = None
        return view
