"""One time of a stream, with its geometry proxy: what does not depend on a view."""

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.chosen_views import ChosenViews
from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras
from viewmend.geometry.hull import HullConfig
from viewmend.geometry.proxy import GeometryProxy, reconstruct
from viewmend.inpainting.protocol import Memory
from viewmend.own_pages import size_bytes, to_own_pages
from viewmend.timing import ms_since, now_s
from viewmend.views import ContextViews, MultiViewFrame

WINDOW = 33
"""k_w n_w + n_c: how far back, in frames, the inpainters' windows reach."""


@runtime_checkable
class DepthProvider(Protocol):
    """All that an inpainter asks of G[t]; `GeometryProxy` is one, a renderer's own geometry may be another.

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
        """z-depth of the surface in each camera, metres; 0 where there is none."""
        ...


@dataclass
class Observation:
    """What the cameras saw at one time, and what was computed of it; all viewers of that time share it.

    Examples:
        >>> from viewmend import Stream, make_method
        >>> from viewmend.studio.stage import Studio, StudioConfig
        >>> frame = Studio(StudioConfig(cameras=4, frames=1, size_px=64)).read(0)
        >>> Stream(make_method("telea")).push(frame).depth(frame.cameras.names[:1]).shape
        torch.Size([1, 64, 64])
    """

    frame: MultiViewFrame
    proxy: GeometryProxy | DepthProvider
    """G[t]; rendering needs a `GeometryProxy`, filling does not."""
    geometry_ms: float = 0.0
    """What the proxy took, until the first view has paid for it."""
    encoded: Memory = field(default_factory=dict, repr=False)
    """What was encoded of the images, as a context provider remembers it."""
    depths: dict[str, Float[Tensor, "height width"]] = field(default_factory=dict, repr=False)
    """The proxy's depth in the cameras that were asked for, by name."""
    _counted: tuple[tuple[int, int], int] = field(default=((-1, -1), 0), repr=False, init=False)
    """How many depths and encoded entries there were when bytes were counted, and the bytes."""

    def depth(self, names: Sequence[str]) -> Float[Tensor, "view height width"]:
        """The proxy's z-depth in these cameras, metres, 0 where there is none; each is rendered once only."""
        self._render(names)
        width, height = self.frame.cameras.select(names).max_size_px
        return torch.stack([self.depths[name][:height, :width] for name in names])  # as `frame.select` cuts images

    def _render(self, names: Sequence[str]) -> None:
        """See to it that the proxy's depth in these cameras is known."""
        new = [name for name in names if name not in self.depths]
        if new:
            rendered = self.proxy.depth(self.frame.cameras.select(new))
            right, below = (self.frame.rgb.shape[i] - rendered.shape[i - 1] for i in (3, 2))
            if right or below:
                rendered = F.pad(rendered, (0, right, 0, below))  # padded as the images are
            self.depths.update(zip(new, to_own_pages(rendered), strict=True))

    def context(self, names: Sequence[str]) -> ContextViews | None:
        """What an inpainter may see of these cameras; those without a frame are left out, None if all are."""
        there = [name for name in names if name in self.frame.cameras.names]
        self._render(there)
        return ChosenViews.of(self.frame, there, self.depths) if there else None

    def pay_geometry(self) -> float:
        """The milliseconds of the proxy, for the first who asks; 0 afterwards."""
        ms, self.geometry_ms = self.geometry_ms, 0.0
        return ms

    @property
    def size(self) -> int:
        """Bytes, without what is too small to count; they are counted anew where something was added."""
        entries = len(self.depths), len(self.encoded)
        if self._counted[0] != entries:
            self._counted = (entries, self._count())
        return self._counted[1]

    def _count(self) -> int:
        made = [self.frame.rgb, self.frame.mask, *self.depths.values(), *self.encoded.values()]
        if isinstance(self.proxy, GeometryProxy):
            made += [self.proxy.mesh.vertices, self.proxy.mesh.faces, self.proxy.normals]
        return size_bytes(made)


def observe(frame: MultiViewFrame, bounds: Bounds | None, config: HullConfig) -> Observation:
    """Reconstruct the geometry proxy of one time.

    Args:
        frame: what the cameras saw; leave a camera out of everything with `frame.without`.
        bounds: the volume that may hold the subject; None to find it from the masks.
        config: how the hull is carved.

    Raises:
        ValueError: the frame has no masks, no foreground, or a single camera.
    """
    if frame.mask is None:
        raise ValueError(
            "expected a capture with masks, got one without: the visual hull is carved from them; make "
            "them with viewmend masks CAPTURE OUT --method ..., or name their files as each camera's 'mask'"
        )
    device = frame.rgb.device
    start = now_s(device)
    proxy = to_own_pages(
        reconstruct(frame.mask, frame.cameras, bounds if bounds is None else bounds.to(device), config)
    )
    return Observation(frame, proxy, ms_since(start, device))


def forget(observations: OrderedDict[int, Observation], time: int, memory_mb: float | None) -> None:
    """Drop the times looked at longest ago until the others fit; without a limit, those too far before `time`."""
    if memory_mb is None:
        for old in [other for other in observations if other < time - WINDOW]:
            del observations[old]
        return
    bytes_left = sum(observation.size for observation in observations.values())
    while bytes_left > 1e6 * memory_mb and len(observations) > 1:
        bytes_left -= observations.popitem(last=False)[1].size
