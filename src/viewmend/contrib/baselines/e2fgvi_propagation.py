"""E2FGVI's optical flow (SPyNet), and the propagation of features along it, backward in time and then forward."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

import torch
from einops import rearrange, repeat
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.sampling import sample_bilinear

LEVELS = 6
CHANNELS = (8, 32, 64, 32, 16, 2)
"""Channels of one level: from both images and the flow so far to the flow's correction."""
MULTIPLE = 2 ** (LEVELS - 1)
"""Sizes that halve at each level."""
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
GROUPS = 16
"""Number of channel groups with offsets of their own."""
POINTS = 9
"""Number of points of a 3 x 3 kernel."""
REACH_PX = 10.0
"""Largest displacement of a kernel point from the flow's target, pixels."""
Feature = Float[Tensor, "sample channel height width"]
Flow = Float[Tensor, "sample 2 height width"]


def warp(
    image: Float[Tensor, "sample channel height width"],
    flow: Float[Tensor, "sample 2 height width"],
    padding: Literal["zeros", "border"] = "zeros",
) -> Float[Tensor, "sample channel height width"]:
    """`image` at x + flow(x): bilinear, flow in pixels as (right, down).

    `padding` is what lies outside: "zeros", or "border" for the nearest edge pixel.
    """
    height, width = image.shape[-2:]
    # Positions of a hundred pixels need more digits than half precision has.
    with torch.autocast(image.device.type, enabled=False):
        at = pixel_centers(width, height, flow.device) + flow.float().movedim(1, -1)
        read = sample_bilinear(image.float(), at.flatten(1, 2), padding)
    return read.movedim(-1, 1).unflatten(2, (height, width)).to(image.dtype)


