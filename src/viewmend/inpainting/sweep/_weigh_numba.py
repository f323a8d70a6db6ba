"""Weighs cameras at places along rays in numba, for the CPU; `PlaceNet` is the twin for any device and training."""

from math import exp
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from torch import Tensor

from viewmend.geometry.threads import parallel_for
from viewmend.inpainting.sweep.lookup import CONTRAST, FEATURES, IN_VIEW, Places

BAND = 64
"""Rays that a thread takes at a time."""


def weigh_numba(
    places: Places,
    prior: Float[Tensor, "ray place view"],
    hidden: Float[Tensor, "ray place view feature"],
    shared: Float[Tensor, "ray place feature"],
    weight: Float[Tensor, "feature"],
    bias: float,
) -> tuple[Float[Tensor, "ray place told"], Float[Tensor, "ray place view"]]:
    """What `PlaceNet.place` is told of each place, and the shares of the cameras.

    Args:
        places: what was looked up.
        prior: who is trusted at first.
        hidden: of each camera, before what is `shared` by all cameras is added; it is overwritten.
        shared: what the place's statistics add.
        weight: of the layer that says whom to trust.
        bias: of that layer.
    """
    count, each, views, width = hidden.shape
    told = np.zeros((count, each, width + FEATURES + 3 + places.stats.shape[2] + 1), np.float32)
    trust = np.empty((count, each, views), np.float32)
    tensors = (places.features, places.stats, prior, hidden, shared, weight)
    arrays = [*(tensor.numpy() for tensor in tensors), told, trust]

    def work(band: int) -> None:
        weigh(band * BAND, min(count, (band + 1) * BAND), bias, *arrays)

    parallel_for(work, -(-count // BAND))
    return torch.from_numpy(told), torch.from_numpy(trust)


# Without type checks: numba compiles the function itself, not what a checker wraps around it.


@njit(nogil=True, cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
@no_type_check
def weigh(first, end, bias, features, stats, prior, hidden, shared, weight, told, trust):
    """A softmax over the cameras that have the place in view, and sums over them, of rays first to end - 1."""
    _, places, views, width = hidden.shape
    shown, channels = features.shape[3], stats.shape[2]
    for ray in range(first, end):
        for place in range(places):
            row, shares = told[ray, place], trust[ray, place]
            most = np.float32(-1e30)
            for view in range(views):
                if features[ray, place, view, IN_VIEW] == 0:
                    continue
                own, score = hidden[ray, place, view], np.float32(bias)
                for c in range(width):
                    own[c] = max(np.float32(0), own[c] + shared[ray, place, c])
                    score += own[c] * weight[c]
                shares[view] = score
                most = max(most, score)
            total = np.float32(0)
            for view in range(views):
                if features[ray, place, view, IN_VIEW] == 0:
                    shares[view] = np.float32(0)
                    continue
                shares[view] = (prior[ray, place, view] + np.float32(1e-3)) * np.float32(exp(shares[view] - most))
                total += shares[view]
            certain = np.float32(0)
            for view in range(views):
                if shares[view] == 0:
                    continue
                share = shares[view] / total
                shares[view] = share
                certain += share * share
                own, seen_here = hidden[ray, place, view], features[ray, place, view]
                for c in range(width):
                    row[c] += share * own[c]
                for c in range(shown):
                    row[width + c] += share * seen_here[c]
                for c in range(3):
                    row[width + shown + c] += share * seen_here[c] * seen_here[c]
            for c in range(3):
                mean = row[width + c]
                square = row[width + shown + c]
                row[width + shown + c] = np.float32(CONTRAST) * max(np.float32(0), square - mean * mean)
            for c in range(channels):
                row[width + shown + 3 + c] = stats[ray, place, c]
            row[width + shown + 3 + channels] = certain
