"""Slow, obvious twins of the published networks' own operations: one pixel, one patch, one window at a time."""

import math

import torch


def bilinear_twin(image, y, x):
    """Image [channel height width] at a place between its pixels, zero outside."""
    total = torch.zeros(image.shape[0])
    for row in (math.floor(y), math.floor(y) + 1):
        for col in (math.floor(x), math.floor(x) + 1):
            if 0 <= row < image.shape[1] and 0 <= col < image.shape[2]:
                total = total + (1 - abs(y - row)) * (1 - abs(x - col)) * image[:, row, col]
    return total


def deformable_twin(x, offsets, masks, weight, bias):
    """One image; offsets [2 * groups * points] as (down, right) pairs, masks [groups * points]."""
    kernel, (height, width) = weight.shape[-1], x.shape[1:]
    points = kernel**2
    groups = len(masks) // points
    share = x.shape[0] // groups
    out = bias.repeat(height, width, 1).permute(2, 0, 1).clone()
    for row in range(height):
        for col in range(width):
            for g in range(groups):
                for k in range(points):
                    down, right = offsets[2 * (g * points + k)], offsets[2 * (g * points + k) + 1]
                    y = row + k // kernel - kernel // 2 + float(down[row, col])
                    at = col + k % kernel - kernel // 2 + float(right[row, col])
                    read = (
                        bilinear_twin(x[g * share : (g + 1) * share], y, at) * masks[g * points + k, row, col]
                    )
                    own = weight[:, g * share : (g + 1) * share, k // kernel, k % kernel]
                    out[:, row, col] += own @ read
    return out


def patches_twin(features, patch=7, step=3, margin=3):
    """Features [channel height width] -> patches [rows cols channel * patch * patch], zeros around."""
    height, width = features.shape[1:]
    rows, cols = (height - 1) // step + 1, (width - 1) // step + 1
    patches = torch.zeros(rows, cols, features.shape[0], patch, patch)
    for r in range(rows):
        for c in range(cols):
            for i in range(patch):
                for j in range(patch):
                    y, x = r * step - margin + i, c * step - margin + j
                    if 0 <= y < height and 0 <= x < width:
                        patches[r, c, :, i, j] = features[:, y, x]
    return patches.flatten(2)


def added_up_twin(patches, size, patch=7, step=3, margin=3):
    """Patches [rows cols channel * patch * patch] -> (sum, count of patches) of each cell of a map of this size."""
    rows, cols, length = patches.shape
    parts = patches.view(rows, cols, length // patch**2, patch, patch)
    total, count = torch.zeros(parts.shape[2], *size), torch.zeros(size)
    for r in range(rows):
        for c in range(cols):
            for i in range(patch):
                for j in range(patch):
                    y, x = r * step - margin + i, c * step - margin + j
                    if 0 <= y < size[0] and 0 <= x < size[1]:
                        total[:, y, x] += parts[r, c, :, i, j]
                        count[y, x] += 1
    return total, count


def window_keys_twin(grid, row, col, window=(5, 9)):
    """The fine places, as (row, column), that window (row, col) of a grid of windows looks at in each frame.

    Its own, then for each of four windows half a window off, diagonally, those outside of the own one; what leaves the
    frame comes in on the other side.
    """
    height, width = window
    top, left = row * height, col * width
    places = [(top + y, left + x) for y in range(height) for x in range(width)]
    for down in (height // 2, -(height // 2)):
        for right in (width // 2, -(width // 2)):
            moved = [(y + down, x + right) for y in range(height) for x in range(width)]
            places += [(top + y, left + x) for y, x in moved if not (0 <= y < height and 0 <= x < width)]
    return [(y % (grid[0] * height), x % (grid[1] * width)) for y, x in places]


def focal_attention_twin(attention, frames, window=(5, 9)):
    """What the tokens of frame 0 see in all `frames`, each (fine [row column dim], pooled [row column dim])."""
    fine, pooled = frames[0]
    dim, heads = fine.shape[-1], attention.heads
    grid = pooled.shape[:2]
    qkv = lambda token: (attention.qkv.weight @ token + attention.qkv.bias).split(dim)  # noqa: E731
    out = torch.zeros_like(fine)
    for row in range(grid[0]):
        for col in range(grid[1]):
            keys, values = [], []
            for tokens, small in frames:
                seen = [tokens[y, x] for y, x in window_keys_twin(grid, row, col, window)]
                near = [y for y in range(grid[0]) if abs(y - row) <= window[0] // 2]
                beside = [x for x in range(grid[1]) if abs(x - col) <= window[1] // 2]
                seen += [small[y, x] for y in near for x in beside]
                for token in seen:
                    _, key, value = qkv(token)
                    keys.append(key.view(heads, -1))
                    values.append(value.view(heads, -1))
            K, V = torch.stack(keys, 1), torch.stack(values, 1)
            for y in range(window[0]):
                for x in range(window[1]):
                    at = row * window[0] + y, col * window[1] + x
                    query = qkv(fine[at])[0].view(heads, -1)
                    odds = ((K * query[:, None]).sum(-1) / math.sqrt(dim / heads)).softmax(-1)
                    mixed = (odds[..., None] * V).sum(1).flatten()
                    out[at] = attention.proj.weight @ mixed + attention.proj.bias
    return out
