"""Lookups of places along rays in torch, for any device; `_lookup_numba` is the twin for the CPU."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from viewmend.geometry.cameras import project, unproject
from viewmend.geometry.sampling import in_view
from viewmend.inpainting.sweep.lookup import CONTRAST, FAR, NEAR, Eyes, Level, Places, Rays


def look_up_torch(
    rays: Rays,
    views: Eyes,
    depths: Iterable[Float[Tensor, "height width"]],
    is_source: list[float],
    outlines: Eyes,
    size_m: float,
) -> Places:
    """`lookup.look_up`; `depths` are the proxy's in each of `views`, metres."""
    shape, cameras = rays.z_m.shape, views.cameras
    depth = torch.stack(tuple(depths))
    there = (rays.z_m > 0).flatten()
    uv = rays.uv_px.to(rays.z_m)[:, None].expand(-1, shape[1], -1).reshape(1, -1, 2)
    points = unproject(uv, rays.z_m.reshape(1, -1), rays.camera)[0]
    at, z = project(points, cameras)
    inside = in_view(at, z, cameras) & there
    fine, wide = _sampled(views.fine, at), _sampled(views.wide, at)
    column, row = at.long().clamp_min(0).unbind(-1)
    last = cameras.size_px[:, :, None] - 1
    nearest = torch.minimum(row, last[:, 1]) * depth.shape[2] + torch.minimum(column, last[:, 0])
    proxy = depth.flatten(1).gather(1, nearest)
    behind = torch.where(proxy > 0, (z - proxy) / size_m, 0.0)[..., None]
    to_viewer = F.normalize(rays.camera.centers[0] - points, dim=-1)
    cosine = (F.normalize(cameras.centers[:, None] - points, dim=-1) * to_viewer).sum(-1, keepdim=True)
    sources = z.new_tensor(is_source)[:, None, None].expand_as(cosine)
    near, far = _softsign(behind / NEAR), _softsign(behind / FAR)
    own = torch.cat([fine[..., :4], near, far, cosine, sources, torch.ones_like(near), wide], -1)
    own = torch.where(inside[..., None], own, 0.0)
    prior = inside * ((4 * cosine).exp() / (1 + (6 * near).exp()))[..., 0]
    prior = prior / (prior.sum(0) + 1e-6)
    rgb = own[..., :3]
    mean = (prior[..., None] * rgb).sum(0)
    variance = ((prior[..., None] * rgb.square()).sum(0) - mean.square()).clamp_min(0)
    own = torch.cat([own, inside[..., None] * (rgb - mean), prior[..., None]], -1)
    stats = torch.cat([mean, CONTRAST * variance, _least(outlines, points, there)], -1)
    features = own.movedim(0, 1).unflatten(0, shape)
    return Places(features, prior.T.unflatten(0, shape), stats.unflatten(0, shape))


def _least(outlines: Eyes, points: Float[Tensor, "point 3"], there: Tensor) -> Float[Tensor, "point 4"]:
    """The two smallest masks and the two smallest means around; 1 where there are no such cameras."""
    at, z = project(points, outlines.cameras)
    inside = in_view(at, z, outlines.cameras) & there
    values = torch.stack([_sampled(levels, at)[..., 0] for levels in (outlines.fine, outlines.wide)])
    values = F.pad(torch.where(inside, values, 1.0), (0, 0, 0, 2), value=1.0)
    return values.topk(2, dim=1, largest=False).values.flatten(0, 1).T


def _sampled(levels: tuple[Level, ...], at: Float[Tensor, "view point 2"]) -> Float[Tensor, "view point channel"]:
    """Each camera's level at positions of its image, bilinearly, in [0, 1]; black around."""
    sampled = []
    for (image, scale), position in zip(levels, at, strict=True):
        size = position.new_tensor([image.shape[1], image.shape[0]])
        grid = 2 * (position * scale + 1) / size - 1
        pixels = image.permute(2, 0, 1)[None].float() / 255
        sampled.append(F.grid_sample(pixels, grid[None, None], align_corners=False)[0, :, 0].T)
    return torch.stack(sampled)


def _softsign(x: Tensor) -> Tensor:
    return x / (1 + x.abs())
