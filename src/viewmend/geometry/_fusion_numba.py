"""Depth fusion on the CPU."""

import numpy as np

from viewmend.utils.compiled import kernel


@kernel
def sum_distances(slab, occupancy, P, size_px, low, depth, confidence, voxel_m, truncation_voxels, sums):
    """Add up what the views say about the voxels of one slab along x, where the hull's occupancy is not 0.

    `sums` gets three numbers for each voxel: the sum of the distances, weighted by the confidence; the
    sum of the confidence; and the number of views.
    """
    views = P.shape[0]
    x = low[0] + (slab + 0.5) * voxel_m
    for j in range(occupancy.shape[1]):
        y = low[1] + (j + 0.5) * voxel_m
        for k in range(occupancy.shape[2]):
            if occupancy[slab, j, k] <= 0:
                continue
            z = low[2] + (k + 0.5) * voxel_m
            summed = 0.0
            total = 0.0
            count = 0
            for view in range(views):
                p = P[view]
                ahead = p[2, 0] * x + p[2, 1] * y + p[2, 2] * z + p[2, 3]
                if ahead <= 0:
                    continue
                u = (p[0, 0] * x + p[0, 1] * y + p[0, 2] * z + p[0, 3]) / ahead
                v = (p[1, 0] * x + p[1, 1] * y + p[1, 2] * z + p[1, 3]) / ahead
                if u < 0 or v < 0 or u >= size_px[view, 0] or v >= size_px[view, 1]:
                    continue

                row = np.int64(v)
                column = np.int64(u)
                surface = depth[view, row, column]
                if surface <= 0:
                    continue
                distance = (surface - ahead) / voxel_m
                if distance > -truncation_voxels:
                    weight = confidence[view, row, column]
                    summed += weight * min(distance, truncation_voxels)
                    total += weight
                    count += 1
            sums[0, slab, j, k] = summed
            sums[1, slab, j, k] = total
            sums[2, slab, j, k] = count


@kernel
def vote(slab, occupancy, sums, hull_weight, smooth_below, sharp_above, fused):
    """Fill one slab of the fused occupancy, from what `sum_distances` found in the hull.

    Sums of neighbours beyond the grid count as 0, as in the mean over all voxels of `_vote_torch`.
    """
    rows = occupancy.shape[1]
    columns = occupancy.shape[2]
    for j in range(rows):
        for k in range(columns):
            filled = occupancy[slab, j, k]
            if filled <= 0:
                continue
            distances = sums[0, slab, j, k]
            weights = sums[1, slab, j, k]
            mean_confidence = weights / max(sums[2, slab, j, k], 1.0)
            sharp = min(max((mean_confidence - smooth_below) / (sharp_above - smooth_below), 0.0), 1.0)

            # the mean over 27 voxels, where depth is uncertain
            if sharp < 1:
                distances_around = 0.0
                weights_around = 0.0
                for x in range(max(slab - 1, 0), min(slab + 2, occupancy.shape[0])):
                    for y in range(max(j - 1, 0), min(j + 2, rows)):
                        for z in range(max(k - 1, 0), min(k + 2, columns)):
                            distances_around += sums[0, x, y, z]
                            weights_around += sums[1, x, y, z]
                distances = sharp * distances + (1 - sharp) * distances_around / 27
                weights = sharp * weights + (1 - sharp) * weights_around / 27

            distance = (distances + hull_weight * (1 - 2 * filled)) / (weights + hull_weight)
            fused[slab, j, k] = min(filled, max(0.5 - 0.5 * distance, 0.0))
