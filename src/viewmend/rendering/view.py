"""From the images of one time to an incomplete novel view: select, blend, mark what is missing."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.threads import light_operations
from viewmend.rendering.blending import BlendConfig, blend
from viewmend.rendering.error_rules import MIN_WEIGHT, Evidence, error_map, error_rule
from viewmend.rendering.selection import select_closest
from viewmend.views import ContextViews, IncompleteView, MultiViewFrame, Silhouettes

SourceDepth = Callable[[tuple[str, ...]], Float[Tensor, "view height width"]]
"""The proxy's depth in the frame's cameras of these names."""


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """How a novel view is rendered from the cameras' images.

    Examples:
        >>> from viewmend import RenderConfig, StreamConfig
        >>> StreamConfig(render=RenderConfig(cameras=4)).render.cameras
        4
    """

    cameras: int = 3
    """How many cameras colour a view: those closest to it in angle (the paper: 3)."""
    blend: BlendConfig = field(default_factory=BlendConfig)
    """How the source views' colours are weighted."""
    error_rule: str | None = None
    """What must be mended: 'unseen', the pixels that no source view colours, 'all' of the subject, or what a model
    takes for 'wrong'. None is for what the stream's inpainter is made for."""
    wrong_fraction: float = 0.15
    """Rule 'wrong': at most this part of the proxy's pixels is mended, where most is to be gained; holes are always."""

    def __post_init__(self) -> None:
        error_rule(self.error_rule or "unseen")
        if not 0 < self.wrong_fraction <= 1:
            raise ValueError(f"expected a wrong_fraction above 0 and up to 1, got {self.wrong_fraction}")


@light_operations()
def render_view(
    frame: MultiViewFrame,
    proxy: GeometryProxy,
    target: Cameras,
    config: RenderConfig,
    exclude: Sequence[str] = (),
    source_depth: SourceDepth | None = None,
) -> IncompleteView:
    """F[t], M[t] and E[t] of section 1 for one novel view.

    Args:
        frame: what the cameras saw.
        proxy: G[t], on the frame's device.
        target: the novel view's camera (one view), on the same device.
        config: which cameras, how blended.
        exclude: names of cameras that must not be used, whatever else holds.
        source_depth: the proxy's depth in cameras, for callers that remember it; by default it is rendered here.

    Raises:
        ValueError: no camera is left to colour the view, or an error rule of one's own does not give E.
    """
    usable = _without(frame.cameras, exclude)
    source_depth = source_depth or (lambda names: proxy.depth(frame.cameras.select(names)))
    raster = rasterize(proxy.mesh, target)
    depth = raster.depth[0]
    mask = (depth > 0).to(depth)

    center = proxy.mesh.vertices.mean(0) if len(proxy.mesh.vertices) else proxy.bounds.center
    candidate_views = select_closest(target, usable, center, len(usable))
    source_views = candidate_views[: config.cameras]
    normals = interpolate(proxy.normals, proxy.mesh, target, raster)[0]
    sources = ContextViews(frame.select(source_views), source_depth(source_views))
    bias_m = config.blend.depth_bias * float(proxy.bounds.size_m.norm())
    blended = blend(target, depth, normals, sources, bias_m, config.blend)

    error = error_map(config.error_rule or "unseen", Evidence(mask, depth, blended))
    coloured = mask * (blended.weights.sum(0) >= MIN_WEIGHT)
    weights = blended.weights / blended.weights.sum(0).clamp(min=torch.finfo(depth.dtype).tiny) * coloured
    seen = frame if len(usable) == len(frame.cameras) else frame.select(usable.names)
    silhouettes = None if seen.mask is None else Silhouettes(seen.mask, seen.cameras)
    rgb = blended.rgb * coloured
    return IncompleteView(
        target, rgb, mask, error, depth, source_views, weights, frame.time, candidate_views, silhouettes
    )


def _without(cameras: Cameras, exclude: Sequence[str]) -> Cameras:
    left = [name for name in cameras.names if name not in exclude]
    if not left:
        raise ValueError(
            f"expected a camera to colour the view, got {len(cameras)} cameras with all of them excluded; exclude fewer"
        )
    return cameras.select(left)
