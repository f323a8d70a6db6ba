"""Pull and push, pixel by pixel."""

import torch


def pull_push_twin(rgb, known):
    """The pyramid of `pull_push`, by recursion: a coarser picture of the means of what is known, then filled."""
    height, width = known.shape
    if max(height, width) == 1:
        return rgb * known
    rows, cols = (height + 1) // 2, (width + 1) // 2
    coarse, seen = torch.zeros(len(rgb), rows, cols), torch.zeros(rows, cols, dtype=torch.bool)
    for r in range(rows):
        for c in range(cols):
            block = (slice(2 * r, 2 * r + 2), slice(2 * c, 2 * c + 2))
            if known[block].any():
                seen[r, c] = True
                coarse[:, r, c] = rgb[:, *block][:, known[block]].mean(1)
    filled = pull_push_twin(coarse, seen)
    out = rgb.clone()
    for y in range(height):
        for x in range(width):
            if not known[y, x]:
                v = max((y + 0.5) * rows / height - 0.5, 0)
                u = max((x + 0.5) * cols / width - 0.5, 0)
                r, c = int(v), int(u)
                r2, c2 = min(r + 1, rows - 1), min(c + 1, cols - 1)
                top = filled[:, r, c] * (1 - (u - c)) + filled[:, r, c2] * (u - c)
                bottom = filled[:, r2, c] * (1 - (u - c)) + filled[:, r2, c2] * (u - c)
                out[:, y, x] = top * (1 - (v - r)) + bottom * (v - r)
    return out
