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
        box = pixel_box(a, b, c, near, (0, width), (first_row, end_row))
        if box[0] < box[1] and box[2] < box[3]:
            draw_face(a, b, c, f, near, cull, box, depth, triangle)
    for row in range(first_row, end_row):
        for column in range(width):
            if triangle[row, column] >= 0:
                depth[row, column] = np.float32(1) / depth[row, column]


@kernel
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
def draw_face(a, b, c, face, near, cull, box, depth, triangle):
    """Draw one face into the pixels of a box; `depth` gets 1 / z."""
    at_a = edge(b, c)
    at_b = edge(c, a)
    at_c = edge(a, b)
    determinant = a[0] * at_a[0] + a[1] * at_a[1] + a[2] * at_a[2]
    if determinant == 0 or determinant * cull > 0:
        return
    sign = 1.0 if determinant > 0 else -1.0
    for row in range(box[2], box[3]):
        v = row + 0.5
        a_row = at_a[1] * v + at_a[2]
        b_row = at_b[1] * v + at_b[2]
        c_row = at_c[1] * v + at_c[2]
        for column in range(box[0], box[1]):
            u = column + 0.5
            a_value = at_a[0] * u + a_row
            b_value = at_b[0] * u + b_row
            c_value = at_c[0] * u + c_row
            if a_value * sign >= 0 and b_value * sign >= 0 and c_value * sign >= 0:
                inverse = np.float32((a_value + b_value + c_value) / determinant)
                if inverse * near < 1 and inverse > depth[row, column]:
                    depth[row, column] = inverse
                    triangle[row, column] = face


@kernel(inline="always")
def edge(p, q):
    """The edge between two projected corners as the plane p x q over (u, v, 1)."""
    return p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]


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
