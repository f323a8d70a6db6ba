"""Slow, obvious twin of viewmend.geometry.hull.visual_hull: one voxel, one camera at a time."""

import numpy as np
from scipy import ndimage


def hull_twin(mask, cameras, low, voxel_m, shape, pools, needed):
    """Occupancy of a grid from masks that are pooled and smoothed first."""
    soft = [soften(mask[v].numpy(), cameras.size_px[v].tolist(), pools[v]) for v in range(len(cameras))]
    values = np.zeros(shape)
    for index in np.ndindex(*shape):
        point = low.double().numpy() + (np.array(index) + 0.5) * voxel_m
        seen = [look_up(soft[v], cameras, v, point, pools[v]) for v in range(len(cameras))]
        seen = [value for value in seen if value is not None]
        values[index] = min(seen) if len(seen) >= needed else 0
    return values


def soften(image, size, pool):
    columns, rows = size
    pooled = np.zeros((-(-image.shape[0] // pool), -(-image.shape[1] // pool)))
    for y, x in np.ndindex(*pooled.shape):
        for j, i in np.ndindex(pool, pool):
            pooled[y, x] += image[min(y * pool + j, rows - 1), min(x * pool + i, columns - 1)] / pool**2
    smooth = ndimage.correlate(pooled, np.outer([1, 2, 1], [1, 2, 1]) / 16, mode="nearest")
    return np.round(smooth) / 255


def look_up(image, cameras, view, point, pool):
    """The mask's value where the camera sees the point, None if it does not."""
    pose = cameras.camera_from_world[view].double().numpy()
    x, y, z = cameras.K[view].double().numpy() @ (pose[:3, :3] @ point + pose[:3, 3])
    columns, rows = cameras.size_px[view].tolist()
    if z <= 0 or not (0 <= x / z < columns and 0 <= y / z < rows):
        return None
    at = [[y / z / pool - 0.5], [x / z / pool - 0.5]]
    return ndimage.map_coordinates(image, at, order=1, mode="nearest")[0]
