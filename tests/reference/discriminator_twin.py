"""Slow, obvious twin of the patch discriminators: exact singular values instead of power iteration."""

import torch
from reference.convolution_twin import convolve_twin


def judge_twin(image, weights, bias, first_padding):
    """Logits of one image or clip in [0, 1]; `weights` as they are learned, before any norm, the first to the last."""
    x = 2 * image.double() - 1
    flat = image.ndim == 3
    for number, weight in enumerate(weights):
        last = number == len(weights) - 1
        weight = weight.double()
        if not last:
            weight = weight / torch.linalg.svdvals(weight.flatten(1))[0]
        pixels = first_padding if number == 0 else 2
        x = torch.where(x > 0, x, 0.2 * x) if number else x
        stride, padding = ((2, 2), (pixels, pixels)) if flat else ((1, 2, 2), (1, pixels, pixels))
        x = convolve_twin(x, weight, bias if last else None, stride, padding)
    return x
