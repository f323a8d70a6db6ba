"""VFID (Wang et al. 2018): Frechet distance between two sets of videos in the features of I3D. Lower is better.

As usual in video inpainting: the feature vector of a video is I3D's Mixed_5c, averaged over time
and space (1024 numbers), and images are in [0, 1], although I3D was trained on [-1, 1]. Published
scripts do not call `eval()`, so that I3D normalises with the statistics of each video: mode
"train". The value depends on the number of videos: compare only results of the same set.

I3D (Carreira & Zisserman 2017) has the key names of piergiaj/pytorch-i3d.
"""

from collections.abc import Iterable, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.metrics.weights import checked_weights, known_weights
from viewmend.utils.weight_files import construct, load_weights

Mode = Literal["eval", "train"]
MODES: tuple[Mode, ...] = ("eval", "train")
"""Normalisation with the statistics of I3D's training, or with the statistics of each video."""
Triple = tuple[int, ...]
MIXED: dict[str, tuple[int, Sequence[int]]] = {
    "Mixed_3b": (192, (64, 96, 128, 16, 32, 32)),
    "Mixed_3c": (256, (128, 128, 192, 32, 96, 64)),
    "Mixed_4b": (480, (192, 96, 208, 16, 48, 64)),
    "Mixed_4c": (512, (160, 112, 224, 24, 64, 64)),
    "Mixed_4d": (512, (128, 128, 256, 24, 64, 64)),
    "Mixed_4e": (512, (112, 144, 288, 32, 64, 64)),
    "Mixed_4f": (528, (256, 160, 320, 32, 128, 128)),
    "Mixed_5b": (832, (256, 160, 320, 32, 128, 128)),
    "Mixed_5c": (832, (384, 192, 384, 48, 128, 128)),
}
"""Input channels, and the channels of the branches: 1x1; 1x1 then 3x3; 1x1 then 3x3; pooling then 1x1."""
POOL_BEFORE: dict[str, tuple[Triple, Triple]] = {
    "Conv3d_2b_1x1": ((1, 3, 3), (1, 2, 2)),
    "Mixed_3b": ((1, 3, 3), (1, 2, 2)),
    "Mixed_4b": ((3, 3, 3), (2, 2, 2)),
    "Mixed_5b": ((2, 2, 2), (2, 2, 2)),
}
"""Kernel and stride of the pooling in front of a layer."""


class I3d(nn.Module):
    """I3D up to Mixed_5c."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv3d_1a_7x7 = _Unit(3, 64, 7, 2)
        self.Conv3d_2b_1x1 = _Unit(64, 64, 1)
        self.Conv3d_2c_3x3 = _Unit(64, 192, 3)
        for name, (before, channels) in MIXED.items():
            self.add_module(name, _Mixed(before, channels))

    def forward(self, video: Float[Tensor, "1 3 time height width"]) -> Float[Tensor, "1024"]:
        """Mixed_5c, averaged over time and space."""
        for name, layer in self.named_children():
            if name in POOL_BEFORE:
                video = _pool(video, *POOL_BEFORE[name])
            video = layer(video)
        return video.mean((0, 2, 3, 4))


def load_i3d(device: torch.device | str = "cpu") -> I3d:
    """I3D with the published weights.

    Raises:
        MissingWeightsError: the file is not installed.
        WeightsError: the file is damaged or a different one.
    """
    path = checked_weights(known_weights("i3d"))
    return load_weights(construct(I3d), path, device).requires_grad_(False)


@torch.no_grad()
def video_features(
    network: I3d, frames: Iterable[Float[Tensor, "3 height width"]], mode: Mode
) -> Float[Tensor, "1024"]:
    """The feature vector of one video of equally sized frames in [0, 1]; leaves the network unchanged."""
    video = torch.stack(list(frames), 1)[None].float()
    kept = {name: value.clone() for name, value in network.named_buffers()}
    network.train(mode == "train")
    found = network(video)
    network.eval()
    for name, value in network.named_buffers():
        value.copy_(kept[name])
    return found


def frechet_distance(a: Float[Tensor, "_n dim"], b: Float[Tensor, "_m dim"]) -> float | None:
    """Frechet distance of the Gaussians fitted to two sets of vectors; None for sets of fewer than two.

    |mean a - mean b|^2 + tr A + tr B - 2 tr (A B)^(1/2) for covariances A and B. With X^T X = (n - 1) A for the
    centred vectors X, and Y likewise, the last trace is the sum of the singular values of the small matrix X Y^T.
    """
    if min(len(a), len(b)) < 2:
        return None
    a = a.double()
    b = b.double()
    means = a.mean(0), b.mean(0)
    X = (a - means[0]) / (len(a) - 1) ** 0.5
    Y = (b - means[1]) / (len(b) - 1) ** 0.5
    cross = torch.linalg.svdvals(X @ Y.T).sum()
    distance = (means[0] - means[1]).square().sum() + X.square().sum() + Y.square().sum() - 2 * cross
    return max(0.0, float(distance))


class _Unit(nn.Module):
    """Convolution, batch normalisation, ReLU."""

    def __init__(self, before: int, channels: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv3d = nn.Conv3d(before, channels, kernel, stride, bias=False)
        self.bn = nn.BatchNorm3d(channels, eps=1e-3, momentum=0.01)

    def forward(self, x: Tensor) -> Tensor:
        kernel = self.conv3d.kernel_size[0]
        stride = self.conv3d.stride[0]
        return F.relu(self.bn(self.conv3d(_pad_same(x, (kernel,) * 3, (stride,) * 3))))


class _Mixed(nn.Module):
    """Four parallel branches."""

    def __init__(self, before: int, channels: Sequence[int]) -> None:
        super().__init__()
        self.b0 = _Unit(before, channels[0], 1)
        self.b1a = _Unit(before, channels[1], 1)
        self.b1b = _Unit(channels[1], channels[2], 3)
        self.b2a = _Unit(before, channels[3], 1)
        self.b2b = _Unit(channels[3], channels[4], 3)
        self.b3b = _Unit(before, channels[5], 1)

    def forward(self, x: Tensor) -> Tensor:
        pooled = _pool(x, (3, 3, 3), (1, 1, 1))
        return torch.cat([self.b0(x), self.b1b(self.b1a(x)), self.b2b(self.b2a(x)), self.b3b(pooled)], 1)


def _pool(x: Tensor, kernel: Triple, stride: Triple) -> Tensor:
    return F.max_pool3d(_pad_same(x, kernel, stride), kernel, stride)


def _pad_same(x: Tensor, kernel: Triple, stride: Triple) -> Tensor:
    """Zero padding as TensorFlow's "same": an odd pixel goes to the end. Pooled values are never below 0."""
    pads: list[int] = []
    for size, k, s in zip(x.shape[-1:1:-1], kernel[::-1], stride[::-1], strict=True):
        extra = max(k - (size % s or s), 0)
        pads += [extra // 2, extra - extra // 2]
    return F.pad(x, pads)
