"""The visual hull: what the masks of all cameras leave of a volume, as soft occupancy on a grid."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from viewmend.geometry.bounds import Bounds
from viewmend.geometry.cameras import Cameras

NEAR_M = 1e-6


@dataclass(frozen=True, kw_only=True)
class HullConfig:
    """How the visual hull is carved."""

    resolution: int = 128
    """Voxels along the longest side of the box that is carved."""
    coarse_resolution: int = 48
    """Voxels along the longest side of the given bounds, in the first pass that finds the subject's box."""
    blur_px: float = 2.0
    """Standard deviation of the masks' Gaussian blur, pixels; 0 leaves them as they are."""
    min_views: int = 2
    """Space that fewer cameras see is empty."""
    min_share: float = 0.5
    """Space that a smaller share of the cameras sees is empty."""


@dataclass(frozen=True)
class OccupancyGrid:
    """Soft occupancy of cubic voxels: 1 inside, 0 outside, the surface where it is one half."""

    values: Float[Tensor, "x y z"]
    """values[i, j, k] is at low + (i + 0.5, j + 0.5, k + 0.5) * voxel_m."""
    low: Float[Tensor, "3"]
    voxel_m: float


def visual_hull(
    mask: UInt8[Tensor, "view height width"], cameras: Cameras, bounds: Bounds, config: HullConfig
) -> OccupancyGrid:
    """Occupancy of `bounds`: the product of the (softened) mask values over the cameras that see a point.

    A camera says nothing about what is outside its image or behind it; space that too few cameras see is empty.

    Raises:
        ValueError: there is one camera only, or no mask has any foreground.
    """
    check_masks(mask, cameras)
    longest = float(bounds.size_m.max())
    voxel_m = longest / config.resolution
    shape = [max(1, math.ceil(side / voxel_m - 1e-4)) for side in bounds.size_m.tolist()]
    soft = soften(mask, config.blur_px)
    axes = [
        low + (torch.arange(n, device=mask.device) + 0.5) * voxel_m for low, n in zip(bounds.low, shape, strict=True)
    ]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    values = torch.ones(len(points), device=mask.device)
    seen = torch.zeros(len(points), dtype=torch.int32, device=mask.device)
    for view in range(len(cameras)):
        value, sees = _look_up(soft[view], cameras[view], points)
        values *= torch.where(sees, value, 1.0)
        seen += sees
    values[seen < needed_views(len(cameras), config)] = 0
    return OccupancyGrid(values.view(*shape), bounds.low, voxel_m)


def needed_views(views: int, config: HullConfig) -> int:
    """How many of `views` cameras must see a point for it to count."""
    return max(min(config.min_views, views), math.ceil(config.min_share * views))


def check_masks(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> None:
    """ValueError for what no hull can be made of."""
    if len(cameras) < 2:
        raise ValueError(f"expected masks of at least two cameras, got {len(cameras)}; a hull needs several views")
    if not bool(mask.any()):
        raise ValueError(
            f"expected foreground in the masks, got none in any of {len(cameras)} cameras; check the masks' "
            "files and that 255 means foreground"
        )


def soften(mask: UInt8[Tensor, "view height width"], blur_px: float) -> Float[Tensor, "view height width"]:
    """Masks in [0, 1], blurred by a Gaussian of `blur_px` that continues the border's values beyond the image."""
    soft = mask.float() / 255
    if blur_px <= 0:
        return soft
    reach = math.ceil(2 * blur_px)
    offsets = torch.arange(-reach, reach + 1, device=mask.device)
    kernel = torch.exp(-0.5 * (offsets / blur_px) ** 2)
    kernel /= kernel.sum()
    padded = torch.nn.functional.pad(soft[:, None], (reach,) * 4, mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))[:, 0]


