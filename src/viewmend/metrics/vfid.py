"""VFID (Wang et al. 2018): how far apart two sets of videos are in the features of I3D. Lower is better.

As in the literature of video inpainting: Mixed_5c averaged over time and place is a video's one vector of 1024, images
are in [0, 1] (I3D was trained on [-1, 1]), and the distance is Frechet's between Gaussians. Published scripts forget
`eval()`, so that I3D normalises by each video's own statistics: "train". With few videos the value depends on their
number; compare only what was measured on the same ones.
"""

from collections.abc import Iterable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from viewmend.metrics.i3d import UNUSED, I3d
from viewmend.metrics.weights import checked_weights, known_weights
from viewmend.weight_files import load_weights

Mode = Literal["eval", "train"]
MODES: tuple[Mode, ...] = ("eval", "train")
"""I3D's normalisation by the statistics of its training, or of each video."""


def load_i3d(device: torch.device | str = "cpu") -> I3d:
    """I3D with the published weights.

    Raises:
        MissingWeightsError: its file is nowhere.
        WeightsError: the file is damaged or another than it should be.
    """
    return load_weights(I3d(), checked_weights(known_weights("i3d")), device, spare=UNUSED).requires_grad_(False)


@torch.no_grad()
def video_features(
    network: I3d, frames: Iterable[Float[Tensor, "3 height width"]], mode: Mode
) -> Float[Tensor, "1024"]:
    """The vector of one video of frames in [0, 1], all of a size; the network is left as it was."""
    video = torch.stack(list(frames), 1)[None].float()
    kept = {name: value.clone() for name, value in network.named_buffers()}
    network.train(mode == "train")
    found = network(video)
    network.eval()
    for name, value in network.named_buffers():
        value.copy_(kept[name])
    return found


def frechet_distance(a: Float[Tensor, "_n dim"], b: Float[Tensor, "_m dim"]) -> float | None:
    """Frechet's distance of Gaussians that are fitted to two sets of vectors; None for sets of fewer than two.

    |mean a - mean b|^2 + tr A + tr B - 2 tr (A B)^(1/2) for covariances A and B. With X^T X = (n - 1) A for the
    centred vectors X, and Y likewise, the last trace is the sum of the singular values of X Y^T, which is small.
    """
    if min(len(a), len(b)) < 2:
        return None
    a, b = a.double(), b.double()
    means = a.mean(0), b.mean(0)
    X, Y = (a - means[0]) / (len(a) - 1) ** 0.5, (b - means[1]) / (len(b) - 1) ** 0.5
    cross = torch.linalg.svdvals(X @ Y.T).sum()
    distance = (means[0] - means[1]).square().sum() + X.square().sum() + Y.square().sum() - 2 * cross
    return max(0.0, float(distance))
