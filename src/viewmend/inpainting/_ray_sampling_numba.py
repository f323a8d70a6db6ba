"""Rays looked up in numba, for the CPU; `_ray_sampling_torch` is the twin for any device."""

from collections.abc import Sequence
from math import floor, sqrt, tanh
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from viewmend.geometry.cameras import Cameras
from viewmend.geometry.threads import parallel_for
from viewmend.inpainting.ray_sampling import (
    COVERED,
    FAR,
    NEAR,
    OUTLINE,
    PATCH,
    RAY_CHANNELS,
    RayFeatures,
    RaySamples,
    Seen,
    SilhouetteConsistency,
    side_px,
    subject_px,
)

BAND = 32
"""Pixels that a thread takes at a time."""


def sample_numba(
    camera: Cameras,
    uv_px: Float[Tensor, "pixel 2"],
    z_m: Float[Tensor, "pixel point"],
    seen: Seen,
    is_source: Sequence[float],
    size_m: float,
) -> RaySamples:
    """`ray_sampling.sample_along_rays`, at these z-depths along the rays of a camera's pixels."""
    pixels, points = z_m.shape
    found = np.zeros((pixels, points, len(is_source), RAY_CHANNELS), np.float32)
    least = np.ones((pixels, points, 4), np.float32)
    pose = camera.world_from_camera[0].double()
    through = torch.cat([pose[None, :3, 3], pose[:3, :3] @ torch.linalg.inv(camera.K[0].double())]).numpy()
    uv, z = uv_px.double().numpy(), z_m.double().numpy()
    subject = subject_px(seen.mask)
    side, half = side_px(OUTLINE, subject), side_px(PATCH / 2, subject)
    wide = side_px(OUTLINE, subject_px(seen.silhouettes.mask))
    eyes, outlines = _unpacked(seen.frame.cameras), _unpacked(seen.silhouettes.cameras)
    rgb, mask, depth = seen.frame.rgb.numpy(), seen.mask.numpy(), seen.depth.numpy()
    all_masks = seen.silhouettes.mask.numpy()
    shapes = np.zeros((len(eyes), 2, *_squares(mask, side)), np.float32)
    colours = np.zeros((len(eyes), 3, *_squares(mask[:, ::2, ::2], half)), np.float32)
    around = np.zeros((len(outlines), *_squares(all_masks, wide)), np.float32)

    def average(view: int) -> None:
        if view < len(eyes):
            average_mask(mask[view], side, shapes[view, 0])
            average_coverage(depth[view], side, shapes[view, 1])
            average_colours(rgb[view], mask[view], half, colours[view])
        else:
            average_mask(all_masks[view - len(eyes)], wide, around[view - len(eyes)])

    def work(band: int) -> None:
        first, end = band * BAND, min(pixels, (band + 1) * BAND)
        for view, (P, center, size) in enumerate(eyes):
            follow(
                *(first, end, view, uv, z, through, P, center, size, rgb[view], mask[view], depth[view]),
                *(shapes[view], 1 / side, colours[view], 1 / (2 * half), is_source[view], size_m, found),
            )
        for view, (P, _, size) in enumerate(outlines):
            compare_silhouette(first, end, uv, z, through, P, size, all_masks[view], around[view], 1 / wide, least)

    if pixels:
        parallel_for(average, len(eyes) + len(outlines))
        parallel_for(work, -(-pixels // BAND))
    return RaySamples(
        RayFeatures.unstack(torch.from_numpy(found)), SilhouetteConsistency.unstack(torch.from_numpy(least))
    )


def _unpacked(cameras: Cameras) -> list[tuple]:
    """Each camera as the kernels take it: P, centre, size."""
    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).numpy()
    return list(zip(P, cameras.centers.double().numpy(), map(tuple, cameras.size_px.tolist()), strict=True))


def _squares(images: np.ndarray, side: int) -> tuple[int, int]:
    """So many rows and columns of squares of this side cover the images."""
    return -(-images.shape[1] // side), -(-images.shape[2] // side)


# Without type checks: numba compiles the functions themselves, not what a checker wraps around them.


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def average_coverage(depth, side, out):
    """Shares of squares that the proxy covers."""
    height, width = depth.shape
    for row in range(height):
        for column in range(width):
            if depth[row, column] > 0:
                out[row // side, column // side] += 1
    out /= side**2


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def average_colours(rgb, mask, half, out):
    """Means of RGB before black over squares of every other row and column: of colours these will do."""
    height, width = mask.shape
    for row in range(0, height, 2):
        for column in range(0, width, 2):
            m = np.float32(mask[row, column])
            if m > 0:
                for c in range(3):
                    out[c, row // (2 * half), column // (2 * half)] += m * rgb[c, row, column]
    out /= 255**2 * half**2


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def average_mask(mask, side, out):
    """Means of a mask over squares, 255 as 1."""
    height, width = mask.shape
    for row in range(height):
        for column in range(width):
            if mask[row, column] > 0:
                out[row // side, column // side] += mask[row, column]
    out /= 255 * side**2


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _bilinear(image, x, y):
    """An image at a position in its pixels, zeros beyond it."""
    height, width = image.shape
    x, y = x - 0.5, y - 0.5
    left, top = floor(x), floor(y)
    right, below = x - left, y - top
    if left >= 0 and top >= 0 and left + 1 < width and top + 1 < height:
        upper = (1 - right) * image[top, left] + right * image[top, left + 1]
        lower = (1 - right) * image[top + 1, left] + right * image[top + 1, left + 1]
        return (1 - below) * upper + below * lower
    value = 0.0
    for row in range(max(0, top), min(height, top + 2)):
        for column in range(max(0, left), min(width, left + 2)):
            weight = (right if column > left else 1 - right) * (below if row > top else 1 - below)
            value += weight * image[row, column]
    return value


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _point(rays, uv, t):
    """The point at z-depth t along the ray of a pixel."""
    u, v = uv[0], uv[1]
    x = rays[0, 0] + t * (rays[1, 0] * u + rays[1, 1] * v + rays[1, 2])
    y = rays[0, 1] + t * (rays[2, 0] * u + rays[2, 1] * v + rays[2, 2])
    z = rays[0, 2] + t * (rays[3, 0] * u + rays[3, 1] * v + rays[3, 2])
    return x, y, z


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _project(P, size, x, y, z):
    """Where a camera of this size sees a point, and its z-depth, which is 0 where it has the point not in view."""
    w = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    safe = max(w, 1e-9)
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]) / safe
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]) / safe
    inside = w > 0 and u >= 0 and v >= 0 and u < size[0] and v < size[1]
    return u, v, w if inside else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def follow(
    first, end, view, uv, z, rays, P, center, size, rgb, mask, depth,
    shapes, per_shape, colours, per_colour, is_source, size_m, out,
):  # fmt: skip
    """What one camera shows at the points of rays first to end - 1; nothing is written of those out of its view."""
    height, width = mask.shape
    viewer = rays[0]
    for pixel in range(first, end):
        for point in range(z.shape[1]):
            px, py, pz = _point(rays, uv[pixel], z[pixel, point])
            u, v, w = _project(P, size, px, py, pz)
            if w <= 0:
                continue
            own = out[pixel, point, view]
            left, top = floor(u - 0.5), floor(v - 0.5)
            right, below = u - 0.5 - left, v - 0.5 - top
            coverage, surface = 0.0, 0.0
            for row in range(max(0, top), min(height, top + 2)):
                for column in range(max(0, left), min(width, left + 2)):
                    weight = (right if column > left else 1 - right) * (below if row > top else 1 - below)
                    if mask[row, column] > 0:
                        m = (1 / 255) * weight * mask[row, column]
                        own[3] += m
                        for c in range(3):
                            own[c] += (1 / 255) * m * rgb[c, row, column]
                    if depth[row, column] > 0:
                        coverage += weight
                        surface += weight * depth[row, column]
            behind = (w - surface / coverage) / size_m if coverage > COVERED else 0.0
            own[4] = tanh(behind / NEAR)
            own[5] = tanh(behind / FAR)
            cx, cy, cz = center[0] - px, center[1] - py, center[2] - pz
            vx, vy, vz = viewer[0] - px, viewer[1] - py, viewer[2] - pz
            lengths = sqrt((cx * cx + cy * cy + cz * cz) * (vx * vx + vy * vy + vz * vz))
            own[6] = (cx * vx + cy * vy + cz * vz) / max(lengths, 1e-12)
            own[7] = is_source
            own[8] = 1.0
            own[9] = _bilinear(shapes[0], u * per_shape, v * per_shape)
            for c in range(3):
                own[10 + c] = _bilinear(colours[c], u * per_colour, v * per_colour)
            own[13] = _bilinear(shapes[1], u * per_shape, v * per_shape)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _lower(least, pixel, point, first, value):
    """A value among the two smallest of a point, if it is. A copy: numba does not notice when other files change."""
    if value < least[pixel, point, first]:
        least[pixel, point, first + 1], least[pixel, point, first] = least[pixel, point, first], value
    elif value < least[pixel, point, first + 1]:
        least[pixel, point, first + 1] = value


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def compare_silhouette(first, end, uv, z, rays, P, size, mask, around, per_side, least):
    """Lowers the two smallest masks, and the two smallest means around, at every point that this camera has in view."""
    for pixel in range(first, end):
        for point in range(z.shape[1]):
            px, py, pz = _point(rays, uv[pixel], z[pixel, point])
            u, v, w = _project(P, size, px, py, pz)
            if w <= 0:
                continue
            _lower(least, pixel, point, 0, (1 / 255) * _bilinear(mask, u, v))
            _lower(least, pixel, point, 2, _bilinear(around, u * per_side, v * per_side))
