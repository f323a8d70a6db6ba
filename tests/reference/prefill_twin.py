"""Pull and push, pixel by pixel."""

import math

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


def fill_twin(rgb: torch.Tensor, missing: torch.Tensor, subject: torch.Tensor) -> torch.Tensor:
    """The smooth fill, pixel by pixel."""
    height, width = missing.shape

    def is_missing(row: int, col: int) -> bool:
        return not (0 <= row < height and 0 <= col < width) or bool(missing[row, col])

    def is_wide(row: int, col: int) -> bool:
        """Whether a square of 5 x 5 missing pixels covers it."""
        centers = [(row + i, col + j) for i in range(-2, 3) for j in range(-2, 3)]
        centers = [(r, c) for r, c in centers if 0 <= r < height and 0 <= c < width]
        return any(all(is_missing(r + i, c + j) for i in range(-2, 3) for j in range(-2, 3)) for r, c in centers)

    def mean_around(row: int, col: int, known: torch.Tensor) -> torch.Tensor | None:
        colour, weight = torch.zeros(3), 0.0
        for r in range(max(row - 2, 0), min(row + 3, height)):
            for c in range(max(col - 2, 0), min(col + 3, width)):
                if known[r, c]:
                    share = math.exp(-((r - row) ** 2 + (c - col) ** 2) / 2)
                    colour, weight = colour + share * rgb[:, r, c], weight + share
        return colour / weight if weight else None

    filled, of_subject, deep = rgb.clone(), rgb.clone(), torch.zeros_like(missing)
    for row, col in torch.nonzero(missing).tolist():
        near = mean_around(row, col, ~missing & subject)
        deep[row, col] = near is None
        of_subject[:, row, col] = rgb[:, row, col] if near is None else near
    far = pull_push_twin(of_subject * (~deep & subject), ~deep & subject)
    for row, col in torch.nonzero(missing).tolist():
        if is_wide(row, col):
            filled[:, row, col] = (far if deep[row, col] else of_subject)[:, row, col]
        else:
            near = mean_around(row, col, ~missing)
            assert near is not None, "beside a thin hole something is known"
            filled[:, row, col] = near
    return filled
