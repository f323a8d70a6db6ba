"""What several cameras say of the colour of the same surface points: by it colours are matched and cameras judged."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from viewmend.geometry.cameras import project
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.sampling import in_view, sample_bilinear
from viewmend.views import MultiViewFrame

POINTS = 6000
"""Surface points at most."""
LEAST_COSINE = 0.35
"""Between the surface's normal and the direction to a camera: more oblique surface is not looked at."""
LEAST_MASK = 0.99
"""A point nearer to a camera's outline than this mask value is not looked at."""
BIAS = 0.01
"""A point is hidden if it lies this much behind the proxy's depth, as a share of the subject's size."""
LEAST_SHARED = 80
"""Points that two cameras must both see to be compared."""


@dataclass(frozen=True)
class SurfaceColours:
    """Colours of surface points in every camera."""

    rgb: Float[Tensor, "view point 3"]
    """In [0, 1], as the images store them."""
    seen: Bool[Tensor, "view point"]
    """Where a camera sees the point well."""


@dataclass(frozen=True)
class Surface:
    """Surface points in every camera."""

    uv_px: Float[Tensor, "view point 2"]
    seen: Bool[Tensor, "view point"]
    """Where a camera sees the point well, whatever its image shows."""

    def colours(self, rgb: UInt8[Tensor, "view 3 height width"]) -> SurfaceColours:
        """What images of these cameras show of the points."""
        return SurfaceColours(sample_bilinear(rgb.float() / 255, self.uv_px, "border"), self.seen)


def surface_colours(frame: MultiViewFrame, proxy: GeometryProxy) -> SurfaceColours:
    """Sample the proxy's surface in all cameras; the frame has masks."""
    return surface_of(frame, proxy).colours(frame.rgb)


def surface_of(frame: MultiViewFrame, proxy: GeometryProxy) -> Surface:
    """Where the proxy's surface is in all cameras; the frame has masks."""
    assert frame.mask is not None, "there is no proxy without masks"
    step = max(1, len(proxy.mesh.vertices) // POINTS)
    points, normals = proxy.mesh.vertices[::step], proxy.normals[::step]
    uv, z = project(points, frame.cameras)
    depth = proxy.depth(frame.cameras)
    height, width = depth.shape[1:]
    column, row = uv.floor().long().unbind(-1)
    view = torch.arange(len(uv), device=uv.device)[:, None]
    nearest = depth[view, row.clamp(0, height - 1), column.clamp(0, width - 1)]
    opaque = sample_bilinear(frame.mask[:, None].float() / 255, uv, "border")[..., 0]
    away = torch.nn.functional.normalize(frame.cameras.centers[:, None] - points, dim=-1)
    seen = in_view(uv, z, frame.cameras) & (nearest > 0) & (z <= nearest + BIAS * float(proxy.bounds.size_m.norm()))
    seen &= ((normals * away).sum(-1) > LEAST_COSINE) & (opaque > LEAST_MASK)
    return Surface(uv, seen)


def nearest_agreement(
    colours: SurfaceColours, others: SurfaceColours
) -> tuple[Float[Tensor, "view"], Float[Tensor, "view"]]:
    """How each camera's colours agree with those of the other camera that they agree with best.

    The least root mean square distance of RGB, and the highest correlation, over the points that two cameras see; NaN
    where no other shares enough of them. One camera that is wrong is far from all others, and none of these is.
    """
    nearest = [
        agreement(own, both, others, view)
        for view, (own, both) in enumerate(zip(colours.rgb, colours.seen[:, None] & others.seen, strict=True))
    ]
    distance, correlation = torch.tensor(nearest, device=colours.rgb.device).unbind(1)
    return distance, correlation


def agreement(
    own: Float[Tensor, "point 3"], shared: Bool[Tensor, "view point"], others: SurfaceColours, view: int
) -> tuple[float, float]:
    """`nearest_agreement` of one camera, `view`, over the points that it shares with each of the others."""
    both = shared.float()
    both[view] = 0
    count = both.sum(1)
    enough = count >= LEAST_SHARED
    if not bool(enough.any()):
        return torch.nan, torch.nan
    both, count, rgb = both[enough, :, None], count[enough, None, None], others.rgb[enough]
    a, b = (x - (x * both).sum(1, keepdim=True) / count for x in (own.expand_as(rgb), rgb))
    products = [(x * y * both).sum((1, 2)) for x, y in ((a, b), (a, a), (b, b))]
    correlation = products[0] / (products[1] * products[2]).sqrt().clamp(min=1e-6)
    squares = ((own - rgb).square() * both).sum((1, 2)) / (3 * count[:, 0, 0])
    return float(squares.amin().sqrt()), float(correlation.amax())
