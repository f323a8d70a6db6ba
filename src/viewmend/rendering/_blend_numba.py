"""Kernel of image-based blending on the CPU, in numba."""

from math import floor, sqrt

import numpy as np

from viewmend.utils.compiled import kernel


@kernel
def blend_rows(
    first, end, depth, normals, world_from_pixel, viewer, images, masks, depths, P, centers, focal, sizes,
    tolerance, powers, rgb, weights, disagreement,
):  # fmt: skip
    """Blends rows `first` to `end` of a novel view into `rgb`, `weights` and `disagreement`; see `blending.blend`.

    `tolerance` holds `bias_m`, `slope_px` and the grazing cosine; `powers` the exponents of normal and view.
    """
    count = P.shape[0]
    colour = np.zeros((count, 3))
    for row in range(first, end):
        for column in range(depth.shape[1]):
            z = depth[row, column]
            if z <= 0:
                continue
            point = _backproject(column + 0.5, row + 0.5, z, world_from_pixel, viewer)
            normal = _unit(normals[row, column, 0], normals[row, column, 1], normals[row, column, 2])
            to_viewer = _unit(viewer[0] - point[0], viewer[1] - point[1], viewer[2] - point[2])
            total = 0.0
            for view in range(count):
                weight = _weigh(
                    point, normal, to_viewer, view, images, masks, depths, P, centers, focal, sizes,
                    tolerance, powers, colour,
                )  # fmt: skip
                weights[view, row, column] = weight
                total += weight
            if total > 0:
                _average(colour, weights, total, row, column, rgb, disagreement)


@kernel
def _average(colour, weights, total, row, column, rgb, disagreement):
    variance = 0.0
    for channel in range(3):
        mean = 0.0
        for view in range(colour.shape[0]):
            mean += weights[view, row, column] * colour[view, channel]
        mean /= total
        rgb[channel, row, column] = mean
        for view in range(colour.shape[0]):
            variance += weights[view, row, column] * (colour[view, channel] - mean) ** 2
    disagreement[row, column] = sqrt(variance / (3 * total))


# Inlined: passing these arrays costs as much as the computation.
@kernel(inline="always")
def _weigh(
    point, normal, to_viewer, view, images, masks, depths, P, centers, focal, sizes, tolerance, powers, colour
):
    """Weight of one camera at a surface point; its sample goes into `colour[view]`."""
    x, y, w = point
    to_camera = _unit(centers[view, 0] - x, centers[view, 1] - y, centers[view, 2] - w)
    facing = min(_dot(normal, to_camera), 1.0)
    agreeing = min(_dot(to_viewer, to_camera), 1.0)
    # Single entries here and below: slicing an array costs an atomic reference count.
    z = P[view, 2, 0] * x + P[view, 2, 1] * y + P[view, 2, 2] * w + P[view, 2, 3]
    if facing <= 0 or agreeing <= 0 or z <= 0:
        return 0.0
    u = (P[view, 0, 0] * x + P[view, 0, 1] * y + P[view, 0, 2] * w + P[view, 0, 3]) / z
    v = (P[view, 1, 0] * x + P[view, 1, 1] * y + P[view, 1, 2] * w + P[view, 1, 3]) / z
    if not (0 <= u < sizes[view, 0] and 0 <= v < sizes[view, 1]):
        return 0.0

    per_pixel = z / focal[view] * sqrt(1 - facing * facing) / max(facing, tolerance[2])
    nearest = z - (tolerance[0] + tolerance[1] * per_pixel)
    usable = _sample(view, u, v, nearest, images, masks, depths, sizes, colour)
    if usable <= 0:
        return 0.0
    return usable * facing ** powers[0] * agreeing ** powers[1]


@kernel(inline="always")
def _sample(view, u, v, nearest, images, masks, depths, sizes, colour):
    """Sample one camera's image bilinearly into `colour[view]`, and return which part of the sample is usable.

    Pixels are not usable outside of the mask, or where the proxy is nearer than `nearest`. The
    colour is the mean of the usable pixels.
    """
    width = sizes[view, 0]
    height = sizes[view, 1]
    left = floor(u - 0.5)
    top = floor(v - 0.5)
    right_share = u - 0.5 - left
    bottom_share = v - 0.5 - top
    usable = 0.0
    red = 0.0
    green = 0.0
    blue = 0.0
    for tap in range(4):
        row = min(max(int(top) + tap // 2, 0), height - 1)
        column = min(max(int(left) + tap % 2, 0), width - 1)
        there = depths[view, row, column]
        if there > 0 and there < nearest:
            continue
        part = (bottom_share if tap // 2 else 1 - bottom_share) * (
            right_share if tap % 2 else 1 - right_share
        )
        if masks.shape[0]:
            part *= masks[view, row, column] * (1 / 255)
        usable += part
        red += part * images[view, 0, row, column]
        green += part * images[view, 1, row, column]
        blue += part * images[view, 2, row, column]
    if usable <= 0:
        return 0.0
    scale = 1 / max(255 * usable, 1e-6)
    colour[view, 0] = red * scale
    colour[view, 1] = green * scale
    colour[view, 2] = blue * scale
    return usable


@kernel
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def _unit(x, y, z):
    length = sqrt(x * x + y * y + z * z)
    scale = 1 / length if length > 0 else 0.0
    return x * scale, y * scale, z * scale


@kernel
def _backproject(u, v, z, world_from_pixel, center):
    m = world_from_pixel
    return (
        (m[0, 0] * u + m[0, 1] * v + m[0, 2]) * z + center[0],
        (m[1, 0] * u + m[1, 1] * v + m[1, 2]) * z + center[1],
        (m[2, 0] * u + m[2, 1] * v + m[2, 2]) * z + center[2],
    )
