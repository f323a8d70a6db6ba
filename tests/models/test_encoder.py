"""The encoder against its slow reference, its sizes, and crops in place of whole images."""

import torch
from models.plates import TINY, context
from reference.encoder_reference import encode_reference

from viewmend.models.paper.config import paper
from viewmend.models.paper.patches import PATCH_CELLS, STEP_CELLS, padded_size, split
from viewmend.models.paper.tokenizer import Encoder, Tokeniser, build_context_input, relative_depth


def test_the_encoder_equals_the_reference(rng):
    encoder = Encoder(TINY)
    for layer in encoder.layers:
        torch.nn.init.normal_(layer.bias, generator=rng)
    images = torch.rand(2, 5, 24, 36, generator=rng)
    slow = encode_reference([la.weight for la in encoder.layers], [la.bias for la in encoder.layers], images)
    assert torch.allclose(encoder(images), slow, atol=1e-4, rtol=1e-4)
    assert slow.shape == (2, 8, 6, 9)


def test_the_papers_encoder_has_fuseformers_sizes():
    shapes = [tuple(layer.weight.shape[:2]) for layer in Encoder(paper()).layers]
    assert shapes[:5] == [(64, 5), (64, 64), (128, 64), (256, 128), (384, 256)]
    assert shapes[5:] == [(512, 320), (384, 192), (256, 80), (128, 512)]
    extra_inputs = 2 * 64 * 9  # mask and depth
    assert sum(p.numel() for p in Encoder(paper()).parameters()) == 4_206_400 + extra_inputs


def test_encoding_a_crop_equals_encoding_the_whole_image():
    tokeniser = Tokeniser(TINY)
    for layer in tokeniser.encoder.layers:
        torch.nn.init.normal_(layer.bias, 0, 0.2)
    stacks = [build_context_input(context(0, width=w, height=h), TINY) for w, h in ((66, 60), (200, 170))]
    whole = []
    with torch.no_grad():
        tokens = tokeniser(stacks)
        for stack in stacks:
            views, channels, height, width = stack.channels.shape
            full = padded_size(*stack.kept.shape[1:])
            canvas = torch.zeros(views, channels, full[0] + 160, full[1] + 160)
            canvas[:, :, 80 : 80 + height, 80 : 80 + width] = stack.channels
            patches = split(tokeniser.encoder(canvas)[:, :, 20:, 20:], stack.places, PATCH_CELLS, STEP_CELLS)
            whole.append(tokeniser.linear(patches.flatten(1)))
    assert torch.allclose(tokens, torch.cat(whole), atol=1e-4)
    assert not bool(stacks[1].kept.all()), "the crop must be smaller than the image"


def test_relative_depth_is_independent_of_scale(rng):
    depth = torch.rand(2, 9, 9, generator=rng) + 1
    depth[:, :3] = 0
    relative = relative_depth(depth)
    assert torch.allclose(relative, relative_depth(depth * 1000), atol=1e-5)
    assert not relative[:, :3].any() and abs(float(relative[0, 3:].median())) < 1e-6
    assert not relative_depth(torch.zeros(1, 4, 4)).any()
