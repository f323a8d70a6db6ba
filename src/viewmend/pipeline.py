"""The whole system on one screen: camera images -> proxy -> incomplete view -> completed view, timed by stage."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.inpainting.protocol import State, ViewInpainter
from viewmend.own_pages import to_own_pages
from viewmend.rendering.view import RenderConfig, render_view
from viewmend.views import CompletedView, ContextViews, IncompleteView, MultiViewFrame


@dataclass(frozen=True, kw_only=True)
class PipelineConfig:
    """The system without its inpainter."""

    hull: HullConfig = field(default_factory=HullConfig)
    """How the geometry proxy is carved."""
    render: RenderConfig = field(default_factory=RenderConfig)
    """How views are rendered from the cameras."""
    history: int = 33
    """How many past frames a stream keeps for cameras that it chooses anew: k_w n_w + n_c, as far as the inpainters'
    windows reach back on either grid."""


@runtime_checkable
class DepthProvider(Protocol):
    """All that an inpainter asks of G[t]; `GeometryProxy` is one, a renderer's own geometry may be another."""

    def depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """z-depth of the surface in each camera, metres; 0 where there is none."""
        ...


@dataclass(frozen=True)
class Observation:
    """One time of a stream, ready to be looked at; all viewers of that time share it."""

    frame: MultiViewFrame
    """What the cameras saw, with masks."""
    proxy: GeometryProxy | DepthProvider
    """G[t]; rendering needs a `GeometryProxy`, filling does not."""
    geometry_ms: float
    """What the proxy took."""
    _depths: dict[str, Float[Tensor, "height width"]] = field(default_factory=dict, repr=False, compare=False)

    def with_own_cache(self) -> "Observation":
        """The same time, remembered on its own from here on: what one viewer asks for saves no other any time."""
        return replace(self, _depths=dict(self._depths))

    def depth(self, names: Sequence[str]) -> Float[Tensor, "view height width"]:
        """The proxy's z-depth in these cameras, metres, 0 where there is none; each is rendered once only."""
        new = [name for name in names if name not in self._depths]
        if new:
            rendered = self.proxy.depth(self.frame.cameras.select(new))
            right, below = (self.frame.rgb.shape[i] - rendered.shape[i - 1] for i in (3, 2))
            if right or below:
                rendered = torch.nn.functional.pad(rendered, (0, right, 0, below))  # padded as the images are
            self._depths.update(zip(new, to_own_pages(rendered), strict=True))
        width, height = self.frame.cameras.select(names).max_size_px
        return torch.stack([self._depths[name][:height, :width] for name in names])  # as `frame.select` cuts images

    def known_depths(self) -> tuple[Float[Tensor, "height width"], ...]:
        """Those that were rendered so far."""
        return tuple(self._depths.values())

    def context(self, names: Sequence[str]) -> ContextViews | None:
        """What an inpainter may see of these cameras; those without a frame are left out, None if all are."""
        there = [name for name in names if name in self.frame.cameras.names]
        return ContextViews(self.frame.select(there), self.depth(there)) if there else None


@dataclass(frozen=True)
class StreamState:
    """What one viewer's stream carries from one view to the next: a value, never changed in place."""

    inpainter: State
    history: tuple[Observation, ...] = ()
    """The last observations, at most `PipelineConfig.history` frames old."""


@dataclass(frozen=True)
class StageMs:
    """Milliseconds of each stage, the device's work included."""

    geometry: float
    """Masks to proxy; shared by all viewers of the frame."""
    rendering: float
    """Proxy and images to the incomplete view."""
    inpainting: float
    """Incomplete to completed view."""


@dataclass(frozen=True)
class MendedView:
    """What one viewer gets for one frame."""

    completed: CompletedView
    state: StreamState
    stage_ms: StageMs


def observe(frame: MultiViewFrame, bounds: Bounds | None, config: PipelineConfig) -> Observation:
    """Reconstruct the geometry proxy of one time.

    Args:
        frame: what the cameras saw; leave a camera out of everything with `frame.without`.
        bounds: the volume that may hold the subject; None to find it from the masks.
        config: how.

    Raises:
        ValueError: the frame has no masks, no foreground, or a single camera.
    """
    if frame.mask is None:
        raise ValueError(
            "expected a capture with masks, got one without: the visual hull is carved from them; segment the "
            "foreground and name the files as each camera's 'mask'"
        )
    start = now_s(frame.rgb.device)
    proxy = to_own_pages(reconstruct(frame.mask, frame.cameras, bounds, config.hull))
    return Observation(frame, proxy, ms_since(start, frame.rgb.device))


def mend_view(
    observation: Observation,
    target: Cameras,
    state: StreamState,
    inpainter: ViewInpainter,
    config: PipelineConfig,
    exclude: Sequence[str] = (),
) -> MendedView:
    """Render one novel view and fill what is missing in it.

    Args:
        observation: the time to look at; times of one stream do not run backwards.
        target: the novel view's camera (one view), on the frame's device.
        state: of the stream; `StreamState(inpainter.initial_state())` starts one.
        inpainter: what fills the holes.
        config: the pipeline's.
        exclude: names of cameras whose images must not be used for this viewer.
    """
    view, rendering_ms = view_of(observation, target, config, exclude)
    return complete_view(view, observation, state, inpainter, config, exclude, rendering_ms)


def view_of(
    observation: Observation,
    target: Cameras,
    config: PipelineConfig,
    exclude: Sequence[str] = (),
) -> tuple[IncompleteView, float]:
    """Render one novel view: the first half of `mend_view`, and the milliseconds that it took.

    Raises:
        ValueError: the observation's geometry is not a `GeometryProxy`, or no camera is left.
    """
    if not isinstance(observation.proxy, GeometryProxy):
        got = type(observation.proxy).__name__
        raise ValueError(f"expected a GeometryProxy to render, got {got}; render the view yourself and fill it then")
    frame, device = observation.frame, observation.frame.rgb.device
    start = now_s(device)
    view = render_view(frame, observation.proxy, target, config.render, exclude, source_depth=observation.depth)
    return view, ms_since(start, device)


def complete_view(
    view: IncompleteView,
    observation: Observation,
    state: StreamState,
    inpainter: ViewInpainter,
    config: PipelineConfig,
    exclude: Sequence[str] = (),
    rendering_ms: float = 0.0,
) -> MendedView:
    """Fill what is missing in a view that `observation` was rendered to: the second half of `mend_view`.

    Comparisons call it, so that all inpainters fill the very same view. `rendering_ms` is what that took.
    """
    frame, device = observation.frame, observation.frame.rgb.device
    oldest = frame.time - config.history
    past = tuple(o for o in state.history if oldest <= o.frame.time < frame.time)
    at = {o.frame.time: o for o in (*past, observation)}

    def source(time: int, names: tuple[str, ...]) -> ContextViews | None:
        return at[time].context([n for n in names if n not in exclude]) if time in at else None

    start = now_s(device)
    completed, inpainter_state = inpainter.step(view, source, state.inpainter)
    inpainting_ms = ms_since(start, device)

    history = (*past, observation) if config.history else ()
    stages = StageMs(observation.geometry_ms, rendering_ms, inpainting_ms)
    return MendedView(completed, StreamState(inpainter_state, history), stages)


def now_s(device: torch.device) -> float:
    """Seconds, once the device has done what was asked of it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def ms_since(start: float, device: torch.device) -> float:
    """Milliseconds since `now_s` gave `start`."""
    return 1000 * (now_s(device) - start)
