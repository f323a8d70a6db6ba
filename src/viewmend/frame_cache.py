"""One frame of a stream with its geometry proxy, and everything computed from it that does not depend on a view."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.models.base import REMEMBERED_FRAMES, Memory
from viewmend.types import ContextViews, MultiViewFrame, Silhouettes, check_range
from viewmend.utils.tensors import check_tensor, extremes, size_bytes, to_mmap
from viewmend.utils.timing import ms_since, now_s

WINDOW = REMEMBERED_FRAMES - 1
"""k_w n_w + n_c: how many frames back the shipped inpainters' temporal windows reach."""


@runtime_checkable
class DepthProvider(Protocol):
    """Geometry as inpainting needs it: depth in the cameras. `GeometryProxy` is one; so may be your own geometry.

    Examples:
        >>> import torch
        >>> from viewmend import DepthProvider
        >>> class Wall:
        ...     def depth(self, cameras):
        ...         width, height = cameras.max_size_px
        ...         return torch.full((len(cameras), height, width), 3.0)
        >>> isinstance(Wall(), DepthProvider)
        True
    """

    def depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """z-depth of the surface in each camera, float32, metres; 0 where there is none. Images may be padded."""
        ...


def check_provider(geometry: object) -> None:
    """ValueError unless this is an object with a method `depth`."""
    if isinstance(geometry, type) or not callable(getattr(geometry, "depth", None)):
        got = f"the class {geometry.__name__}" if isinstance(geometry, type) else type(geometry).__name__
        raise ValueError(
            f"expected a geometry with a method depth(cameras), got {got}; pass an object as DepthProvider describes it"
        )


@dataclass
class CachedFrame:
    """A frame, its geometry proxy, and what was computed from them; shared by all viewers.

    Examples:
        >>> from viewmend import Stream, make_method
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> Stream(make_method("telea")).add_frame(frame).depth(frame.cameras.names[:1]).shape
        torch.Size([1, 64, 64])
    """

    frame: MultiViewFrame
    proxy: GeometryProxy | DepthProvider
    """G[t]. Rendering needs a `GeometryProxy`; inpainting needs only a `DepthProvider`."""
    geometry_ms: float = 0.0
    """Milliseconds spent on the proxy; charged to the first view of this frame, then 0."""
    encoded: Memory = field(default_factory=dict, repr=False)
    """The frame's memory, as `ContextProvider` uses it."""
    depths: dict[str, Float[Tensor, "height width"]] = field(default_factory=dict, repr=False)
    """The proxy's depth by camera name, for cameras that were requested so far."""
    _counted: tuple[tuple[int, int], int] = field(default=((-1, -1), 0), repr=False, init=False)
    """Numbers of depths and encoded entries when `size` was last computed, and its value."""

    def depth(self, names: Sequence[str]) -> Float[Tensor, "view height width"]:
        """The proxy's z-depth in these cameras, metres, 0 where there is none; each is rendered only once."""
        self._render(names)
        width, height = self.frame.cameras.on_host.select(names).max_size_px
        # Cut as `frame.select` cuts images
        return torch.stack([self.depths[name][:height, :width] for name in names])

    def _render(self, names: Sequence[str]) -> None:
        """Render the proxy's depth in those of these cameras where it is not known yet."""
        new = [name for name in names if name not in self.depths]
        if new:
            rendered = self._checked_depth(self.frame.cameras.select(new))
            right = self.frame.rgb.shape[3] - rendered.shape[2]
            below = self.frame.rgb.shape[2] - rendered.shape[1]
            if right or below:
                rendered = F.pad(rendered, (0, right, 0, below))  # padded as the images are
            self.depths.update(zip(new, to_mmap(rendered), strict=True))

    def _checked_depth(self, cameras: Cameras) -> Float[Tensor, "view height width"]:
        """The proxy's depth; ValueError if a provider's is not what `DepthProvider` says."""
        depth = self.proxy.depth(cameras)
        if isinstance(self.proxy, GeometryProxy):
            return depth
        name = f"the depth of {type(self.proxy).__name__}"
        width, height = cameras.max_size_px
        check_tensor(
            name,
            depth,
            (torch.float32,),
            (len(cameras), height, width),
            convert="convert it with .float(), in metres",
            arrange="give one image per camera, as large as its size_px",
            padded=True,
        )
        check_range(name, *extremes([depth])[0], math.inf)
        return depth

    def context(self, names: Sequence[str]) -> ContextViews | None:
        """These cameras with the proxy's depth, without copying; names that are not in the frame are left out.

        None if no name is in the frame.
        """
        present = [name for name in names if name in self.frame.cameras.names]
        self._render(present)
        if not present:
            return None
        return ContextViews.of_depths(self.frame.select(present), [self.depths[name] for name in present])

    def pop_geometry_ms(self) -> float:
        """`geometry_ms`, which is 0 afterwards."""
        ms = self.geometry_ms
        self.geometry_ms = 0.0
        return ms

    @property
    def size(self) -> int:
        """Bytes of all large tensors; recomputed only if something was added."""
        entries = (len(self.depths), len(self.encoded))
        if self._counted[0] != entries:
            made = [self.frame.rgb, self.frame.mask, *self.depths.values(), *self.encoded.values()]
            if isinstance(self.proxy, GeometryProxy):
                made += [self.proxy.mesh.vertices, self.proxy.mesh.faces, self.proxy.normals]
            self._counted = (entries, size_bytes(made))
        return self._counted[1]


