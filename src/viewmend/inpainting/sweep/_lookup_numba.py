"""Lookups of places along rays in numba, for the CPU; `_lookup_torch` is the twin for any device."""

from collections.abc import Iterable
from math import exp, floor, sqrt
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from viewmend.geometry.threads import parallel_for
from viewmend.inpainting.sweep.lookup import CONTRAST, FAR, FEATURES, NEAR, STATS, Eyes, Places, Rays

BAND = 128
"""Rays that a thread takes at a time."""


def look_up_numba(
    rays: Rays,
    views: Eyes,
    depths: Iterable[Float[Tensor, "height width"]],
    is_source: list[float],
    outlines: Eyes,
    size_m: float,
) -> Places:
    """`lookup.look_up`; `depths` are the proxy's in each of `views`, metres."""
    count, places = rays.z_m.shape
    found = np.empty((count, places, len(is_source), FEATURES), np.float32)
    prior = np.empty(found.shape[:3], np.float32)
    stats = np.ones((count, places, STATS), np.float32)
    pose = rays.camera.world_from_camera[0].double()
    world_from_pixel = pose[:3, :3] @ torch.linalg.inv(rays.camera.K[0].double())
    through = torch.cat([pose[None, :3, 3], world_from_pixel]).numpy()
    uv, z, known = rays.uv_px.double().numpy(), rays.z_m.float().numpy(), [depth.numpy() for depth in depths]
    units, least = (1 / (NEAR * size_m), 1 / (FAR * size_m)), stats[..., 6:]
    eyes, silhouettes = _unpacked(views), _unpacked(outlines)

    def work(band: int) -> None:
        first, end = band * BAND, min(count, (band + 1) * BAND)
        for view, (P, center, size, fine, wide, scales) in enumerate(eyes):
            look_up_camera(
                *(first, end, view, uv, z, through, P, center, size, fine, wide, scales),
                *(known[view], units, is_source[view], found, prior),
            )
        compare_cameras(first, end, found, prior, stats)
        for P, _, size, fine, wide, scales in silhouettes:
            look_up_silhouette(first, end, uv, z, through, P, size, fine, wide, scales, least)

    parallel_for(work, -(-count // BAND))
    return Places(*map(torch.from_numpy, (found, prior, stats)))


def _unpacked(eyes: Eyes) -> list[tuple]:
    """Each camera as the kernels take it: P, centre, size, both images and their scales."""
    cameras = eyes.cameras
    P = (cameras.K.double() @ cameras.camera_from_world[:, :3].double()).numpy()
    centers, sizes = cameras.centers.double().numpy(), [(int(w), int(h)) for w, h in cameras.size_px.tolist()]
    return [
        (P[view], centers[view], sizes[view], fine.image.numpy(), wide.image.numpy(), (fine.scale, wide.scale))
        for view, (fine, wide) in enumerate(zip(eyes.fine, eyes.wide, strict=True))
    ]


# Without type checks: numba compiles the functions themselves, not what a checker wraps around them.


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def halve(image, half):
    """Means of 2 x 2 pixels; images (row, column, channel) have a border of one black pixel."""
    rows, columns, channels = half.shape
    last_row, last_column = image.shape[0] - 1, image.shape[1] - 1
    for row in range(1, rows - 1):
        top = 2 * row - 1
        below = min(top + 1, last_row)
        for column in range(1, columns - 1):
            left = 2 * column - 1
            right = min(left + 1, last_column)
            for c in range(channels):
                total = np.int32(image[top, left, c]) + np.int32(image[below, left, c])
                total += np.int32(image[top, right, c]) + np.int32(image[below, right, c])
                half[row, column, c] = (total + 2) >> 2


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def premultiplied(rgb, mask, depth, out):
    """RGB upon black, mask and coverage by the proxy, with a border of one black pixel."""
    height, width = mask.shape
    for row in range(height):
        for column in range(width):
            m = np.uint32(mask[row, column])
            if m > 0:
                for c in range(3):
                    out[row + 1, column + 1, c] = (np.uint32(rgb[c, row, column]) * m + 127) // 255
                out[row + 1, column + 1, 3] = m
            if depth[row, column] > 0:
                out[row + 1, column + 1, 4] = 255


# Inlined: handing over so many arrays costs as much as the work.
@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _sample(image, x, y, out, ray, place, view, first, count):
    """The first channels of an image with a border, bilinearly, in [0, 1]; positions are in it, half a pixel off."""
    left, top = min(floor(x), image.shape[1] - 2), min(floor(y), image.shape[0] - 2)
    right, below = x - left, y - top
    w00, w01, w10, w11 = (1 - right) * (1 - below), right * (1 - below), (1 - right) * below, right * below
    for c in range(count):
        out[ray, place, view, first + c] = (1 / 255) * (
            w00 * image[top, left, c]
            + w01 * image[top, left + 1, c]
            + w10 * image[top + 1, left, c]
            + w11 * image[top + 1, left + 1, c]
        )


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def look_up_camera(
    first, end, view, uv, z, rays, P, center, size, fine, wide, scales, depth, units, is_source, out, prior
):  # fmt: skip
    """What one camera shows at the places of rays first to end - 1, and a first opinion on whether it sees them."""
    fine_scale, wide_scale = scales
    width, height = size
    columns, rows = np.float32(width), np.float32(height)
    viewer, world_from_pixel = rays[0], rays[1:]
    b0 = P[0, 0] * viewer[0] + P[0, 1] * viewer[1] + P[0, 2] * viewer[2] + P[0, 3]
    b1 = P[1, 0] * viewer[0] + P[1, 1] * viewer[1] + P[1, 2] * viewer[2] + P[1, 3]
    b2 = P[2, 0] * viewer[0] + P[2, 1] * viewer[1] + P[2, 2] * viewer[2] + P[2, 3]
    for ray in range(first, end):
        dx = world_from_pixel[0, 0] * uv[ray, 0] + world_from_pixel[0, 1] * uv[ray, 1] + world_from_pixel[0, 2]
        dy = world_from_pixel[1, 0] * uv[ray, 0] + world_from_pixel[1, 1] * uv[ray, 1] + world_from_pixel[1, 2]
        dz = world_from_pixel[2, 0] * uv[ray, 0] + world_from_pixel[2, 1] * uv[ray, 1] + world_from_pixel[2, 2]
        length = 1.0 / sqrt(dx * dx + dy * dy + dz * dz)
        a0 = P[0, 0] * dx + P[0, 1] * dy + P[0, 2] * dz
        a1 = P[1, 0] * dx + P[1, 1] * dy + P[1, 2] * dz
        a2 = P[2, 0] * dx + P[2, 1] * dy + P[2, 2] * dz
        for place in range(z.shape[1]):
            t = z[ray, place]
            w = a2 * t + b2
            seen = False
            if t > 0 and w > 1e-6:
                u, v = (a0 * t + b0) / w, (a1 * t + b1) / w
                seen = u >= 0 and v >= 0 and u < columns and v < rows
            if not seen:
                for c in range(out.shape[3]):
                    out[ray, place, view, c] = 0.0
                prior[ray, place, view] = 0.0
                continue
            _sample(fine, u * fine_scale + 0.5, v * fine_scale + 0.5, out, ray, place, view, 0, 4)
            _sample(wide, u * wide_scale + 0.5, v * wide_scale + 0.5, out, ray, place, view, 9, 5)
            there = depth[min(int(v), height - 1), min(int(u), width - 1)]
            behind = w - there if there > 0 else 0.0
            near, far = behind * units[0], behind * units[1]
            near, far = near / (1 + abs(near)), far / (1 + abs(far))
            tx = center[0] - viewer[0] - t * dx
            ty = center[1] - viewer[1] - t * dy
            tz = center[2] - viewer[2] - t * dz
            cosine = -length * (tx * dx + ty * dy + tz * dz) / sqrt(tx * tx + ty * ty + tz * tz)
            out[ray, place, view, 4] = near
            out[ray, place, view, 5] = far
            out[ray, place, view, 6] = cosine
            out[ray, place, view, 7] = is_source
            out[ray, place, view, 8] = 1.0
            prior[ray, place, view] = exp(4 * cosine) / (1 + exp(6 * near))


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def compare_cameras(first, end, found, prior, stats):
    """Means and variances of colours by the first opinion, which is made to add up to 1; and what differs from them."""
    places, views = prior.shape[1:]
    for ray in range(first, end):
        for place in range(places):
            total = 1e-6
            for view in range(views):
                total += prior[ray, place, view]
            for view in range(views):
                prior[ray, place, view] /= total
                found[ray, place, view, 17] = prior[ray, place, view]
            for c in range(3):
                mean, square = 0.0, 0.0
                for view in range(views):
                    value, weight = found[ray, place, view, c], prior[ray, place, view]
                    mean += weight * value
                    square += weight * value * value
                stats[ray, place, c] = mean
                stats[ray, place, 3 + c] = CONTRAST * max(0.0, square - mean * mean)
                for view in range(views):
                    inside = found[ray, place, view, 8]
                    found[ray, place, view, 14 + c] = inside * (found[ray, place, view, c] - mean)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _first_channel(image, x, y):
    """The first channel of an image with a border, as `_sample`."""
    left, top = min(floor(x), image.shape[1] - 2), min(floor(y), image.shape[0] - 2)
    right, below = x - left, y - top
    upper = (1 - right) * image[top, left, 0] + right * image[top, left + 1, 0]
    lower = (1 - right) * image[top + 1, left, 0] + right * image[top + 1, left + 1, 0]
    return (1 / 255) * ((1 - below) * upper + below * lower)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
@no_type_check
def _lower(least, ray, place, first, value):
    """A value among the two smallest of a place, if it is."""
    if value < least[ray, place, first]:
        least[ray, place, first + 1], least[ray, place, first] = least[ray, place, first], value
    elif value < least[ray, place, first + 1]:
        least[ray, place, first + 1] = value


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def look_up_silhouette(first, end, uv, z, rays, P, size, fine, wide, scales, least):
    """Lowers the two smallest masks, and the two smallest means around, at every place that this camera has in view."""
    fine_scale, wide_scale = scales
    columns, rows = np.float32(size[0]), np.float32(size[1])
    viewer, world_from_pixel = rays[0], rays[1:]
    b0 = P[0, 0] * viewer[0] + P[0, 1] * viewer[1] + P[0, 2] * viewer[2] + P[0, 3]
    b1 = P[1, 0] * viewer[0] + P[1, 1] * viewer[1] + P[1, 2] * viewer[2] + P[1, 3]
    b2 = P[2, 0] * viewer[0] + P[2, 1] * viewer[1] + P[2, 2] * viewer[2] + P[2, 3]
    for ray in range(first, end):
        dx = world_from_pixel[0, 0] * uv[ray, 0] + world_from_pixel[0, 1] * uv[ray, 1] + world_from_pixel[0, 2]
        dy = world_from_pixel[1, 0] * uv[ray, 0] + world_from_pixel[1, 1] * uv[ray, 1] + world_from_pixel[1, 2]
        dz = world_from_pixel[2, 0] * uv[ray, 0] + world_from_pixel[2, 1] * uv[ray, 1] + world_from_pixel[2, 2]
        a0 = P[0, 0] * dx + P[0, 1] * dy + P[0, 2] * dz
        a1 = P[1, 0] * dx + P[1, 1] * dy + P[1, 2] * dz
        a2 = P[2, 0] * dx + P[2, 1] * dy + P[2, 2] * dz
        for place in range(z.shape[1]):
            t = z[ray, place]
            w = a2 * t + b2
            if not (t > 0 and w > 1e-6):
                continue
            u, v = (a0 * t + b0) / w, (a1 * t + b1) / w
            if not (u >= 0 and v >= 0 and u < columns and v < rows):
                continue
            _lower(least, ray, place, 0, _first_channel(fine, u * fine_scale + 0.5, v * fine_scale + 0.5))
            _lower(least, ray, place, 2, _first_channel(wide, u * wide_scale + 0.5, v * wide_scale + 0.5))