def _look_up(
    soft: Float[Tensor, "height width"], camera: Cameras, points: Float[Tensor, "point 3"]
) -> tuple[Float[Tensor, "point"], Tensor]:
    """The mask's value at each point's image, bilinear, and whether the camera sees the point."""
    P = camera.K[0] @ camera.camera_from_world[0, :3]
    x, y, z = (points @ P[:, :3].T + P[:, 3]).unbind(-1)
    width, height = camera.size_px[0].tolist()
    u, v = x / z, y / z
    sees = (z > NEAR_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    grid = torch.stack([2 * u / soft.shape[1] - 1, 2 * v / soft.shape[0] - 1], -1).nan_to_num(0, 0, 0)
    value = torch.nn.functional.grid_sample(
        soft[None, None], grid[None, None], padding_mode="border", align_corners=False
    )
    return value[0, 0, 0], sees


def bounds_from_cameras(cameras: Cameras) -> Bounds:
    """A cube that holds what all cameras look at, for rigs of any size and shape.

    Its centre is the point nearest to all optical axes; it is as large as the median camera sees at that distance.

    Raises:
        ValueError: the cameras look away from each other.
    """
    world = cameras.world_from_camera
    return _cube_around(cameras, world[:, :3, 2], _half_view(cameras))


def bounds_from_masks(mask: UInt8[Tensor, "view height width"], cameras: Cameras) -> Bounds:
    """A cube that holds the masks' subject: centred where the rays through the masks' middles come closest.

    Raises:
        ValueError: there is one camera only, no mask has any foreground, or the cameras look away from each other.
    """
    check_masks(mask, cameras)
    some = [v for v in range(len(cameras)) if bool(mask[v].any())]
    if len(some) < 2:
        return bounds_from_cameras(cameras)
    cameras = cameras[some]
    boxes = torch.stack([_mask_box(mask[v]) for v in some]).to(cameras.K)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    pixels = torch.cat([middle, torch.ones_like(middle[:, :1])], -1)
    rays = torch.linalg.solve(cameras.K, pixels[..., None])
    directions = torch.nn.functional.normalize((cameras.world_from_camera[:, :3, :3] @ rays)[..., 0], dim=-1)
    focal = torch.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], -1)
    # The subject may be nearer to a camera than its middle and is round: take half as much again.
    half = 1.5 * ((boxes[:, 2:] - boxes[:, :2]) / 2 / focal).amax(-1)
    return _cube_around(cameras, directions, half, largest=True)


def _mask_box(mask: UInt8[Tensor, "height width"]) -> Float[Tensor, "4"]:
    columns, rows = mask.any(0).nonzero()[:, 0], mask.any(1).nonzero()[:, 0]
    return torch.stack([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]).float()


def _half_view(cameras: Cameras) -> Float[Tensor, "view"]:
    """Half of what each camera sees at distance 1, the narrower way."""
    focal = torch.stack([cameras.K[:, 0, 0], cameras.K[:, 1, 1]], -1)
    return (cameras.size_px / 2 / focal).amin(-1)


def _cube_around(
    cameras: Cameras, directions: Float[Tensor, "view 3"], half_at_1: Float[Tensor, "view"], largest: bool = False
) -> Bounds:
    """The cube about the point nearest to all rays; half its side is `half_at_1` times the distance from there."""
    centers = cameras.centers
    across = torch.eye(3, device=centers.device) - directions[:, :, None] * directions[:, None, :]
    # A little of every centre's pull keeps parallel rays solvable.
    pull = across + 1e-4 * torch.eye(3, device=centers.device)
    middle = torch.linalg.solve(pull.sum(0), (pull @ centers[..., None]).sum(0))[:, 0]
    distance = ((middle - centers) * directions).sum(-1)
    if not bool((distance > 0).any()):
        raise ValueError(
            "expected cameras that look at a common subject, got cameras whose axes meet behind them; check that R and "
            "t map world to camera (OpenCV axes), or give the capture bounds"
        )
    reach = (half_at_1 * distance)[distance > 0]
    half = reach.amax() if largest else reach.median()
    return Bounds(middle - half, middle + half)
