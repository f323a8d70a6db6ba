"""Marching cubes and vertex normals on the CPU: one thread, so that a busy machine does not stall them."""

import numpy as np

from viewmend.utils.compiled import kernel


@kernel
def count_crossings(values, iso):
    """How many grid edges the surface crosses."""
    count = 0
    for x in range(values.shape[0]):
        for y in range(values.shape[1]):
            for z in range(values.shape[2]):
                inside = values[x, y, z] > iso
                if x + 1 < values.shape[0]:
                    count += inside != (values[x + 1, y, z] > iso)
                if y + 1 < values.shape[1]:
                    count += inside != (values[x, y + 1, z] > iso)
                if z + 1 < values.shape[2]:
                    count += inside != (values[x, y, z + 1] > iso)
    return count


@kernel
def place_crossings(values, iso, vertices, vertex_of_edge):
    """Where the surface crosses the grid's edges, in voxels: all edges along x first, then y, then z."""
    count = 0
    for axis in range(3):
        dx = int(axis == 0)
        dy = int(axis == 1)
        dz = int(axis == 2)
        for x in range(values.shape[0] - dx):
            for y in range(values.shape[1] - dy):
                for z in range(values.shape[2] - dz):
                    near = values[x, y, z]
                    far = values[x + dx, y + dy, z + dz]
                    if (near > iso) != (far > iso):
                        along = (np.float32(iso) - near) / (far - near)
                        vertices[count, 0] = x + dx * along
                        vertices[count, 1] = y + dy * along
                        vertices[count, 2] = z + dz * along
                        vertex_of_edge[axis, x, y, z] = count
                        count += 1


@kernel
def connect(values, iso, table, edge_starts, vertex_of_edge, faces):
    """The triangles of all cells; returns how many. `edge_starts[e]` is where edge e starts, after its axis."""
    count = 0
    for x in range(values.shape[0] - 1):
        for y in range(values.shape[1] - 1):
            for z in range(values.shape[2] - 1):
                case = 0
                for k in range(8):
                    if values[x + (k & 1), y + (k >> 1 & 1), z + (k >> 2 & 1)] > iso:
                        case |= 1 << k
                if case == 0 or case == 255:
                    continue
                for slot in range(table.shape[1]):
                    if table[case, slot, 0] < 0:
                        break
                    for corner in range(3):
                        axis, dx, dy, dz = edge_starts[table[case, slot, corner]]
                        faces[count, corner] = vertex_of_edge[axis, x + dx, y + dy, z + dz]
                    count += 1
    return count


@kernel
def sum_face_normals(vertices, faces, normals):
    """Add each face's normal, as long as twice its area, to its corners, and make the sums unit vectors."""
    for f in range(faces.shape[0]):
        a = vertices[faces[f, 0]]
        b = vertices[faces[f, 1]]
        c = vertices[faces[f, 2]]
        ux = b[0] - a[0]
        uy = b[1] - a[1]
        uz = b[2] - a[2]
        vx = c[0] - a[0]
        vy = c[1] - a[1]
        vz = c[2] - a[2]
        nx = uy * vz - uz * vy
        ny = uz * vx - ux * vz
        nz = ux * vy - uy * vx
        for corner in range(3):
            at = faces[f, corner]
            normals[at, 0] += nx
            normals[at, 1] += ny
            normals[at, 2] += nz
    for at in range(normals.shape[0]):
        length = np.sqrt(normals[at, 0] ** 2 + normals[at, 1] ** 2 + normals[at, 2] ** 2)
        if length > 0:
            for k in range(3):
                normals[at, k] /= length
