"""Shades pixels on the CPU: scalar loops compiled by numba.

Rows of arrays are never sliced in the loops: each slice counts references, which threads then fight over.
"""

from typing import NamedTuple

import numpy as np

from viewmend.utils.compiled import kernel


class Scene(NamedTuple):
    """What all views share, as arrays."""

    vertex: np.ndarray
    """(vertex, 11) float32: x y z, u v, normal, irradiance."""
    faces: np.ndarray
    textures: np.ndarray
    """Index of each face's texture."""
    texels: np.ndarray
    first: np.ndarray
    size: np.ndarray
    lamps: np.ndarray
    gloss: np.ndarray
    doublings: int
    steps: np.ndarray
    guesses: np.ndarray
    """`encoding()`."""


class View(NamedTuple):
    """One view, as arrays."""

    ids: np.ndarray
    """(fine row, fine column): face or -1."""
    projected: np.ndarray
    """(vertex, 3) float64: P X in fine pixels."""
    center: np.ndarray
    behind: np.ndarray
    """(3, row, column): background, linear light."""


@kernel
def shade_band(scene, view, first_row, end_row, rgb, mask):
    """Fill rows [first_row, end_row) of one view's rgb (3, h, w) and mask (h, w); see `render.render`."""
    n = view.ids.shape[0] // mask.shape[0]
    sums = np.zeros(3, np.float32)
    color = np.zeros(3, np.float32)
    at = np.zeros(11, np.float32)
    whole = np.float32(n * n)
    for row in range(first_row, end_row):
        for column in range(mask.shape[1]):
            count = 0
            sums[:] = 0
            for y in range(row * n, row * n + n):
                for x in range(column * n, column * n + n):
                    face = view.ids[y, x]
                    if face < 0:
                        continue
                    count += 1
                    level = interpolate(scene, view.projected, face, x + 0.5, y + 0.5, at)
                    texture_color(scene, scene.textures[face], at[3], at[4], level, color)
                    add_highlights(scene, view.center, at, color)
                    for c in range(3):
                        sums[c] += at[8 + c] * color[c]
            mask[row, column] = np.uint8(np.rint(np.float32(255) * count / whole))
            free = np.float32(1) - np.float32(count) / whole
            for c in range(3):
                linear = sums[c] / whole + free * view.behind[c, row, column]
                rgb[c, row, column] = encode(linear, scene.steps, scene.guesses)


@kernel
def interpolate(scene, projected, face, u, v, at):
    """Fill `at` with a face's vertex columns at a pixel, perspective-correct, and return its level of the texture."""
    i = scene.faces[face, 0]
    j = scene.faces[face, 1]
    k = scene.faces[face, 2]
    a = corner(projected, i)
    b = corner(projected, j)
    c = corner(projected, k)
    at_a = edge_value(b, c, u, v)
    at_b = edge_value(c, a, u, v)
    at_c = edge_value(a, b, u, v)
    total = at_a + at_b + at_c
    wa = np.float32(at_a / total)
    wb = np.float32(at_b / total)
    wc = np.float32(at_c / total)
    vertex = scene.vertex
    for n in range(11):
        at[n] = wa * vertex[i, n] + wb * vertex[j, n] + wc * vertex[k, n]
    if a[2] <= 0 or b[2] <= 0 or c[2] <= 0:
        return 0.0
    return texture_level(scene, face, a, b, c)


@kernel(inline="always")
def corner(projected, n):
    """A vertex in pixels times z."""
    return projected[n, 0], projected[n, 1], projected[n, 2]


@kernel(inline="always")
def edge_value(p, q, u, v):
    """The value of the edge between two projected corners at a pixel: (p x q) . (u, v, 1)."""
    across = p[1] * q[2] - p[2] * q[1]
    down = p[2] * q[0] - p[0] * q[2]
    return across * u + down * v + (p[0] * q[1] - p[1] * q[0])


@kernel(inline="always")
def texture_level(scene, face, a, b, c):
    """The pyramid level of a face's texture at which a texel is as large as a pixel; a, b, c: projected corners."""
    i = scene.faces[face, 0]
    j = scene.faces[face, 1]
    k = scene.faces[face, 2]
    vertex = scene.vertex
    texture = scene.textures[face]
    u1 = vertex[j, 3] - vertex[i, 3]
    v1 = vertex[j, 4] - vertex[i, 4]
    u2 = vertex[k, 3] - vertex[i, 3]
    v2 = vertex[k, 4] - vertex[i, 4]
    texels = np.abs(u1 * v2 - v1 * u2) * scene.size[texture, 0, 0] * scene.size[texture, 0, 1]
    x0 = a[0] / a[2]
    y0 = a[1] / a[2]
    pixels = np.abs((b[0] / b[2] - x0) * (c[1] / c[2] - y0) - (b[1] / b[2] - y0) * (c[0] / c[2] - x0))
    level = 0.5 * np.log2(max(texels / max(pixels, 2e-6), 1e-6))
    return min(max(level, 0.0), scene.first.shape[1] - 1.0)


