"""Attributes of the surface at each pixel, on the CPU; `rasterize.interpolate` is its twin for any device."""

from typing import no_type_check

from numba import njit

# Without type checks: numba compiles the functions themselves, not what a checker wraps around them.


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def interpolate_band(attributes, vertices, faces, P, triangle, first_row, end_row, image):
    """Fill rows [first_row, end_row) of one view's `image` from its `triangle` ids; P = K [R | t], float64."""
    for row in range(first_row, end_row):
        for column in range(triangle.shape[1]):
            face = triangle[row, column]
            if face < 0:
                continue
            a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
            u, v = column + 0.5, row + 0.5
            # The corners relative to the pixel's ray: then an edge's value is one 2x2 determinant.
            ax, ay = _beside(vertices, a, P, u, v)
            bx, by = _beside(vertices, b, P, u, v)
            cx, cy = _beside(vertices, c, P, u, v)
            wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
            scale = 1 / (wa + wb + wc)
            for channel in range(image.shape[2]):
                value = wa * attributes[a, channel] + wb * attributes[b, channel] + wc * attributes[c, channel]
                image[row, column, channel] = value * scale


@njit(nogil=True, cache=True, error_model="numpy")
@no_type_check
def _beside(vertices, n, P, u, v):
    """Pixel offsets of a vertex from (u, v), times its depth."""
    x, y, z = vertices[n, 0], vertices[n, 1], vertices[n, 2]
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    across = P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]
    down = P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]
    return across - u * depth, down - v * depth
