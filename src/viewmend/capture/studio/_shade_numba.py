"""The shading's fast path on the CPU: scalar loops compiled by numba."""

from typing import no_type_check

import numpy as np
from numba import njit

# Without type checks: numba compiles the functions themselves, not what a checker wraps around them.


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def shade_band(
    ids, P, center, vertex, faces, textures, texels, first, size, lamps, gloss, doublings, behind, rows, rgb, mask
):
    """Fill rows [rows[0], rows[1]) of one view's rgb (3, h, w) and mask (h, w); see `render.shade_torch`.

    `vertex` has the columns x y z, u v, normal, irradiance.
    """
    n = ids.shape[0] // mask.shape[0]
    sums, sample, at = np.zeros(3, np.float32), np.zeros(3, np.float32), np.zeros(vertex.shape[1], np.float32)
    corners = np.zeros((3, 3))
    for row in range(rows[0], rows[1]):
        for column in range(mask.shape[1]):
            count = 0
            sums[:] = 0
            for y in range(row * n, row * n + n):
                for x in range(column * n, column * n + n):
                    face = ids[y, x]
                    if face < 0:
                        continue
                    count += 1
                    sizes = size[textures[face]]
                    interpolate(corners, vertex, faces[face], P, x + 0.5, y + 0.5, at)
                    level = texture_level(corners, vertex, faces[face], sizes)
                    texture_color(texels, first[textures[face]], sizes, at[3], at[4], level, sample)
                    add_highlights(at, center, lamps, gloss, doublings, sample)
                    for c in range(3):
                        sums[c] += at[8 + c] * sample[c]
            mask[row, column] = np.uint8(np.rint(np.float32(255) * count / (n * n)))
            free = np.float32(1) - np.float32(count) / np.float32(n * n)
            for c in range(3):
                rgb[c, row, column] = encode(sums[c] / np.float32(n * n) + free * behind[c, row, column])


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def interpolate(corners, vertex, face, P, u, v, at):
    """Fill `at` with the vertex columns of a face at pixel (u, v), perspective-correct (see the rasteriser)."""
    for k in range(3):
        for r in range(3):
            corners[k, r] = P[r, 3]
            for c in range(3):
                corners[k, r] += P[r, c] * np.float64(vertex[face[k], c])
    total = 0.0
    a = edge(corners[1], corners[2], u, v)
    b = edge(corners[2], corners[0], u, v)
    c = edge(corners[0], corners[1], u, v)
    total = a + b + c
    wa, wb, wc = np.float32(a / total), np.float32(b / total), np.float32(c / total)
    for k in range(at.shape[0]):
        at[k] = wa * vertex[face[0], k] + wb * vertex[face[1], k] + wc * vertex[face[2], k]


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def texture_level(corners, vertex, face, sizes):
    """The level of a face, whose `corners` are P X, at which a texel is as large as a pixel."""
    if corners[0, 2] <= 0 or corners[1, 2] <= 0 or corners[2, 2] <= 0:
        return 0.0
    a, b, c = vertex[face[0]], vertex[face[1]], vertex[face[2]]
    texels = np.abs((b[3] - a[3]) * (c[4] - a[4]) - (b[4] - a[4]) * (c[3] - a[3])) * sizes[0, 0] * sizes[0, 1] / 2
    x0, y0 = corners[0, 0] / corners[0, 2], corners[0, 1] / corners[0, 2]
    x1, y1 = corners[1, 0] / corners[1, 2] - x0, corners[1, 1] / corners[1, 2] - y0
    x2, y2 = corners[2, 0] / corners[2, 2] - x0, corners[2, 1] / corners[2, 2] - y0
    pixels = np.abs(x1 * y2 - y1 * x2) / 2
    ratio = max(texels / max(pixels, 1e-6), 1e-6)
    return min(max(0.5 * np.log2(ratio), 0.0), sizes.shape[0] - 1.0)


@njit(nogil=True, cache=True, inline="always")
@no_type_check
def edge(p, q, u, v):
    """(p x q) . (u, v, 1)."""
    return (p[1] * q[2] - p[2] * q[1]) * u + (p[2] * q[0] - p[0] * q[2]) * v + (p[0] * q[1] - p[1] * q[0])


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def texture_color(texels, first, size, u, v, level, out):
    """Fill `out` with the trilinear look-up in one texture's levels, clamped at its edges."""
    low = int(np.floor(level))
    out[:] = 0
    for step in range(2):
        at = min(low + step, first.shape[0] - 1)
        share = np.float32(level - low) if step == 1 else np.float32(1 - (level - low))
        if share <= 0:
            continue
        width, height = size[at, 0], size[at, 1]
        x = min(max(np.float32(u * width) - np.float32(0.5), np.float32(0)), np.float32(width - 1))
        y = min(max(np.float32(v * height) - np.float32(0.5), np.float32(0)), np.float32(height - 1))
        x0, y0 = int(x), int(y)
        x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
        fx, fy = np.float32(x - x0), np.float32(y - y0)
        base = first[at]
        for c in range(3):
            top = texels[base + y0 * width + x0, c] * (1 - fx) + texels[base + y0 * width + x1, c] * fx
            bottom = texels[base + y1 * width + x0, c] * (1 - fx) + texels[base + y1 * width + x1, c] * fx
            out[c] += share * (top * (1 - fy) + bottom * fy)


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def add_highlights(at, center, lamps, gloss, doublings, out):
    """Add the Blinn-Phong highlights of all lamps to a colour."""
    ex, ey, ez = center[0] - at[0], center[1] - at[1], center[2] - at[2]
    scale = 1 / np.sqrt(ex * ex + ey * ey + ez * ez)
    ex, ey, ez = ex * scale, ey * scale, ez * scale
    length = np.sqrt(at[5] * at[5] + at[6] * at[6] + at[7] * at[7])
    for k in range(lamps.shape[0]):
        hx, hy, hz = ex + lamps[k, 0], ey + lamps[k, 1], ez + lamps[k, 2]
        half = np.sqrt(hx * hx + hy * hy + hz * hz)
        power = (at[5] * hx + at[6] * hy + at[7] * hz) / max(half * length, np.float32(1e-12))
        if power <= 0:
            continue
        for _ in range(doublings):
            power = power * power
        for c in range(3):
            out[c] += power * gloss[k, c]


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def encode(linear):
    """8-bit sRGB of linear light."""
    value = min(max(linear, np.float32(0)), np.float32(1))
    if value <= 0.0031308:
        return np.uint8(np.rint(value * 12.92 * 255))
    return np.uint8(np.rint((1.055 * value ** (1 / 2.4) - 0.055) * 255))


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def unshadowed(pixels, z, depth, bias, seen):
    """One light of `shading.unshadowed_torch`."""
    last_row, last_column = depth.shape[0] - 1, depth.shape[1] - 1
    for i in range(z.shape[0]):
        u, v = pixels[i, 0] - np.float32(0.5), pixels[i, 1] - np.float32(0.5)
        x, y = int(np.floor(u)), int(np.floor(v))
        fx, fy = u - x, v - y
        total = 0.0
        for dy in range(2):
            row = min(max(y + dy, 0), last_row)
            wy = fy if dy else 1 - fy
            for dx in range(2):
                if z[i] < depth[row, min(max(x + dx, 0), last_column)] + bias:
                    total += wy * (fx if dx else 1 - fx)
        seen[i] = total
