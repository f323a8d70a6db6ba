"""Lens distortion after Brown and Conrady, coefficients in OpenCV's order: k1, k2, p1, p2, k3.

Points are normalised: (x, y) = K^-1 (u, v, 1), so the image plane is at distance 1.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import pixel_centers


def distort(points: Float[Tensor, "*batch 2"], dist: Float[Tensor, "5"]) -> Float[Tensor, "*batch 2"]:
    """Where the lens images the normalised, undistorted `points`, normalised."""
    k1, k2, p1, p2, k3 = dist
    x, y = points.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        -1,
    )


def undistort_points(
    points: Float[Tensor, "*batch 2"], dist: Float[Tensor, "5"], steps: int = 10
) -> Float[Tensor, "*batch 2"]:
    """The normalised points that the lens images at `points`: inverse of `distort`, by Newton's method.

    A point that no undistorted point maps to gets a finite, meaningless answer.
    """
    k1, k2, p1, p2, k3 = dist
    undistorted = points
    for _ in range(steps):
        x, y = undistorted.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = k1 + r2 * (2 * k2 + r2 * 3 * k3)
        xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        xy = 2 * (x * y * slope + p1 * x + p2 * y)
        dx, dy = (distort(undistorted, dist) - points).unbind(-1)
        determinant = (xx * yy - xy * xy).clamp(min=1e-2)
        step = torch.stack([yy * dx - xy * dy, xx * dy - xy * dx], -1) / determinant[..., None]
        undistorted = undistorted - step.clamp(-1, 1)
    return undistorted


def undistortion_grid(
    K: Float[Tensor, "3 3"], dist: Float[Tensor, "5"], width: int, height: int
) -> Float[Tensor, "height width 2"]:
    """Where to sample the distorted image, in its pixel coordinates, for each pixel of the undistorted one (same K).

    Coordinates count pixel centres at +0.5: `cv2.remap` wants them less 0.5. Far off the axis a polynomial can turn
    back and show the image a second time; there the grid points far outside the image.
    """
    inverse = torch.linalg.inv(K.double())
    pixels = pixel_centers(width, height, K.device).double()
    normalised = pixels @ inverse[:2, :2].T + inverse[:2, 2]
    turn = _turning_radius(dist.double(), float(normalised.norm(dim=-1).max()))
    distorted = distort(normalised, dist.double())
    grid = distorted @ K.double()[:2, :2].T + K.double()[:2, 2]
    outside = torch.tensor(-10.0 * max(width, height), dtype=grid.dtype, device=grid.device)
    return torch.where((normalised.norm(dim=-1) < turn)[..., None], grid, outside).to(K)


def _turning_radius(dist: Float[Tensor, "5"], largest: float) -> float:
    """The first radius, up to `largest`, at which the radial polynomial stops growing; infinite if it never does."""
    k1, k2, _, _, k3 = dist
    r2 = torch.linspace(0, largest, 1000, dtype=dist.dtype, device=dist.device) ** 2
    falling = (1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3)) <= 0).nonzero()
    return float(r2[falling[0, 0]].sqrt()) if len(falling) else torch.inf
