"""From the images of one time to an incomplete novel view: select, blend, mark what is missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras, pixel_centers, project, unproject
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.rendering.blend_rule import BlendConfig
from viewmend.rendering.blending import blend
from viewmend.rendering.error_rules import Evidence, error_rule
from viewmend.rendering.selection import select_closest, select_covering
from viewmend.views import ContextViews, IncompleteView, MultiViewFrame, Silhouettes

SourceDepth = Callable[[tuple[str, ...]], Float[Tensor, "view height width"]]
"""The proxy's depth in the frame's cameras of these names."""

COVER_STRIDE_PX = 4
"""Covering selection looks at every so manieth pixel of the novel view, both ways."""


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """How a novel view is rendered from the cameras' images."""

    cameras: int = 3
    """How many cameras colour a view (the paper: 3)."""
    selection: Literal["closest", "covering"] = "closest"
    """Which: those closest in angle (the paper), or those that together see most of the view (RIFTCast)."""
    keep_share: float = 0.85
    """Covering only: the cameras stay while they see more than this share of what all could see."""
    blend: BlendConfig = field(default_factory=BlendConfig)
    """How the chosen cameras' colours are weighted."""
    error_rule: str = "unseen"
    """What counts as missing: 'unseen' marks the pixels that no chosen camera colours."""


def render_view(
    frame: MultiViewFrame,
    proxy: GeometryProxy,
    target: Cameras,
    config: RenderConfig,
    previous_source_views: Sequence[str] = (),
    exclude: Sequence[str] = (),
    source_depth: SourceDepth | None = None,
) -> IncompleteView:
    """F[t], M[t] and E[t] of section 1 for one novel view.

    Args:
        frame: what the cameras saw.
        proxy: G[t], on the frame's device.
        target: the novel view's camera (one view), on the same device.
        config: which cameras, how blended.
        previous_source_views: the cameras of the stream's last view, for covering selection's hysteresis.
        exclude: names of cameras that must not be used, whatever else holds.
        source_depth: the proxy's depth in cameras, for callers that remember it; by default it is rendered here.

    Raises:
        ValueError: no camera is left to colour the view.
    """
    usable = _without(frame.cameras, exclude)
    source_depth = source_depth or (lambda names: proxy.depth(frame.cameras.select(names)))
    raster = rasterize(proxy.mesh, target)
    depth = raster.depth[0]
    mask = (depth > 0).to(depth)

    center = proxy.mesh.vertices.mean(0) if len(proxy.mesh.vertices) else proxy.bounds.center
    nearest = select_closest(target, usable, center, len(usable))
    chosen = _select(usable, nearest, proxy, target, depth, config, previous_source_views, source_depth)
    normals = interpolate(proxy.normals, proxy.mesh, target, raster)[0]
    sources = ContextViews(frame.select(chosen), source_depth(chosen))
    bias_m = config.blend.depth_bias * float(proxy.bounds.size_m.norm())
    blended = blend(target, depth, normals, sources, bias_m, config.blend)

    error = error_rule(config.error_rule)(Evidence(mask, depth, blended))
    coloured = mask * (error < 1)
    weights = blended.weights / blended.weights.sum(0).clamp(min=torch.finfo(depth.dtype).tiny) * coloured
    seen = frame if len(usable) == len(frame.cameras) else frame.select(usable.names)
    silhouettes = None if seen.mask is None else Silhouettes(seen.mask, seen.cameras)
    return IncompleteView(
        target, blended.rgb * coloured, mask, error, depth, chosen, weights, frame.time, nearest, silhouettes
    )


def _without(cameras: Cameras, exclude: Sequence[str]) -> Cameras:
    left = [name for name in cameras.names if name not in exclude]
    if not left:
        raise ValueError(
            f"expected a camera to colour the view, got {len(cameras)} cameras with all of them excluded; exclude fewer"
        )
    return cameras.select(left)


def _select(
    usable: Cameras,
    candidate_views: tuple[str, ...],
    proxy: GeometryProxy,
    target: Cameras,
    depth: Float[Tensor, "height width"],
    config: RenderConfig,
    previous: Sequence[str],
    source_depth: SourceDepth,
) -> tuple[str, ...]:
    """Names of the cameras that colour the view, among those of `usable`."""
    if config.selection == "closest":
        return candidate_views[: config.cameras]
    evidence = _evidence(usable, proxy, target, depth, config, source_depth)
    return select_covering(evidence, usable.names, candidate_views, config.cameras, previous, config.keep_share)


def _evidence(
    usable: Cameras,
    proxy: GeometryProxy,
    target: Cameras,
    depth: Float[Tensor, "height width"],
    config: RenderConfig,
    source_depth: SourceDepth,
) -> Float[Tensor, "view point"]:
    """How well each camera sees the surface at every few pixels of the novel view, 0 to 1: visible, and how frontal."""
    height, width = depth.shape
    seen = depth[::COVER_STRIDE_PX, ::COVER_STRIDE_PX]
    grid = pixel_centers(width, height, depth.device)[::COVER_STRIDE_PX, ::COVER_STRIDE_PX]
    points = unproject(grid[seen > 0][None], seen[seen > 0][None], target)[0]
    uv, z = project(points, usable)
    size = usable.size_px[:, None]
    inside = (z > 0) & (uv >= 0).all(-1) & (uv < size).all(-1)
    pixel = uv.floor().clamp(min=0).minimum(size - 1).long()
    depths = source_depth(usable.names)
    there = depths[torch.arange(len(depths), device=depth.device)[:, None], pixel[..., 1], pixel[..., 0]]
    # One pixel's nearest depth, not four: the slope of the surface within it is why the tolerance is doubled.
    bias_m = 2 * config.blend.depth_bias * float(proxy.bounds.size_m.norm())
    visible = inside & ((there == 0) | (z - there <= bias_m))
    to_viewer = torch.nn.functional.normalize(target.centers[0] - points, dim=-1)
    to_cameras = torch.nn.functional.normalize(usable.centers[:, None] - points, dim=-1)
    return visible * (to_cameras * to_viewer).sum(-1).clamp(min=0)
