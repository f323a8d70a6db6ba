"""Slow, obvious twin of convolutions in two or three dimensions: one tap of the kernel at a time, in double."""

from itertools import product

import torch


def convolve_twin(x, weight, bias, stride, padding):
    """One image [channel ...]; stride and padding one number for each axis."""
    x, weight = x.double(), weight.double()
    padded = x.new_zeros(x.shape[0], *(n + 2 * p for n, p in zip(x.shape[1:], padding, strict=True)))
    padded[(slice(None), *(slice(p, p + n) for n, p in zip(x.shape[1:], padding, strict=True)))] = x
    sizes = [(n - k) // s + 1 for n, k, s in zip(padded.shape[1:], weight.shape[2:], stride, strict=True)]
    total = x.new_zeros(weight.shape[0], *sizes)
    for tap in product(*(range(k) for k in weight.shape[2:])):
        seen = padded[(slice(None), *(slice(t, t + n * s, s) for t, n, s in zip(tap, sizes, stride, strict=True)))]
        total = total + torch.einsum("oi,i...->o...", weight[(slice(None), slice(None), *tap)], seen)
    return total if bias is None else total + bias.double().view(-1, *[1] * len(sizes))
