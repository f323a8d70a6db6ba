"""Requests become views: the stream, its rig, and what went wrong, without threads and sockets."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import repeat
from typing import Any

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.protocol import RenderQuality, State, ViewInpainter, own_error_rule, shown_upon
from viewmend.live.budget import ladder_for
from viewmend.live.frames import FrameSupply, Rig
from viewmend.live.poses import RigFrame, bounds_json, cameras_json, rig_frame, view_camera
from viewmend.live.protocol import BLACK, WHITE, Camera
from viewmend.observation import Observation
from viewmend.rendering.hull_views import hull_points, shaded_hull
from viewmend.rendering.vertex_colours import vertex_colours
from viewmend.rig_fit import fitted_to_rig
from viewmend.stream import Stream, StreamConfig, StreamView
from viewmend.timing import StageTimes
from viewmend.views import CompletedView, MultiViewFrame

WARM_UP_PX = 64


@dataclass(frozen=True)
class RenderRequest:
    """One view to render: of which time, from where (one camera each eye), how well, what of it is mended."""

    time: int
    cameras: tuple[Cameras, ...]
    quality: RenderQuality
    error_rule: str | None = None
    """None for that of the renderer."""
    hull_modes: frozenset[str] = frozenset()
    """Pictures of the geometry proxy that are wanted, too."""


@dataclass(frozen=True)
class RenderResult:
    """The views of one request."""

    time: int
    completed: tuple[CompletedView, ...]
    viewer: State
    """What to ask for the next views with."""
    times: StageTimes
    """Times of all eyes; geometry and context are 0 where another viewer has paid for them."""
    background: str = BLACK
    """What the pictures lie upon where nobody asks for another: what the model paints upon, hexadecimal RGB."""
    hulls: tuple[Mapping[str, Float[Tensor, "4 height width"]], ...] = ()
    """Pictures of the proxy by mode, for each eye: RGB in [0, 1] and, last, how much it covers."""

    @property
    def eyes(self) -> Iterator[tuple[CompletedView, Mapping[str, Tensor]]]:
        """Each eye's view, with its pictures of the proxy."""
        return zip(self.completed, self.hulls or repeat({}), strict=False)


class FrameNotReadyError(Exception):
    """The frame is on its way."""


