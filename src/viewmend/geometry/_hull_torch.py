"""The hull in torch, for any device: every voxel asks every camera. Also the reference for the fast path."""

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor
from torch.nn.functional import conv2d, pad

from viewmend.geometry.cameras import Cameras, project
from viewmend.geometry.sampling import in_view, sample_bilinear

NEAR_M = 1e-6


def soften(
    mask: UInt8[Tensor, "view height width"], size_px: Int[Tensor, "view 2"], pool: int
) -> UInt8[Tensor, "view row column"]:
    """Average squares of pool x pool pixels and smooth the averages by (1 2 1)/4 along both axes, rounded to 8 bits.

    Beyond each image's own size its border continues.
    """
    views, height, width = mask.shape
    rows, columns = -(-height // pool), -(-width // pool)
    y = torch.arange(rows * pool, device=mask.device).clamp(max=height - 1)
    x = torch.arange(columns * pool, device=mask.device).clamp(max=width - 1)
    own_y, own_x = y.minimum(size_px[:, 1:] - 1), x.minimum(size_px[:, :1] - 1)
    view = torch.arange(views, device=mask.device)[:, None, None]
    full = mask[view, own_y[:, :, None], own_x[:, None, :]].float()
    sums = full.view(views, rows, pool, columns, pool).sum((2, 4))
    kernel = torch.tensor([1.0, 2.0, 1.0], device=mask.device)
    border = pad(sums[:, None], (1, 1, 1, 1), mode="replicate")
    smooth = conv2d(border, (kernel[:, None] * kernel)[None, None])[:, 0]
    return (smooth * (1.0 / (16 * pool * pool)) + 0.5).floor().to(torch.uint8)


def carve(
    soft: UInt8[Tensor, "view row column"],
    pool: int,
    cameras: Cameras,
    low: Float[Tensor, "3"],
    voxel_m: float,
    shape: tuple[int, int, int],
    needed: int,
) -> Float[Tensor, "x y z"]:
    """The smallest mask value over the cameras that see each voxel's middle; 0 where fewer than `needed` do."""
    axes = [low[a] + (torch.arange(shape[a], device=low.device) + 0.5) * voxel_m for a in range(3)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3)
    values = torch.ones(len(points), device=low.device)
    seen = torch.zeros(len(points), dtype=torch.int32, device=low.device)
    for view in range(len(cameras)):
        uv, z = project(points, cameras[view])
        sees = in_view(uv, z, cameras[view])[0]
        value = sample_bilinear(soft[view].float()[None, None] / 255, uv / pool, "border")[0, :, 0]
        values = torch.where(sees, values.minimum(value), values)
        seen += sees
    return torch.where(seen >= needed, values, 0.0).view(*shape)


def occupied_blocks(
    mask: UInt8[Tensor, "view height width"],
    tile: int,
    cameras: Cameras,
    low: Float[Tensor, "3"],
    block_m: float,
    shape: tuple[int, int, int],
    needed: int,
) -> Bool[Tensor, "x y z"]:
    """The blocks of which no camera sees nothing but background and which enough cameras may see."""
    axes = [low[a] + (torch.arange(shape[a], device=low.device) + 0.5) * block_m for a in range(3)]
    centers = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, 3)
    radius = block_m * 3**0.5 / 2
    P = cameras.K @ cameras.camera_from_world[:, :3]
    empty = torch.zeros(len(centers), dtype=torch.bool, device=low.device)
    seen = torch.zeros(len(centers), dtype=torch.int32, device=low.device)
    for view in range(len(cameras)):
        uv, z = project(centers, cameras[view])
        uv, z, size = uv[0], z[0], cameras.size_px[view]
        # How far from its centre's image the image of the ball around a block can reach.
        slope = (P[view, None, :2, :3] - uv[:, :, None] * P[view, 2, :3]).norm(dim=-1)
        reach = slope * (radius / (z - radius).clamp(min=NEAR_M))[:, None]
        first, last = uv - reach, uv + reach
        in_front = z - radius > NEAR_M
        outside = ((last < 0) | (first >= size)).any(-1)
        inside = ((first >= 0) & (last < size)).all(-1)
        empty |= in_front & inside & (_foreground_tiles(mask[view], tile, first, last) == 0)
        seen += (z + radius > NEAR_M) & ~(in_front & outside)
    return (~empty & (seen >= needed)).view(*shape)


def _foreground_tiles(
    mask: UInt8[Tensor, "height width"],
    tile: int,
    first: Float[Tensor, "block 2"],
    last: Float[Tensor, "block 2"],
) -> Int[Tensor, "block"]:
    """How many tiles with any foreground each window of pixels, and one and a half pixels around it, touches."""
    height, width = mask.shape
    rows, columns = -(-height // tile), -(-width // tile)
    padded = pad(mask, (0, columns * tile - width, 0, rows * tile - height))
    some = padded.view(rows, tile, columns, tile).amax((1, 3)) > 0
    sums = pad(some.int().cumsum(0).cumsum(1), (1, 0, 1, 0))
    end = torch.tensor([columns, rows], device=mask.device) - 1
    from_tile = ((first - 1.5).clamp(0, max(width, height)) / tile).long().minimum(end)
    to_tile = ((last + 1.5).clamp(0, max(width, height)) / tile).long().minimum(end) + 1
    (left, top), (right, bottom) = from_tile.unbind(-1), to_tile.unbind(-1)
    return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
