"""Renders an incomplete novel view from a frame: selects source cameras, blends them, finds holes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from viewmend.geometry.cameras import Cameras, pixel_centers, unproject
from viewmend.geometry.proxy import GeometryProxy
from viewmend.geometry.rasterize import interpolate, rasterize
from viewmend.geometry.threads import one_thread
from viewmend.rendering.blending import BlendConfig, blend
from viewmend.rendering.error_mask import Evidence, error_rule, holes
from viewmend.types import ContextViews, IncompleteView, MultiViewFrame, Silhouettes

SELECTIONS = ("angle", "direction")
"""The rules that decide which cameras are closest to a view (`RenderConfig.selection`)."""
SourceDepth = Callable[[tuple[str, ...]], Float[Tensor, "view height width"]]
"""The proxy's depth in the frame's cameras of these names."""


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """How a novel view is rendered from the cameras' images, and which of its pixels are to be inpainted.

    Examples:
        >>> from viewmend import RenderConfig, StreamConfig
        >>> StreamConfig(render=RenderConfig(cameras=4)).render.cameras
        4
    """

    cameras: int = 3
    """Number of source cameras that colour a view: those closest to it (the paper: 3)."""
    selection: str = "angle"
    """What makes a camera close: 'angle', a small angle at the subject's centre; 'direction', a
    similar viewing direction, as in RIFTCast."""
    blend: BlendConfig = field(default_factory=BlendConfig)
    """How the source cameras' colours are weighted."""
    error_rule: str | None = None
    """Pixels to inpaint: 'holes', which no source camera colours; 'all' of the subject;
    'predicted', those that a model predicts to be wrong; or FILE.py:NAME. None: the rule that the
    inpainter is made for."""
    refine_fraction: float = 0.15
    """Rule 'predicted': largest fraction of the subject's pixels to inpaint, all holes first."""

    def __post_init__(self) -> None:
        error_rule(self.error_rule or "holes")
        if not isinstance(self.cameras, Integral) or self.cameras < 1:
            raise ValueError(f"expected a whole number of source cameras, at least 1, got {self.cameras}")
        if self.selection not in SELECTIONS:
            raise ValueError(
                f"expected a selection of views by 'angle' or 'direction', got '{self.selection}'"
            )
        if not 0 < self.refine_fraction <= 1:
            raise ValueError(f"expected a refine_fraction above 0 and up to 1, got {self.refine_fraction}")


@one_thread()
def render_view(
    frame: MultiViewFrame,
    proxy: GeometryProxy,
    target: Cameras,
    config: RenderConfig,
    exclude: Sequence[str] = (),
    source_depth: SourceDepth | None = None,
) -> tuple[IncompleteView, Evidence]:
    """F[t] and M[t] of section 1 for one novel view, with the holes as E[t], and the evidence for other error rules.

    Args:
        frame: the cameras' images.
        proxy: G[t], on the frame's device.
        target: the novel view's camera (one view), on the same device.
        config: number of source cameras and weights.
        exclude: names of cameras that must not be used.
        source_depth: returns the proxy's depth in cameras; by default it is rendered here.

    Raises:
        ValueError: no camera is left to colour the view.
    """
    source_depth = source_depth or (lambda names: proxy.depth(frame.cameras.select(names)))
    raster = rasterize(proxy.mesh, target)
    normals = interpolate(proxy.normals, proxy.mesh, target, raster)[0]
    surface = _Surface(raster.depth[0], normals, proxy.center, proxy.bounds.diagonal_m)
    return _colour(frame, target, surface, config, exclude, source_depth)


def render_depth(
    frame: MultiViewFrame,
    target: Cameras,
    depth: Float[Tensor, "height width"],
    source_depth: SourceDepth,
    config: RenderConfig,
) -> tuple[IncompleteView, Evidence]:
    """`render_view` for geometry that is known as depth maps: z-depth in metres, 0 where there is no surface.

    `depth` is that of the surface in the novel view, of 2 x 2 pixels or more; `source_depth` returns its
    depth in the frame's cameras. Where `depth` is not finite, there is no surface.

    Raises:
        ValueError: there is no camera to colour the view.
    """
    depth = torch.where(depth.isfinite(), depth, 0.0)
    uv_px = pixel_centers(depth.shape[1], depth.shape[0], depth.device)
    points = unproject(uv_px.flatten(0, 1)[None], depth.flatten()[None], target)[0].view(*depth.shape, 3)
    across = torch.gradient(points, dim=1)[0]
    down = torch.gradient(points, dim=0)[0]
    normals = normalize(torch.linalg.cross(down, across), dim=-1)
    visible = points[depth > 0]
    if not len(visible):
        visible = points.new_zeros(1, 3)
    size_m = float((visible.amax(0) - visible.amin(0)).norm())
    surface = _Surface(depth, normals, visible.mean(0).cpu(), size_m)
    return _colour(frame, target, surface, config, (), source_depth)


