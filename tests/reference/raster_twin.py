"""Slow, obvious twin of viewmend.geometry.rasterize.rasterize: a ray through each pixel against all triangles."""

import numpy as np


def raster_twin(mesh, cameras, cull="none"):
    """Depth and triangle of each pixel, and how far (in barycentric terms) the decision was from changing."""
    width, height = cameras.max_size_px
    depth = np.zeros((len(cameras), height, width))
    triangle = np.full(depth.shape, -1)
    margin = np.full(depth.shape, np.inf)
    for view in range(len(cameras)):
        K = cameras.K[view].double().numpy()
        pose = cameras.camera_from_world[view].double().numpy()
        corners = mesh.vertices.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
        triangles = corners[mesh.faces.numpy()]
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        facing = (normals * triangles[:, 0]).sum(1)  # negative: turned to the camera at the origin
        drawn = {"none": facing != 0, "back": facing < 0, "front": facing > 0}[cull]
        columns, rows = cameras.size_px[view].tolist()
        for y in range(rows):
            for x in range(columns):
                ray = np.linalg.inv(K) @ [x + 0.5, y + 0.5, 1]
                z = facing / (normals @ ray)
                weights = np.linalg.solve(triangles.swapaxes(1, 2), (ray * z[:, None])[..., None])[
                    ..., 0
                ].min(1)
                possible = drawn & (z > 0)
                margin[view, y, x] = np.abs(weights[possible]).min(initial=np.inf)
                hits = np.flatnonzero(possible & (weights >= 0))
                if len(hits):
                    nearest = hits[z[hits].argmin()]
                    depth[view, y, x], triangle[view, y, x] = z[nearest], nearest
    return depth, triangle, margin
