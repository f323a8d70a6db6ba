"""Slow reference of patches: one at a time."""

import torch


def split_reference(maps, places, size, step):
    return torch.stack(
        [maps[v, :, r * step : r * step + size, c * step : c * step + size] for v, r, c in places.tolist()]
    )


def merge_reference(patches, places, shape, step):
    views, height, width = shape
    channels, size = patches.shape[1:3]
    total = torch.zeros(views, channels, height, width)
    weight = torch.zeros(views, height, width)
    for patch, (view, row, col) in zip(patches, places.tolist(), strict=True):
        for i in range(size):
            for j in range(size):
                y, x = row * step + i, col * step + j
                if y < height and x < width:
                    share = min(i + 0.5, size - i - 0.5) * min(j + 0.5, size - j - 0.5)
                    total[view, :, y, x] += share * patch[:, i, j]
                    weight[view, y, x] += share
    covered = weight > 0
    return torch.where(covered[:, None], total / weight.clamp_min(1e-9)[:, None], 0.0), covered.float()


def any_in_patch_reference(pixels, rows, cols):
    result = torch.zeros(len(pixels), rows, cols, dtype=torch.bool)
    for row in range(rows):
        for col in range(cols):
            result[:, row, col] = (
                pixels[:, row * 16 : row * 16 + 28, col * 16 : col * 16 + 28].flatten(1).any(1)
            )
    return result
