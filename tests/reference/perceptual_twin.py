"""Slow, obvious twin of viewmend.training.perceptual_loss: VGG16 written out by the names of its layers."""

import torch
from reference.convolution_twin import convolve_twin

LAYERS = {
    "conv1_1": 0, "conv1_2": 2, "pool1": None,
    "conv2_1": 5, "conv2_2": 7, "pool2": None,
    "conv3_1": 10, "conv3_2": 12, "conv3_3": 14, "pool3": None,
    "conv4_1": 17, "conv4_2": 19, "conv4_3": 21,
}  # fmt: skip
"""Where torchvision keeps each."""
TAKEN = ("conv1_2", "conv2_2", "conv3_3", "conv4_3")


def features_twin(rgb, weights):
    """relu1_2, relu2_2, relu3_3 and relu4_3 of an image in [0, 1]."""
    x = torch.stack(
        [(rgb[c].double() - m) / s for c, m, s in ((0, 0.485, 0.229), (1, 0.456, 0.224), (2, 0.406, 0.225))]
    )
    taken = []
    for name, place in LAYERS.items():
        if place is None:
            x = torch.stack([x[:, i::2, j::2] for i in (0, 1) for j in (0, 1)]).amax(0)
        else:
            key = f"features.{place}"
            x = convolve_twin(x, weights[f"{key}.weight"], weights[f"{key}.bias"], (1, 1), (1, 1)).clamp_min(0)
        if name in TAKEN:
            taken.append(x)
    return taken


def perceptual_twin(predicted, E, truth, weights, margin, cell):
    """Of one image: its crop is found and filled pixel by pixel."""
    holes = [(v, u) for v in range(E.shape[0]) for u in range(E.shape[1]) if E[v, u] > 0]
    top, left = min(v for v, _ in holes) - margin, min(u for _, u in holes) - margin
    height, width = max(v for v, _ in holes) + margin + 1 - top, max(u for _, u in holes) + margin + 1 - left
    height, width = height + -height % cell, width + -width % cell
    pasted, wanted = (torch.zeros(3, height, width, dtype=torch.float64) for _ in range(2))
    missing = torch.zeros(height, width, dtype=torch.float64)
    for v in range(max(top, 0), min(top + height, E.shape[0])):
        for u in range(max(left, 0), min(left + width, E.shape[1])):
            missing[v - top, u - left] = E[v, u]
            wanted[:, v - top, u - left] = truth[:, v, u]
            pasted[:, v - top, u - left] = E[v, u] * predicted[:, v, u] + (1 - E[v, u]) * truth[:, v, u]
    losses = []
    for seen, right in zip(features_twin(pasted, weights), features_twin(wanted, weights), strict=True):
        covered = height // seen.shape[1]
        share = missing.unflatten(0, (-1, covered)).unflatten(2, (-1, covered)).mean((1, 3))
        losses.append((share * (seen - right).abs().mean(0)).sum() / share.sum())
    return sum(losses) / len(losses)
