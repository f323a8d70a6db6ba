"""From asks to views: the stream, its rig, and what went wrong, without threads and sockets."""

import time
from dataclasses import dataclass, replace
from typing import Any

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.inpainting.inpainter import Inpainter
from viewmend.inpainting.protocol import ViewInpainter
from viewmend.live.frames import FrameSupply, Rig
from viewmend.live.poses import RigFrame, bounds_json, cameras_json, rig_frame, view_camera
from viewmend.live.protocol import Camera
from viewmend.live.window import window_of
from viewmend.pipeline import Observation, PipelineConfig
from viewmend.stream import RenderQuality, Stream, StreamView, Viewer
from viewmend.views import CompletedView

WARM_PX = 64


@dataclass(frozen=True)
class RenderRequest:
    """One view to render: of which time, from where (one camera each eye), how well."""

    time: int
    cameras: tuple[Cameras, ...]
    effort: RenderQuality


@dataclass(frozen=True)
class RenderResult:
    """What came of it."""

    time: int
    completed: tuple[CompletedView, ...]
    viewer: Viewer
    geometry_ms: float
    """0 where another viewer has paid for it."""
    context_ms: float
    """Likewise: encoding camera images."""
    rendering_ms: float
    inpainting_ms: float


class NotThereError(Exception):
    """The frame is on its way."""


class Renderer:
    """Renders asks one after the other. One thread only."""

    def __init__(
        self,
        supply: FrameSupply,
        inpainter: ViewInpainter,
        config: PipelineConfig | None = None,
        device: str = "cpu",
        memory_mb: float = 1500.0,
    ) -> None:
        self._supply = supply
        self._inpainter = inpainter
        self._config = config or PipelineConfig()
        self._device = device
        self._memory_mb = memory_mb
        self._rig: Rig | None = None
        self._stream: Stream | None = None
        self.frame: RigFrame | None = None
        """The subject's place; None until the first frame was seen."""
        self.rig_json: dict[str, Any] | None = None
        """The message `rig`."""
        self.model_error: str | None = None
        """Why views are shown with their holes, if they are."""

    def is_of(self, rig: Rig | None) -> bool:
        """Whether it renders this rig."""
        return rig is not None and rig is self._rig

    def prepare(self, time: int) -> bool:
        """See a rig's first frame: find the subject, and compile what is compiled at first use.

        False where nothing was to be done.

        Raises:
            NotThereError: the frame is on its way.
            ValueError: no geometry can be made of it.
        """
        rig = self._supply.rig
        if rig is None or self.is_of(rig):
            return False
        bounds = rig.bounds
        stream = Stream(self._inpainter, self._config, bounds, self._memory_mb)
        observation = self._observe(stream, time)[0]
        proxy = observation.proxy
        assert isinstance(proxy, GeometryProxy), "streams carve hulls"
        center = proxy.mesh.vertices.mean(0) if len(proxy.mesh.vertices) else proxy.bounds.center
        cameras = observation.frame.cameras
        frame = rig_frame(cameras, center, rig.up)
        warm = view_camera(Camera(azimuth=frame.azimuth), frame, (WARM_PX, WARM_PX)).to(self._device)
        self._view(stream, warm, stream.viewer(), time, RenderQuality())
        rig_json = {"name": rig.name, "cameras": cameras_json(cameras), "bounds": bounds_json(bounds or proxy.bounds)}
        self.rig_json = rig_json | frame.as_json() | {"fps": self._supply.span.fps or None}
        self._rig, self._stream, self.frame = rig, stream, frame
        return True

    def render(self, ask: RenderRequest, viewer: Viewer | None) -> RenderResult:
        """The views of all eyes, from one state.

        Raises:
            NotThereError: the frame is on its way.
            ValueError: no geometry can be made of the frame.
        """
        if self._stream is None:
            raise NotThereError
        _, geometry_ms = self._observe(self._stream, ask.time)
        before = viewer or self._stream.viewer()
        views = [self._view(self._stream, c.to(self._device), before, ask.time, ask.effort) for c in ask.cameras]
        return RenderResult(
            ask.time,
            tuple(view.completed for view in views),
            views[0].viewer,
            geometry_ms,
            sum(view.encoding_ms for view in views),
            sum(view.stage_ms.rendering for view in views),
            sum(view.stage_ms.inpainting for view in views),
        )

    def _observe(self, stream: Stream, at: int) -> tuple[Observation, float]:
        """The time's observation, and the milliseconds that are paid for it now."""
        frame = self._supply.read(at)
        if frame is None:
            raise NotThereError
        start = time.perf_counter()
        known = at in stream.times
        observation = stream.push(frame.to(self._device))
        return observation, 0.0 if known else 1000 * (time.perf_counter() - start)

    def _view(self, stream: Stream, camera: Cameras, viewer: Viewer, at: int, effort: RenderQuality) -> StreamView:
        """The view; with its holes where the model fails."""
        try:
            view = self._windowed(stream, camera, viewer, at, effort)
        except Exception as error:
            if not effort.mend:
                raise
            view = self._windowed(stream, camera, viewer, at, replace(effort, mend=False))
            self.model_error = f"{type(error).__name__}: {error}"[:400]
        else:
            if effort.mend:
                self.model_error = None
        return view

    def _windowed(self, stream: Stream, camera: Cameras, viewer: Viewer, at: int, effort: RenderQuality) -> StreamView:
        """The view, of which only the subject's surroundings are worked on where that changes nothing.

        With context it would: patches lie on a grid from the view's corner.
        """
        fills = isinstance(self._inpainter, Inpainter) and self._inpainter.config.prefill
        proxy = stream.observation(at).proxy
        local = not effort.mend or (fills and effort.context_times == 0)
        window = window_of(proxy.mesh.vertices, camera) if local and isinstance(proxy, GeometryProxy) else None
        if window is None:
            return stream.view(camera, viewer, at, effort)
        view = stream.view(window.of(camera), viewer, at, effort)
        return replace(view, completed=window.widened(view.completed, camera))
