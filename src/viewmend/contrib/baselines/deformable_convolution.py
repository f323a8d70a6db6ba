"""Modulated deformable convolution: each kernel point has an offset and a weight."""

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor

from viewmend.geometry.cameras import pixel_centers
from viewmend.geometry.sampling import sample_bilinear


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
        masks: per group and kernel point, the factor of what is read.
        weight: odd kernel; zero offsets and unit masks make this `conv2d` with padding kernel // 2.
        bias: per output channel.

    Reads bilinearly; outside of the image is zero.
    """
    kernel, (height, width) = weight.shape[-1], x.shape[-2:]
    points = kernel * kernel
    groups = masks.shape[1] // points
    # Positions of a hundred pixels need more digits than half precision has.
    with torch.autocast(x.device.type, enabled=False):
        shift = rearrange(offsets.float(), "b (g k yx) h w -> yx (b g) k h w", k=points, yx=2)
        place = torch.arange(kernel, device=x.device) - kernel // 2
        kernel_points = torch.stack([place.repeat(kernel), place.repeat_interleave(kernel)], -1)[:, None, None]
        at = pixel_centers(width, height, x.device) + kernel_points + shift.flip(0).movedim(0, -1)
        images = rearrange(x.float(), "b (g c) h w -> (b g) c h w", g=groups)
        read = sample_bilinear(images, rearrange(at, "n k h w xy -> n (k h w) xy"))
        read = rearrange(read, "(b g) (k n) c -> b g c k n", g=groups, k=points)
        read = read * rearrange(masks.float(), "b (g k) h w -> b g 1 k (h w)", k=points)
    # Back to what the layers around it compute in, then the convolution is one product of matrices.
    out = weight.flatten(1) @ rearrange(read, "b g c k n -> b (g c k) n").to(weight.dtype)
    out = rearrange(out, "b o (h w) -> b o h w", h=height)
    return out if bias is None else out + bias.view(-1, 1, 1)