@kernel
def texture_color(scene, texture, u, v, level, out):
    """Fill `out` with the trilinear look-up in one texture's levels, clamped at its edges."""
    texels = scene.texels
    low = int(level)
    out[:] = 0
    for step in range(2):
        share = np.float32(level - low) if step == 1 else np.float32(1 - (level - low))
        if share <= 0:
            continue
        at = min(low + step, scene.first.shape[1] - 1)
        width = scene.size[texture, at, 0]
        height = scene.size[texture, at, 1]
        base = scene.first[texture, at]
        x = min(max(u * np.float32(width) - np.float32(0.5), np.float32(0)), np.float32(width - 1))
        y = min(max(v * np.float32(height) - np.float32(0.5), np.float32(0)), np.float32(height - 1))
        x0 = int(x)
        y0 = int(y)
        fx = x - np.float32(x0)
        fy = y - np.float32(y0)
        right = 1 if x0 + 1 < width else 0
        top = base + y0 * width + x0
        bottom = top + (width if y0 + 1 < height else 0)
        for c in range(3):
            above = texels[top, c] + fx * (texels[top + right, c] - texels[top, c])
            below = texels[bottom, c] + fx * (texels[bottom + right, c] - texels[bottom, c])
            out[c] += share * (above + fy * (below - above))


@kernel
def add_highlights(scene, center, at, out):
    """Add the Blinn-Phong highlights of all lamps to a colour."""
    ex = center[0] - at[0]
    ey = center[1] - at[1]
    ez = center[2] - at[2]
    scale = np.float32(1) / np.sqrt(ex * ex + ey * ey + ez * ez)
    ex = ex * scale
    ey = ey * scale
    ez = ez * scale
    length = at[5] * at[5] + at[6] * at[6] + at[7] * at[7]
    for k in range(scene.lamps.shape[0]):
        hx = ex + scene.lamps[k, 0]
        hy = ey + scene.lamps[k, 1]
        hz = ez + scene.lamps[k, 2]
        facing = at[5] * hx + at[6] * hy + at[7] * hz
        if facing <= 0:
            continue
        # The cosine's square: one doubling of its power is saved, and two roots.
        power = facing * facing / max((hx * hx + hy * hy + hz * hz) * length, np.float32(1e-12))
        for _ in range(scene.doublings - 1):
            power = power * power
        for c in range(3):
            out[c] += power * scene.gloss[k, c]


def encoding(entries=4096):
    """Make the tables of `encode`: linear light halfway between 8-bit sRGB levels, and a first guess."""
    halves = (np.arange(255) + 0.5) / 255
    steps = np.where(halves <= 0.04045, halves / 12.92, ((halves + 0.055) / 1.055) ** 2.4)
    return steps, np.searchsorted(steps, np.arange(entries + 1) / entries)


@kernel
def encode(linear, steps, guesses):
    """Encode linear light as 8-bit sRGB with tables: a power per pixel would cost more than its shading."""
    if not linear > 0:
        return np.uint8(0)
    value = min(np.float64(linear), 1.0)
    level = guesses[int(value * (len(guesses) - 1))]
    while level < 255 and value > steps[level]:
        level += 1
    return np.uint8(level)


@kernel
def shadow_visibility(pixels, z, depth, bias, seen):
    """Fill `seen` with the visibility of one light at each vertex; see `render.visibility`."""
    last_row = depth.shape[0] - 1
    last_column = depth.shape[1] - 1
    for i in range(z.shape[0]):
        u = pixels[i, 0] - np.float32(0.5)
        v = pixels[i, 1] - np.float32(0.5)
        x = int(np.floor(u))
        y = int(np.floor(v))
        fx = u - x
        fy = v - y
        total = 0.0
        for dy in range(2):
            row = min(max(y + dy, 0), last_row)
            wy = fy if dy else 1 - fy
            for dx in range(2):
                if z[i] < depth[row, min(max(x + dx, 0), last_column)] + bias:
                    total += wy * (fx if dx else 1 - fx)
        seen[i] = total