class SPyNet(nn.Module):
    """Flow from each image to another, refined from 1/32 of the size to the whole; 1,440,300 parameters."""

    mean: Tensor
    std: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.basic_module = nn.ModuleList(_Level() for _ in range(LEVELS))
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1))
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1))

    def forward(
        self, images: Float[Tensor, "sample 3 height width"], others: Float[Tensor, "sample 3 height width"]
    ) -> Float[Tensor, "sample 2 height width"]:
        """Flow in pixels, (right, down): `warp(others, flow)` looks like `images`. RGB in [0, 1], any size."""
        height, width = images.shape[-2:]
        size = tuple(-(-side // MULTIPLE) * MULTIPLE for side in (height, width))
        pairs = [[(_resize(x, size) - self.mean) / self.std for x in (images, others)]]
        for _ in range(LEVELS - 1):
            pairs.append([F.avg_pool2d(x, 2) for x in pairs[-1]])
        flow = images.new_zeros(len(images), 2, *pairs[-1][0].shape[-2:])
        for level, (image, other) in zip(self.basic_module, reversed(pairs), strict=True):
            if flow.shape[-1] != image.shape[-1]:
                flow = 2 * F.interpolate(flow, scale_factor=2, mode="bilinear", align_corners=True)
            flow = flow + level(torch.cat([image, warp(other, flow, "border"), flow], 1))
        scale = flow.new_tensor([width / size[1], height / size[0]]).view(2, 1, 1)
        return _resize(flow, (height, width)) * scale


class _Level(nn.Module):
    """Five convolutions of 7 x 7; the nesting is that of the published checkpoints' names."""

    def __init__(self) -> None:
        super().__init__()
        self.basic_module = nn.ModuleList(
            nn.ModuleDict({"conv": nn.Conv2d(a, b, 7, padding=3)}) for a, b in pairwise(CHANNELS)
        )

    def forward(self, x: Float[Tensor, "sample 8 height width"]) -> Float[Tensor, "sample 2 height width"]:
        for number, step in enumerate(self.basic_module):
            assert isinstance(step, nn.ModuleDict)
            x = step["conv"](x.relu() if number else x)
        return x


def _resize(images: Float[Tensor, "sample channel _h _w"], size: tuple[int, ...]) -> Float[Tensor, "..."]:
    return F.interpolate(images, size=size, mode="bilinear", align_corners=False)


def deform_conv2d(
    x: Float[Tensor, "sample channel height width"],
    offsets: Float[Tensor, "sample offset height width"],
    masks: Float[Tensor, "sample point height width"],
    weight: Float[Tensor, "out channel kernel kernel"],
    bias: Float[Tensor, "out"] | None,
) -> Float[Tensor, "sample out height width"]:
    """A convolution of stride 1 that keeps the size, its kernel points displaced and weighted pixel by pixel.

    Args:
        x: its channels fall into as many groups, in order, as the offsets have.
        offsets: pixels; per group and kernel point (row by row), first down, then right.
        masks: per group and kernel point, the weight of the sample.
        weight: odd kernel; zero offsets and unit masks make this `conv2d` with padding kernel // 2.
        bias: per output channel.

    Sampling is bilinear; zero outside of the image.
    """
    kernel = weight.shape[-1]
    height, width = x.shape[-2:]
    points = kernel * kernel
    groups = masks.shape[1] // points
    # Positions of a hundred pixels need more digits than half precision has.
    with torch.autocast(x.device.type, enabled=False):
        shift = rearrange(offsets.float(), "b (g k yx) h w -> yx (b g) k h w", k=points, yx=2)
        place = torch.arange(kernel, device=x.device) - kernel // 2
        kernel_points = torch.stack([place.repeat(kernel), place.repeat_interleave(kernel)], -1)[
            :, None, None
        ]
        at = pixel_centers(width, height, x.device) + kernel_points + shift.flip(0).movedim(0, -1)
        images = rearrange(x.float(), "b (g c) h w -> (b g) c h w", g=groups)
        read = sample_bilinear(images, rearrange(at, "n k h w xy -> n (k h w) xy"))
        read = rearrange(read, "(b g) (k n) c -> b g c k n", g=groups, k=points)
        read = read * rearrange(masks.float(), "b (g k) h w -> b g 1 k (h w)", k=points)
    # Back to what the layers around it compute in, then the convolution is one product of matrices.
    out = weight.flatten(1) @ rearrange(read, "b g c k n -> b (g c k) n").to(weight.dtype)
    out = rearrange(out, "b o (h w) -> b o h w", h=height)
    return out if bias is None else out + bias.view(-1, 1, 1)


class AlignedConvolution(nn.Module):
    """Aligns two earlier results with the current frame: a deformable convolution along corrected flow."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(channels, 2 * channels, 3, 3))
        self.bias = nn.Parameter(torch.zeros(channels))
        shapes = pairwise((3 * channels + 4, channels, channels, channels))
        layers = [layer for i, o in shapes for layer in (nn.Conv2d(i, o, 3, padding=1), nn.LeakyReLU(0.1))]
        self.conv_offset = nn.Sequential(*layers, nn.Conv2d(channels, 3 * GROUPS * POINTS, 3, padding=1))

    def initialise(self) -> None:
        """Fresh weights as the authors draw them: at first, kernel points are where the flow leads."""
        nn.init.normal_(self.weight, 0, 0.02)
        nn.init.zeros_(self.bias)
        last = self.conv_offset[-1]
        assert isinstance(last, nn.Conv2d)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias if last.bias is not None else self.bias)

    def forward(
        self,
        earlier: Float[Tensor, "sample channels2 height width"],
        current: Float[Tensor, "sample channels3 height width"],
        flow1: Flow,
        flow2: Flow,
    ) -> Feature:
        """The two results, aligned and merged; `earlier` and `current` are concatenated features."""
        raw = self.conv_offset(torch.cat([current, flow1, flow2], 1))
        offsets, masks = raw.float().split([2 * GROUPS * POINTS, GROUPS * POINTS], 1)
        # Flows are (right, down); the offsets of a kernel point (down, right).
        led = [
            repeat(flow.flip(1), "b yx h w -> b (n yx) h w", n=GROUPS * POINTS // 2)
            for flow in (flow1, flow2)
        ]
        offsets = REACH_PX * offsets.tanh() + torch.cat(led, 1)
        return deform_conv2d(earlier, offsets, masks.sigmoid(), self.weight, self.bias)


class Propagation(nn.Module):
    """Second-order propagation in both directions; the forward one also takes the backward one's results."""

    def __init__(self, channels: int = 128) -> None:
        super().__init__()
        self.deform_align = nn.ModuleDict(
            {way: AlignedConvolution(channels) for way in ("backward_", "forward_")}
        )
        self.backbone = nn.ModuleDict(
            {
                way: nn.Sequential(
                    nn.Conv2d(inputs * channels, channels, 3, padding=1),
                    nn.LeakyReLU(0.1),
                    nn.Conv2d(channels, channels, 3, padding=1),
                )
                for way, inputs in (("backward_", 2), ("forward_", 3))
            }
        )
        self.fusion = nn.Conv2d(2 * channels, channels, 1)

    def forward(
        self,
        features: Float[Tensor, "sample frame channel height width"],
        to_next: Float[Tensor, "sample pair 2 height width"],
        to_previous: Float[Tensor, "sample pair 2 height width"],
    ) -> Float[Tensor, "sample frame channel height width"]:
        """Features of consecutive frames, given the flow of each pair, (right, down) in their pixels."""
        frames = features.unbind(1)
        # The flows are in the order of time although this sweep starts at the last pair: the
        # published weights were trained this way.
        backward = self._sweep("backward_", [(x,) for x in reversed(frames)], to_next.unbind(1))
        known = list(zip(frames, reversed(backward), strict=True))
        forward = self._sweep("forward_", known, to_previous.unbind(1))
        fused = zip(known, forward, strict=True)
        return torch.stack([x + self.fusion(torch.cat([back, ahead], 1)) for (x, back), ahead in fused], 1)

    def _sweep(self, way: str, known: Sequence[tuple[Feature, ...]], flows: Sequence[Flow]) -> list[Feature]:
        """The results of the frames in this order, each from the last two and the flows to them."""
        results: list[Feature] = []
        for number, seen in enumerate(known):
            result = torch.zeros_like(seen[0])
            if number:
                last = results[-1]
                flow = flows[number - 1]
                earlier = torch.zeros_like(last)
                flow2 = torch.zeros_like(flow)
                warped2 = earlier
                if number > 1:
                    earlier = results[-2]
                    flow2 = flow + warp(flows[number - 2], flow)
                    warped2 = warp(earlier, flow2)
                around = torch.cat([warp(last, flow), seen[0], warped2], 1)
                result = self.deform_align[way](torch.cat([last, earlier], 1), around, flow, flow2)
            results.append(result + self.backbone[way](torch.cat([*seen, result], 1)))
        return results
