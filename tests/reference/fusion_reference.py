"""Slow, obvious reference of fusing depth and of keeping the last surface: one voxel, one view at a time."""

import itertools

import numpy as np


def fuse_reference(hull, views, config):
    """The fused occupancy of a grid, float64."""
    values = hull.values.numpy()
    sums = np.zeros((*values.shape, 3))
    for index in np.ndindex(*values.shape):
        if values[index] > 0:
            point = hull.low.double().numpy() + (np.array(index) + 0.5) * hull.voxel_m
            sums[index] = sums_at(point, hull.voxel_m, views, config)

    fused = np.zeros(values.shape)
    for index in np.ndindex(*values.shape):
        if values[index] > 0:
            distance, confidence = smoothed(sums, index, config)
            hull_distance = 1 - 2 * values[index]
            mean = (distance + config.hull_weight * hull_distance) / (confidence + config.hull_weight)
            fused[index] = min(values[index], max(0.0, 0.5 - 0.5 * mean))
    return fused


def smoothed(sums, index, config):
    """The sums of weighted distances and of confidence at a voxel, mixed with the means around it."""
    distance, confidence, count = sums[index]
    around = np.zeros(2)
    for step in itertools.product((-1, 0, 1), repeat=3):
        at = np.array(index) + step
        if (at >= 0).all() and (at < sums.shape[:3]).all():
            around += sums[tuple(at)][:2] / 27
    mean_confidence = confidence / max(count, 1)
    sharp = (mean_confidence - config.smooth_below) / (config.sharp_above - config.smooth_below)
    sharp = min(1.0, max(0.0, sharp))
    return sharp * np.array([distance, confidence]) + (1 - sharp) * around


def sums_at(point, voxel_m, views, config):
    """The sum of weighted distances, the sum of confidence, and the number of views at a point in the hull."""
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
                weights.append(max(float(views.confidence[view, row, column]), 1e-3))
    return np.dot(distances, weights), sum(weights), len(weights)


def steadied_reference(fused, hull, last, share, behind_m):
    """The occupancy averaged with the last surface's, float64."""
    values = fused.values.double().numpy().copy()
    for index in np.ndindex(*values.shape):
        if hull.values[index] > 0:
            point = fused.low.double().numpy() + (np.array(index) + 0.5) * fused.voxel_m
            before = interpolated(last.occupancy, point)
            values[index] += share * stillness_at(point, last, behind_m) * (before - values[index])
            values[index] = min(values[index], float(hull.values[index]))
    return values


def interpolated(grid, point):
    """The occupancy of a grid at a point, trilinear; voxels beyond the grid are 0."""
    place = (point - grid.low.double().numpy()) / grid.voxel_m - 0.5
    first = np.floor(place).astype(int)
    found = 0.0
    for step in itertools.product((0, 1), repeat=3):
        at = first + step
        if (at >= 0).all() and (at < grid.values.shape).all():
            weight = np.prod(np.where(step, place - first, 1 - (place - first)))
            found += weight * float(grid.values[tuple(at)])
    return found


def stillness_at(point, last, behind_m):
    """The least stillness in the cameras that see a point; in all, if none does."""
    seen = [1.0]
    every = [1.0]
    hidden = True
    for view in range(len(last.cameras)):
        pose = last.cameras.camera_from_world[view].double().numpy()
        x, y, z = last.cameras.K[view].double().numpy() @ (pose[:3, :3] @ point + pose[:3, 3])
        width, height = last.cameras.size_px[view].tolist()
        if z > 0 and 0 <= x / z < width and 0 <= y / z < height:
            row, column = int(y / z), int(x / z)
            still = float(last.stillness[view, row, column])
            surface = float(last.depth[view, row, column])
            every.append(still)
            if surface == 0 or z < surface + behind_m:
                seen.append(still)
                hidden = False
    return min(every) if hidden else min(seen)