class _Surface(NamedTuple):
    """What a novel view shows of the proxy."""

    depth: Float[Tensor, "height width"]
    normals: Float[Tensor, "height width 3"]
    center: Float[Tensor, "3"]
    """The middle of the whole subject, on the CPU."""
    size_m: float
    """Diagonal of the subject's box."""


def _colour(
    frame: MultiViewFrame,
    target: Cameras,
    surface: _Surface,
    config: RenderConfig,
    exclude: Sequence[str],
    source_depth: SourceDepth,
) -> tuple[IncompleteView, Evidence]:
    """The view of a surface in the colours of the closest cameras."""
    names = [name for name in frame.cameras.names if name not in exclude]
    if not names:
        count = len(frame.cameras)
        raise ValueError(
            f"expected a camera to colour the view, got {count} cameras with all of them excluded; exclude fewer"
        )
    usable = frame.select(names)  # the same frame, if no camera is excluded

    # blend the closest cameras on the surface
    candidate_views = select_closest(target, usable.cameras, surface.center, len(names), config.selection)
    source_views = candidate_views[: config.cameras]
    sources = ContextViews(frame.select(source_views), source_depth(source_views))
    bias_m = config.blend.depth_bias * surface.size_m
    blended = blend(target, surface.depth, surface.normals, sources, bias_m, config.blend)

    # find the pixels of the surface that have a colour
    mask = (surface.depth > 0).to(surface.depth)
    evidence = Evidence(mask, surface.depth, blended)
    uncoloured = holes(evidence)
    coloured = mask - uncoloured

    # normalise the cameras' weights to a sum of 1
    total = blended.total_weight
    weights = blended.weights / total.clamp(min=torch.finfo(total.dtype).tiny) * coloured

    silhouettes = None if usable.mask is None else Silhouettes(usable.mask, usable.cameras)
    view = IncompleteView(
        camera=target,
        rgb=blended.rgb * coloured,
        mask=mask,
        error=uncoloured,
        depth=surface.depth,
        source_views=source_views,
        weights=weights,
        time=frame.time,
        candidate_views=candidate_views,
        silhouettes=silhouettes,
    )
    return view, evidence


def select_closest(
    target: Cameras,
    cameras: Cameras,
    subject_center: Float[Tensor, "3"],
    k: int = 3,
    selection: str = "angle",
) -> tuple[str, ...]:
    """Names of the k cameras closest to the target, nearest first: the paper's selection (section 2).

    The paper does not define closeness. Here it is the angle at the subject's centre
    between the directions to the two cameras: the angle decides how similar the images are,
    the distance only changes their scale. With the selection 'direction' it is the angle
    between the optical axes, for cameras that look at different places. Returns fewer than
    k names if there are fewer cameras.
    """
    target = target.on_host
    cameras = cameras.on_host
    if selection == "direction":
        cosines = cameras.world_from_camera[:, :3, 2] @ target.world_from_camera[0, :3, 2]
        remoteness = (-cosines).tolist()  # grows with the angle
    else:
        remoteness = angles_to(target, cameras, subject_center.cpu()).tolist()
    closest = sorted(range(len(cameras)), key=remoteness.__getitem__)
    return tuple(cameras.names[view] for view in closest[:k])


def angles_to(target: Cameras, cameras: Cameras, subject_center: Float[Tensor, "3"]) -> Float[Tensor, "view"]:
    """Angle at the subject's centre between the target's centre and each camera's, radians in [0, pi]."""
    to_target = normalize(target.centers[0] - subject_center, dim=-1)
    to_cameras = normalize(cameras.centers - subject_center, dim=-1)
    # atan2 of the cross and the dot product: acos would lose precision at the small angles that matter.
    sine = torch.linalg.cross(to_cameras, to_target.expand_as(to_cameras)).norm(dim=-1)
    return torch.atan2(sine, to_cameras @ to_target)
