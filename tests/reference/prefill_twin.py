"""Pull and push, pixel by pixel."""

import torch
from torch.nn.functional import interpolate


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
    filled = interpolate(pull_push_twin(coarse, seen)[None], (height, width), mode="bilinear")[0]
    return torch.where(known, rgb, filled)
