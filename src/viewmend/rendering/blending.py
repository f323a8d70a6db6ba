"""Image-based blending: the colour that a few cameras give to each surface point of a novel view (RIFTCast, 3.3)."""

from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.rendering._blend_torch import blend_torch
from viewmend.rendering.blend_rule import Blend, BlendConfig
from viewmend.views import ContextViews


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
        try:
            from viewmend.rendering._blend_numba import blend_numba
        except ImportError:
            pass
        else:
            return blend_numba(camera, depth, normals, sources, bias_m, config)
    return blend_torch(camera, depth, normals, sources, bias_m, config)
