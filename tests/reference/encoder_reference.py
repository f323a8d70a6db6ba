"""Slow reference of the hierarchical encoder: group by group, from the table of its layers."""

import torch
from torch.nn.functional import conv2d, leaky_relu

STRIDES = (2, 1, 2, 1, 1, 1, 1, 1, 1)
GROUPS = (1, 1, 1, 1, 1, 2, 4, 8, 1)


def encode_reference(weights, biases, images):
    x = early = images
    for number in range(9):
        groups, weight, bias = GROUPS[number], weights[number], biases[number]
        outputs = []
        for g in range(groups):
            share = slice(g * x.shape[1] // groups, (g + 1) * x.shape[1] // groups)
            seen = x[:, share]
            if number >= 5:
                early_share = slice(g * early.shape[1] // groups, (g + 1) * early.shape[1] // groups)
                seen = torch.cat([early[:, early_share], seen], 1)
            out = slice(g * len(weight) // groups, (g + 1) * len(weight) // groups)
            outputs.append(conv2d(seen, weight[out], bias[out], STRIDES[number], 1))
        x = leaky_relu(torch.cat(outputs, 1), 0.2)
        if number == 3:
            early = x
    return x
