"""Slow, obvious reference of viewmend.geometry.fusion.fuse_occupancy: one voxel, one view at a time."""

import numpy as np


def fuse_reference(hull, views, config):
    """The fused occupancy of a grid, float64."""
    values = hull.values.numpy()
    fused = np.zeros(values.shape)
    for index in np.ndindex(*values.shape):
        if values[index] > 0:
            point = hull.low.double().numpy() + (np.array(index) + 0.5) * hull.voxel_m
            fused[index] = min(values[index], left_by_views(point, hull.voxel_m, views, config))
    return fused


def left_by_views(point, voxel_m, views, config):
    """The occupancy that the views leave at a point in the hull."""
    distances = []
    weights = []
    for view in range(len(views.cameras)):
        pose = views.cameras.camera_from_world[view].double().numpy()
        x, y, z = views.cameras.K[view].double().numpy() @ (pose[:3, :3] @ point + pose[:3, 3])
        width, height = views.cameras.size_px[view].tolist()
        if z > 0 and 0 <= x / z < width and 0 <= y / z < height:
            row, column = int(y / z), int(x / z)
            surface = float(views.depth[view, row, column])
            distance = (surface - z) / voxel_m
            if surface > 0 and distance > -config.truncation_voxels:
                distances.append(min(distance, config.truncation_voxels))
                weights.append(
                    max(float(views.confidence[view, row, column]), 1e-3) ** config.confidence_power
                )

    if not weights:
        return 1.0
    return min(1.0, max(0.0, 0.5 - 0.5 * np.average(distances, weights=weights)))
