"""The rasteriser's fast path on the CPU: scalar loops compiled by numba, image bands shared among threads."""

import numpy as np

from viewmend.utils.compiled import kernel


@kernel
def project_vertices(vertices, P, out):
    """Fill out[:, 0:3] with P [X; 1], in pixels times z, and out[:, 3:5] with the pixel coordinates, in float64."""
    for i in range(vertices.shape[0]):
        x = np.float64(vertices[i, 0])
        y = np.float64(vertices[i, 1])
        z = np.float64(vertices[i, 2])
        for row in range(3):
            out[i, row] = P[row, 0] * x + P[row, 1] * y + P[row, 2] * z + P[row, 3]
        w = out[i, 2] if out[i, 2] > 0 else np.inf
        out[i, 3] = out[i, 0] / w
        out[i, 4] = out[i, 1] / w


@kernel
def draw_band(projected, faces, near, cull, first_row, end_row, width, depth, triangle):
    """Draw all faces into rows [first_row, end_row) of one view's `depth` (as z) and `triangle`.

    Homogeneous edge functions (Olano and Greer 1997): with q = P X of a corner, edge i is (q_j x
    q_k) . (u, v, 1). They need no clipping, and two triangles compute exactly opposite values along
    the edge that they share. `cull`: 0 none, 1 faces turned away, -1 faces turned to the camera.
    """
    for f in range(faces.shape[0]):
        a = projected[faces[f, 0]]
        b = projected[faces[f, 1]]
        c = projected[faces[f, 2]]
        left, right, top, bottom = pixel_box(a, b, c, near, (0, width), (first_row, end_row))
        if left >= right or top >= bottom:
            continue
        ax = b[1] * c[2] - b[2] * c[1]
        ay = b[2] * c[0] - b[0] * c[2]
        aw = b[0] * c[1] - b[1] * c[0]
        determinant = a[0] * ax + a[1] * ay + a[2] * aw
        if determinant == 0 or determinant * cull > 0:
            continue
        bx = c[1] * a[2] - c[2] * a[1]
        by = c[2] * a[0] - c[0] * a[2]
        bw = c[0] * a[1] - c[1] * a[0]
        cx = a[1] * b[2] - a[2] * b[1]
        cy = a[2] * b[0] - a[0] * b[2]
        cw = a[0] * b[1] - a[1] * b[0]
        sign = 1.0 if determinant > 0 else -1.0
        for row in range(top, bottom):
            v = row + 0.5
            a0 = ay * v + aw
            b0 = by * v + bw
            c0 = cy * v + cw
            for column in range(left, right):
                u = column + 0.5
                ea = ax * u + a0
                eb = bx * u + b0
                ec = cx * u + c0
                if ea * sign >= 0 and eb * sign >= 0 and ec * sign >= 0:
                    inverse = np.float32((ea + eb + ec) / determinant)
                    if inverse * near < 1 and inverse > depth[row, column]:
                        depth[row, column] = inverse
                        triangle[row, column] = f
    for row in range(first_row, end_row):
        for column in range(width):
            if triangle[row, column] >= 0:
                depth[row, column] = np.float32(1) / depth[row, column]


@kernel(inline="always")
def pixel_box(a, b, c, near, columns, rows):
    """First and end column, first and end row of the pixels whose centres may be in a triangle.

    They lie in the ranges `columns` and `rows`: in all of them if the triangle crosses z = near. A
    range is empty if its end is not above its first number.
    """
    if max(a[2], b[2], c[2]) <= near:
        return 0, 0, 0, 0
    if min(a[2], b[2], c[2]) <= near:
        return columns[0], columns[1], rows[0], rows[1]
    left = np.int64(np.ceil(max(min(a[3], b[3], c[3]) - 0.5, -1.0)))
    right = np.int64(np.floor(min(max(a[3], b[3], c[3]) - 0.5, 1e6)))
    top = np.int64(np.ceil(max(min(a[4], b[4], c[4]) - 0.5, -1.0)))
    bottom = np.int64(np.floor(min(max(a[4], b[4], c[4]) - 0.5, 1e6)))
    return (
        max(columns[0], left),
        min(columns[1], right + 1),
        max(rows[0], top),
        min(rows[1], bottom + 1),
    )


@kernel
def interpolate_band(attributes, vertices, faces, P, triangle, first_row, end_row, image):
    """Fill rows [first_row, end_row) of one view's `image` from its `triangle` ids; P = K [R | t], float64.

    `rasterize.interpolate` is its twin for any device.
    """
    for row in range(first_row, end_row):
        for column in range(triangle.shape[1]):
            face = triangle[row, column]
            if face < 0:
                continue
            a = faces[face, 0]
            b = faces[face, 1]
            c = faces[face, 2]
            u = column + 0.5
            v = row + 0.5
            # The corners relative to the pixel's ray: then an edge's value is one 2x2 determinant.
            ax, ay = _beside(vertices, a, P, u, v)
            bx, by = _beside(vertices, b, P, u, v)
            cx, cy = _beside(vertices, c, P, u, v)
            wa = bx * cy - by * cx
            wb = cx * ay - cy * ax
            wc = ax * by - ay * bx
            scale = 1 / (wa + wb + wc)
            for channel in range(image.shape[2]):
                value = (
                    wa * attributes[a, channel] + wb * attributes[b, channel] + wc * attributes[c, channel]
                )
                image[row, column, channel] = value * scale


@kernel
def _beside(vertices, n, P, u, v):
    """Pixel offsets of a vertex from (u, v), times its depth."""
    x = vertices[n, 0]
    y = vertices[n, 1]
    z = vertices[n, 2]
    depth = P[2, 0] * x + P[2, 1] * y + P[2, 2] * z + P[2, 3]
    across = P[0, 0] * x + P[0, 1] * y + P[0, 2] * z + P[0, 3]
    down = P[1, 0] * x + P[1, 1] * y + P[1, 2] * z + P[1, 3]
    return across - u * depth, down - v * depth