def cache_frame(
    frame: MultiViewFrame, bounds: Bounds | None, config: HullConfig, carving: Silhouettes | None = None
) -> CachedFrame:
    """Reconstruct the geometry proxy of one frame, within `bounds` or, without these, where its masks are.

    The masks of more cameras, `carving`, carve the hull, although the images of these are not used.

    Raises:
        ValueError: the frame has no masks, a single camera, or cameras that look away from each other.
    """
    device = frame.rgb.device
    start = now_s(device)
    masks = all_masks(frame, carving)
    proxy = to_mmap(reconstruct(masks.mask, masks.cameras, bounds, config))
    return CachedFrame(frame, proxy, ms_since(start, device))


def all_masks(frame: MultiViewFrame, carving: Silhouettes | None = None) -> Silhouettes:
    """The masks that carve the hull: the frame's and those of more cameras, padded to the size of the largest.

    Raises:
        ValueError: the frame has no masks.
    """
    if frame.mask is None:
        raise ValueError(
            "expected a capture with masks, got one without: the visual hull is computed from them; make "
            "them with viewmend masks CAPTURE OUT, or name their files as each camera's 'mask'"
        )
    return Silhouettes(frame.mask, frame.cameras).joined(carving)


def evict(
    frames: OrderedDict[int, CachedFrame], time: int, memory_mb: float | None, window_frames: int = 0
) -> list[CachedFrame]:
    """Drop frames until the others fit into `memory_mb`; the frame at `time` stays.

    First go the least recently used of those that the window at `time`, which reaches back
    `window_frames`, does not need; then the oldest of the window. Without a limit, all that are
    more than `WINDOW` frames before or after `time` go, or more than `window_frames` if it is longer.

    Returns:
        What was dropped of the window.
    """
    if memory_mb is None:
        reach = max(WINDOW, window_frames)
        for far in [other for other in frames if abs(other - time) > reach]:
            del frames[far]
        return []
    window = range(time - window_frames, time)
    outside = [other for other in frames if other != time and other not in window]
    inside = sorted(other for other in frames if other in window)
    bytes_left = sum(cached.size for cached in frames.values())
    dropped = []
    for old in outside + inside:
        if bytes_left <= 1e6 * memory_mb:
            break
        cached = frames.pop(old)
        bytes_left -= cached.size
        if old in window:
            dropped.append(cached)
    return dropped
