"""Image-based blending in torch, for any device; `_blend_numba` is its twin for the CPU."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from viewmend.geometry.cameras import Cameras, project, unproject
from viewmend.rendering.blend_rule import GRAZING, Blend, BlendConfig
from viewmend.views import ContextViews


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
    uv, z = project(points, camera)
    (u, v), z = uv[0].unbind(-1), z[0]
    width, height = camera.size_px[0].tolist()
    seen = (z > 0) & (u >= 0) & (v >= 0) & (u <= width) & (v <= height)

    to_camera = normalize(camera.centers[0] - points, dim=-1)
    facing = (normal * to_camera).sum(-1).clamp(0, 1)
    agreeing = (to_viewer * to_camera).sum(-1).clamp(0, 1)

    # Surface at this angle changes its depth by so much from one of the camera's pixels to the next.
    per_pixel = z / camera.K[0, 0, 0] * (1 - facing.square()).sqrt() / facing.clamp(min=GRAZING)
    index, share = _taps(u, v, width, height)
    around = sources.depth[view][index]
    share = share * ((around == 0) | (z - around <= bias_m + config.slope_px * per_pixel))
    if frame.mask is not None:
        share = share * (frame.mask[view][index] / 255)
    usable = share.sum(0)
    weight = seen * usable * facing**config.normal_power * agreeing**config.view_power
    colour = (frame.rgb[view][:, index[0], index[1]] * share).sum(1) / (255 * usable).clamp(min=1e-6)
    return weight, colour


def _taps(
    u: Float[Tensor, "point"], v: Float[Tensor, "point"], width: int, height: int
) -> tuple[tuple[Tensor, Tensor], Float[Tensor, "4 point"]]:
    """Rows and columns of the four pixels around image coordinates, and their bilinear shares."""
    x, y = u - 0.5, v - 0.5
    left, top = x.floor(), y.floor()
    right_share, bottom_share = x - left, y - top
    columns = torch.stack([left, left + 1, left, left + 1]).clamp(0, width - 1).long()
    rows = torch.stack([top, top, top + 1, top + 1]).clamp(0, height - 1).long()
    horizontal = torch.stack([1 - right_share, right_share] * 2)
    vertical = torch.stack([1 - bottom_share] * 2 + [bottom_share] * 2)
    return (rows, columns), horizontal * vertical