class Renderer:
    """Renders requests one after the other. One thread only."""

    def __init__(
        self,
        supply: FrameSupply,
        inpainter: ViewInpainter,
        config: StreamConfig | None = None,
        device: str = "cpu",
    ) -> None:
        self._supply = supply
        self._inpainter = inpainter
        self._config = config or StreamConfig()
        self.ladder = ladder_for(inpainter)
        """What views may be made with."""
        self._device = device
        self._rig: Rig | None = None
        self._stream: Stream | None = None
        self.frame: RigFrame | None = None
        """The subject's place; None until the first frame was seen."""
        self.rig_json: dict[str, Any] | None = None
        """The message `rig`."""
        self._coloured: tuple[GeometryProxy, Tensor] | None = None
        """The last proxy of which points were wanted, and its vertices' colours."""
        self.model_error: str | None = None
        """Why views are shown with their holes, if they are."""

    @property
    def error_rule(self) -> str:
        """The rule of views that are asked for without one."""
        return self._config.render.error_rule or own_error_rule(self._inpainter)

    @property
    def background(self) -> str:
        """What the model paints upon, hexadecimal RGB."""
        return WHITE if shown_upon(self._inpainter) == "white" else BLACK

    def is_of(self, rig: Rig | None) -> bool:
        """Whether it renders this rig."""
        return rig is not None and rig is self._rig

    def prepare(self, time: int) -> bool:
        """See a rig's first frame: find the subject, and compile what is compiled at first use.

        False where nothing was to be done.

        Raises:
            FrameNotReadyError: the frame is on its way.
            ValueError: no geometry can be made of it.
        """
        rig = self._supply.rig
        if rig is None or self.is_of(rig):
            return False
        bounds = rig.bounds
        stream = Stream(self._fitted(self._read(time), bounds), replace(self._config, fit_rig=False), bounds)
        observation = self._observed(stream, time)
        proxy = observation.proxy
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        center = proxy.mesh.vertices.mean(0) if len(proxy.mesh.vertices) else proxy.bounds.center
        cameras = observation.frame.cameras
        frame = rig_frame(cameras, center, rig.up)
        warm = view_camera(Camera(azimuth=frame.azimuth), frame, (WARM_UP_PX, WARM_UP_PX)).to(self._device)
        self._view(stream, warm, stream.viewer(), time, RenderQuality())
        rig_json = {"name": rig.name, "cameras": cameras_json(cameras), "bounds": bounds_json(bounds or proxy.bounds)}
        self.rig_json = rig_json | frame.as_json() | {"fps": self._supply.span.fps or None}
        self._rig, self._stream, self.frame = rig, stream, frame
        return True

    def render(self, request: RenderRequest, viewer: State | None) -> RenderResult:
        """The views of all eyes, from one state.

        Raises:
            FrameNotReadyError: the frame is on its way.
            ValueError: no geometry can be made of the frame.
        """
        if self._stream is None:
            raise FrameNotReadyError
        observation = self._observed(self._stream, request.time)
        before = viewer or self._stream.viewer()
        stream = self._stream
        if request.error_rule is not None:
            stream = stream.rendered_by(replace(stream.config.render, error_rule=request.error_rule))
        views = [self._view(stream, c.to(self._device), before, request.time, request.quality) for c in request.cameras]
        start = time.perf_counter()
        hulls = tuple(self._hulls(observation, c.to(self._device), request.hull_modes) for c in request.cameras)
        drawn = StageTimes(rendering=1000 * (time.perf_counter() - start))
        completed, times = tuple(view.completed for view in views), sum((v.times for v in views), drawn)
        return RenderResult(request.time, completed, views[0].viewer, times, self.background, hulls)

    def _hulls(self, observation: Observation, camera: Cameras, modes: frozenset[str]) -> dict[str, Tensor]:
        """Pictures of the proxy from this camera; its vertices' colours are found once for each time."""
        proxy, pictures = observation.proxy, {}
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        if "hull" in modes:
            pictures["hull"] = shaded_hull(proxy, camera)
        if "points" in modes:
            if self._coloured is None or self._coloured[0] is not proxy:
                seen = observation.context(observation.frame.cameras.names)
                assert seen is not None, "a frame without cameras has no hull"
                self._coloured = proxy, vertex_colours(proxy, seen)
            pictures["points"] = hull_points(proxy, self._coloured[1], camera)
        return pictures

    def _read(self, at: int) -> MultiViewFrame:
        frame = self._supply.read(at)
        if frame is None:
            raise FrameNotReadyError
        return frame.to(self._device)

    def _fitted(self, frame: MultiViewFrame, bounds: Bounds | None) -> ViewInpainter:
        """The inpainter, fitted to the rig by its first frame."""
        if not self._config.fit_rig:
            return self._inpainter
        return fitted_to_rig(self._inpainter, frame, bounds, self._config.hull, self._config.render)

    def _observed(self, stream: Stream, at: int) -> Observation:
        """The time, taken in by the stream, with all that the supply has made of it already."""
        made = self._supply.made(at)
        if made is None:
            return stream.push(self._read(at))
        assert isinstance(made.proxy, GeometryProxy), "supplies carve hulls"
        observation = stream.push(made.frame.to(self._device), made.proxy.to(self._device))
        if self._device == "cpu":  # elsewhere cameras are encoded as they are looked at
            observation.depths, observation.encoded = (
                made.depths | observation.depths,
                made.encoded | observation.encoded,
            )
        return observation

    def _view(self, stream: Stream, camera: Cameras, viewer: State, at: int, quality: RenderQuality) -> StreamView:
        """The view; with its holes where the model fails."""
        try:
            view = stream.view(camera, viewer, at, quality)
        except Exception as error:
            if not quality.mend:
                raise
            view = stream.view(camera, viewer, at, replace(quality, mend=False))
            self.model_error = f"{type(error).__name__}: {error}"[:400]
        else:
            if quality.mend:
                self.model_error = None
        return view
