"""Image-based blending in torch, for any device; `_blend_numba` is the implementation for the CPU."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from viewmend.geometry.cameras import Cameras, project, unproject
from viewmend.geometry.sampling import bilinear_taps, in_view
from viewmend.rendering.blending import GRAZING, Blend, BlendConfig
from viewmend.types import ContextViews


def blend_torch(
    camera: Cameras,
    depth: Float[Tensor, "height width"],
    normals: Float[Tensor, "height width 3"],
    sources: ContextViews,
    bias_m: float,
    config: BlendConfig,
) -> Blend:
    """`blending.blend`."""
    row, column = (depth > 0).nonzero(as_tuple=True)
    pixels = torch.stack([column, row], -1) + 0.5
    points = unproject(pixels[None].to(depth), depth[row, column][None], camera)[0]
    normal = normalize(normals[row, column], dim=-1)
    to_viewer = normalize(camera.centers[0] - points, dim=-1)

    weights, colours = [], []
    for view in range(len(sources.frame.cameras)):
        weight, colour = _sample(points, normal, to_viewer, sources, view, bias_m, config)
        weights.append(weight)
        colours.append(colour)
    weight, colour = torch.stack(weights), torch.stack(colours)

    total = weight.sum(0).clamp(min=torch.finfo(weight.dtype).tiny)
    mean = (weight[:, None] * colour).sum(0) / total
    variance = (weight * (colour - mean).square().mean(1)).sum(0) / total
    height, width = depth.shape
    rgb = depth.new_zeros(3, height, width)
    raw = depth.new_zeros(len(weights), height, width)
    disagreement = torch.zeros_like(depth)
    rgb[:, row, column] = mean
    raw[:, row, column] = weight
    disagreement[row, column] = variance.sqrt()
    return Blend(rgb, raw, disagreement)


def _sample(
    points: Float[Tensor, "point 3"],
    normal: Float[Tensor, "point 3"],
    to_viewer: Float[Tensor, "point 3"],
    sources: ContextViews,
    view: int,
    bias_m: float,
    config: BlendConfig,
) -> tuple[Float[Tensor, "point"], Float[Tensor, "3 point"]]:
    """Weight and colour of one camera at each surface point."""
    frame, camera = sources.frame, sources.frame.cameras[view]
    uv, z = (values[0] for values in project(points, camera))
    width, height = camera.size_px[0].tolist()
    to_camera = normalize(camera.centers[0] - points, dim=-1)
    facing = (normal * to_camera).sum(-1).clamp(0, 1)
    agreeing = (to_viewer * to_camera).sum(-1).clamp(0, 1)

    # Change of depth of a surface at this angle from one pixel of the camera to the next.
    per_pixel = z / camera.K[0, 0, 0] * (1 - facing.square()).sqrt() / facing.clamp(min=GRAZING)
    usable, colour = torch.zeros_like(z), z.new_zeros(3, len(z))
    for row, column, weight, _ in bilinear_taps(uv, width, height):
        depth = sources.depth[view, row, column]
        weight = weight * ((depth == 0) | (z - depth <= bias_m + config.slope_px * per_pixel))
        if frame.mask is not None:
            weight = weight * (frame.mask[view, row, column] / 255)
        usable = usable + weight
        colour = colour + weight * frame.rgb[view, :, row, column]
    seen = in_view(uv[None], z[None], camera)[0]
    weight = seen * usable * facing**config.normal_power * agreeing**config.view_power
    return weight, colour / (255 * usable).clamp(min=1e-6)
