"""Image-based blending: the colour that a few cameras give to each surface point of a novel view (RIFTCast, 3.3)."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.views import ContextViews

GRAZING = 0.1
"""Cosine below which the slope of the depth test grows no more."""


@dataclass(frozen=True, kw_only=True)
class BlendConfig:
    """How a camera's colour counts at a surface point.

    weight = usable * (n . v)^normal_power * (cosine between camera and viewer)^view_power

    where `usable` is the bilinear share of the four pixels around the sample that are foreground and not hidden.
    """

    normal_power: int = 2
    """Exponent of the cosine between the surface's normal and the direction to the camera."""
    view_power: int = 16
    """Exponent of the cosine between the directions to the camera and to the viewer."""
    depth_bias: float = 0.005
    """A point is hidden if it lies this much behind the proxy's depth, as a share of the subject's size."""
    slope_px: float = 1.0
    """What oblique surface adds to the bias: its change of depth over this many of the camera's pixels."""


@dataclass(frozen=True)
class Blend:
    """What the cameras say about each pixel of the novel view."""

    rgb: Float[Tensor, "3 height width"]
    """The weighted mean of the samples, in [0, 1]; black where no camera has weight."""
    weights: Float[Tensor, "source height width"]
    """Raw weights, not normalised."""
    disagreement: Float[Tensor, "height width"]
    """Weighted standard deviation of the samples about `rgb`, mean of the channels; 0 for a single camera."""


def blend(
    camera: Cameras,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "height width 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> Blend:
    """Colour the surface that `camera` sees from the images of `sources`.

    Samples are bilinear, and of the four pixels only those count that are foreground (by the soft mask) and that
    nothing hides the point from: neither background nor an occluder's rim bleeds in. A point behind a camera or
    outside its image gets nothing from it, nor where it faces away.

    Args:
        camera: the novel view (one).
        depth: z-depth of the surface in it, metres, 0 where there is none.
        normals: outward, of any length, world axes.
        sources: the cameras that colour it, with the proxy's depth in each.
        bias_m: tolerance of the depth test, metres.
        config: exponents and slope.
    """
    if depth.device.type == "cpu":
        from viewmend.rendering._blend_numba import blend_numba as implementation
    else:
        from viewmend.rendering._blend_torch import blend_torch as implementation
    return implementation(camera, depth, normals, sources, bias_m, config)
