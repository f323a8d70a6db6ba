"""A clean plate of frames that all show the subject: stitched of blocks, each of times at which nobody is there.

Where most frames show the background the median finds it. A subject who stays in one place hides it for longer than
that, and moves on for a moment. Blocks that look the same at nearly all times are background; from there the plate
grows block by block, each time by the look of a block (a cluster of times) that goes on best from its neighbours.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from viewmend.capture.masks.maker import Rgb

WORKED_PX = 720
"""Looks are compared in images of this longer side; the plate is as large as the images."""
BLOCK_PX = 12
"""Side of a block there."""
SAME = 6.0
"""Two looks are one whose mean colours differ by less; twice as much may their pixels differ."""
ALWAYS = 0.97
"""A look at so great a share of the times is background."""
MOST_LOOKS = 12
"""The most frequent looks of a block that are tried."""
RARE = 6.0
"""How much of a step at its sides a look that is never there costs."""
SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))
LONELY = 4.0
"""What a block's turn is put off by for each side without a neighbour."""
CLEAR, MOST_CLEAR = 0.3, 40.0
"""A block comes the sooner, the worse its second best look is."""

Blocks = Float32[np.ndarray, "look side side 3"]


@dataclass
class _Looks:
    """What a block looks like, and when."""

    means: Blocks
    times: list[list[int]]

    def share(self, of: int) -> Float32[np.ndarray, "look"]:
        return np.array([len(times) / of for times in self.times], np.float32)


def stitched_plate(images: Sequence[Rgb]) -> Rgb:
    """The plate of a camera from frames that may all show the subject, if each place is free at some of them.

    What is hidden at all times stays in it.

    Raises:
        ValueError: there is no image.
    """
    if not images:
        raise ValueError("expected at least one image to make a plate of, got none; choose other frames")
    looks = _all_looks(images)
    return _composed(images, _chosen(looks, len(images)), looks)


def _all_looks(images: Sequence[Rgb]) -> dict[tuple[int, int], _Looks]:
    import cv2

    height, width = images[0].shape[:2]
    scale = min(1.0, WORKED_PX / max(height, width))
    rows, columns = (max(1, round(side * scale / BLOCK_PX)) for side in (height, width))
    size = columns * BLOCK_PX, rows * BLOCK_PX
    small = [cv2.GaussianBlur(cv2.resize(i, size, interpolation=cv2.INTER_AREA), (0, 0), 1.0) for i in images]
    stack = np.stack(small).reshape(len(images), rows, BLOCK_PX, columns, BLOCK_PX, 3)
    found = {}
    for row, column in np.ndindex(rows, columns):
        found[row, column] = _looks_of(stack[:, row, :, column].astype(np.float32))
    return found


def _looks_of(blocks: Float32[np.ndarray, "time side side 3"]) -> _Looks:
    """Clusters of times, the first look like each time's taking it; the most frequent, and all that are seen twice."""
    means: list[np.ndarray] = []
    times: list[list[int]] = []
    for time, block in enumerate(blocks):
        for look, mean in enumerate(means):
            off = np.abs(block - mean)
            if off.mean((0, 1)).max() < SAME and off.max(-1).mean() < 2 * SAME:
                times[look].append(time)
                means[look] = mean + (block - mean) / len(times[look])
                break
        else:
            means.append(block)
            times.append([time])
    order = sorted(range(len(means)), key=lambda look: -len(times[look]))
    kept = [look for look in order[:MOST_LOOKS] if len(times[look]) > 1] or order[:1]
    return _Looks(np.stack([means[look] for look in kept]), [times[look] for look in kept])


def _chosen(looks: dict[tuple[int, int], _Looks], count: int) -> dict[tuple[int, int], int]:
    """The look of each block that is background."""
    chosen = {place: 0 for place, own in looks.items() if len(own.times[0]) >= ALWAYS * count}
    if not chosen:  # everything moves: begin where most is known
        chosen = {max(looks, key=lambda place: len(looks[place].times[0])): 0}
    turns: dict[tuple[int, int], tuple[float, int]] = {}

    def judge(place: tuple[int, int]) -> None:
        around = [(side, chosen.get((place[0] + side[0], place[1] + side[1]))) for side in SIDES]
        steps = [
            _step(looks[place].means, side, looks[place[0] + side[0], place[1] + side[1]].means[look])
            for side, look in around
            if look is not None
        ]
        cost = np.mean(steps, 0) + RARE * (1 - looks[place].share(count))
        best = int(cost.argmin())
        second = float(np.delete(cost, best).min() - cost[best]) if len(cost) > 1 else MOST_CLEAR
        turn = float(cost[best]) + LONELY * (len(SIDES) - len(steps)) - CLEAR * min(second, MOST_CLEAR)
        turns[place] = turn, best

    for place in set(_beside(chosen, looks)):
        judge(place)
    while turns:
        place = min(turns, key=lambda place: turns[place])
        chosen[place] = turns.pop(place)[1]
        for other in _beside([place], looks):
            if other not in chosen:
                judge(other)
    return chosen


def _beside(places, looks: dict[tuple[int, int], _Looks]) -> Iterator[tuple[int, int]]:
    known = set(places)
    for row, column in places:
        for down, right in SIDES:
            if (other := (row + down, column + right)) in looks and other not in known:
                yield other


def _step(
    looks: Blocks, side: tuple[int, int], neighbour: Float32[np.ndarray, "side side 3"]
) -> Float32[np.ndarray, "look"]:
    """The mean step in colour over a block's side to its neighbour, of each look, both continued to the border."""
    if side[0]:
        own, other = (looks[:, 0], looks[:, 1]), (neighbour[-1], neighbour[-2])
        if side[0] > 0:
            own, other = (looks[:, -1], looks[:, -2]), (neighbour[0], neighbour[1])
    else:
        own, other = (looks[:, :, 0], looks[:, :, 1]), (neighbour[:, -1], neighbour[:, -2])
        if side[1] > 0:
            own, other = (looks[:, :, -1], looks[:, :, -2]), (neighbour[:, 0], neighbour[:, 1])
    edge = 1.5 * own[0] - 0.5 * own[1] - (1.5 * other[0] - 0.5 * other[1])
    return np.abs(edge).sum(-1).mean(-1).astype(np.float32)


def _composed(images: Sequence[Rgb], chosen: dict[tuple[int, int], int], looks: dict[tuple[int, int], _Looks]) -> Rgb:
    """Each block as the median of the images at the times of its look, at full size."""
    plate = images[0].copy()
    height, width = plate.shape[:2]
    rows, columns = (max(place[axis] for place in looks) + 1 for axis in (0, 1))
    for (row, column), look in chosen.items():
        top, bottom = row * height // rows, (row + 1) * height // rows
        left, right = column * width // columns, (column + 1) * width // columns
        times = looks[row, column].times[look]
        plate[top:bottom, left:right] = np.median([images[t][top:bottom, left:right] for t in times], axis=0)
    return plate
