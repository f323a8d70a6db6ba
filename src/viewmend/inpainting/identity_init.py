"""How an inpainter with a colour skip starts: as a copier of blurred, rightly shifted colours. Ours.

A head of a token holds one colour of its patch as plane waves, cosine and sine in a pair. Values turn by wave vector x
distance between context patch and query, which is the shift theorem: what arrives is the context patch as seen from
the query's centre. The decoder starts with the waves' synthesis, so that training starts from a picture.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from viewmend.inpainting.config import InpainterConfig
from viewmend.inpainting.patches import PATCH_CELLS, STEP_CELLS
from viewmend.inpainting.rope import value_frequencies

RIDGE = 0.3
"""Keeps a wave's weight small where 28 pixels hardly tell it from another."""
FEATURE_GAIN = 0.3
"""Size of the untrained weights, against the usual."""
ANCHOR = 4.0
"""Constant part of a token: the norms that follow then divide bright and dark patches by about the same."""


def synthesis(head_dim: int) -> Float[Tensor, "cell channel"]:
    """The 7 x 7 values, row by row, of each channel of a head: cosines, then sines, about the patch's centre."""
    steps = (torch.arange(PATCH_CELLS) - (PATCH_CELLS - 1) / 2) / STEP_CELLS
    v, u = torch.meshgrid(steps, steps, indexing="ij")
    phase = torch.stack([u.flatten(), v.flatten()], 1) @ value_frequencies(head_dim)[:2]
    return torch.cat([phase.cos(), phase.sin()], 1)


def analysis(head_dim: int) -> Float[Tensor, "channel cell"]:
    """The channels that best explain 7 x 7 values: ridge regression on `synthesis`."""
    S = synthesis(head_dim)
    return torch.linalg.solve(S.T @ S + RIDGE * torch.eye(head_dim), S.T)


@torch.no_grad()
def identity_init(tokenise: nn.Linear, decode: nn.Linear, config: InpainterConfig) -> None:
    """Overwrites the start of the layers from patch to token and from token to patch."""
    head_dim, cells, C = config.dim // config.heads, PATCH_CELLS**2, config.widths[-1]
    # As many heads as there are channels for: R, G, B, and the mask where there is one.
    shown = min(config.heads, 3 + config.use_mask)
    tokenise.weight.mul_(FEATURE_GAIN)
    tokenise.bias.zero_()
    for head in range(shown):
        rows = slice(head * head_dim, (head + 1) * head_dim)
        of_channel = slice((C + head) * cells, (C + head + 1) * cells)
        tokenise.weight[rows, C * cells :] = 0
        tokenise.weight[rows, of_channel] = analysis(head_dim)
    # The sine of the constant wave is nothing: its channel is free for the anchor, of alternating sign so that
    # the norms' mean stays zero.
    anchors = torch.arange(config.heads) * head_dim + head_dim // 2
    tokenise.bias[anchors] = ANCHOR * torch.tensor([1.0, -1.0]).repeat(config.heads)[: config.heads]

    spread = ANCHOR * (config.heads / config.dim) ** 0.5
    for colour in range(min(shown, 3)):
        rows = slice((C + colour) * cells, (C + colour + 1) * cells)
        decode.weight[rows] = 0
        decode.weight[rows, colour * head_dim : (colour + 1) * head_dim] = spread * synthesis(head_dim)
        decode.bias[rows] = 0
